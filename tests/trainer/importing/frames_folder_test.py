"""Masks and normals of a folder of frames: matching of files to frames, and refusals."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from rnd_runtime.capture.capture import Capture
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.images import linear_to_srgb, srgb_to_linear, to_bytes, write_image
from rnd_trainer.importing.images import read_mask
from rnd_trainer.importing.importer import import_source
from rnd_trainer.importing.options import FrameSelection, ImportOptions
from support import layouts
from support.imported import import_scene
from support.known_scene import FRAMES, HEIGHT, WIDTH, view_of
from support.pose_programs import INTRINSICS, LENS, frame_image, write_film, write_frames, write_poses

DISTORTION = (1e-4, 0.0, 0.0, 0.0)  # moves nothing by a pixel


def _write(folder: Path, frame_name: str = "{:05d}", mask_name: str = "{:05d}", first: int = 0, mask: int = 0) -> None:
    """frames/ that count from ``first``, masks/ that count from ``mask``, and poses.npz."""
    for k in range(FRAMES):
        write_image(folder / "frames" / f"{frame_name.format(first + k)}.png", frame_image(LENS, k))
        pixels = (255 * view_of(LENS, k).mask).astype(np.uint8)
        write_image(folder / "masks" / f"{mask_name.format(mask + k)}.png", pixels)
    write_poses(folder)


def _imported(folder: Path, source: Path | None = None, **more: object) -> Capture:
    options = {"poses": folder / "poses.npz", "intrinsics": INTRINSICS, "masks": folder / "masks"} | more
    return import_scene(source or folder / "frames", folder / "out", **options)


def _assert_masks(capture: Capture, count: int = FRAMES) -> None:
    """Each of ``count`` frames has its own mask."""
    assert len(capture.frames) == count
    for frame in capture.frames:
        mask = capture.load_frame(frame).mask
        assert np.array_equal(mask > 0.5, view_of(LENS, frame.frame).mask), frame.frame


def _notes(folder: Path) -> list[str]:
    notes: list[str] = json.loads((folder / "out" / "capture.json").read_text())["import"]["notes"]
    return notes


@pytest.mark.parametrize(
    ("frame_name", "mask_name"),
    [("{:05d}", "mask_{:d}"), ("f{:d}.me", "f{:d}.me"), ("f_{:04d}", "f_{:04d}_mask"), ("f_{:d}", "f_{:d}.jpg")],
)
@pytest.mark.parametrize("first", [0, 17])
def test_masks_are_found_by_the_names_of_the_frames(tmp_path, frame_name, mask_name, first) -> None:
    _write(tmp_path, frame_name, mask_name, first, first)
    _assert_masks(_imported(tmp_path))


@pytest.mark.parametrize("names", ["{:05d}", "mask_{:d}"])
@pytest.mark.parametrize("first", [0, 1])
def test_masks_of_frames_without_numbers_may_count_from_one(tmp_path, names, first) -> None:
    """Where there are as many as frames."""
    _write(tmp_path, "frame{:d}x", names, mask=first)
    _assert_masks(_imported(tmp_path))
    assert ("masks are numbered from 1, frames from 0: taken for the same" in _notes(tmp_path)) == bool(first)


COUNTED = {
    # the names of frames and masks, the number of the first of each
    "ffmpeg's, masks from 0": ("f_{:04d}", "{:05d}", 1, 0),
    "named alike": ("{:05d}", "{:05d}", 1, 0),
    "masks from 1": ("{:05d}", "{:05d}", 0, 1),
    "a part, masks from 0": ("f_{:d}", "f_{:d}", 51, 0),
}


@pytest.mark.parametrize("selection", [FrameSelection(), FrameSelection(start=1)], ids=["all", "late"])
@pytest.mark.parametrize("name", COUNTED)
def test_as_many_masks_as_frames_may_count_from_elsewhere(tmp_path, name, selection) -> None:
    """Whichever frames are selected."""
    frame_name, mask_name, first, mask = COUNTED[name]
    _write(tmp_path, frame_name, mask_name, first, mask)
    capture = _imported(tmp_path, selection=selection)
    _assert_masks(capture, len(capture.frames))
    assert f"masks are numbered from {mask}, frames from {first}: taken for the same" in _notes(tmp_path)


def test_another_count_of_masks_goes_by_their_numbers(tmp_path) -> None:
    _write(tmp_path, "f_{:d}", "{:d}", first=1, mask=1)
    (tmp_path / "masks" / "1.png").rename(tmp_path / "masks" / "0.png")
    (tmp_path / "masks" / "preview.png").hardlink_to(tmp_path / "masks" / "0.png")
    (tmp_path / "masks" / "5.png").hardlink_to(tmp_path / "masks" / "0.png")
    _assert_masks(_imported(tmp_path, selection=FrameSelection(start=1)), FRAMES - 1)


@pytest.mark.parametrize("kind", ["masks", "normals"])
def test_a_file_without_a_number_is_not_a_mask_of_a_video(tmp_path, kind) -> None:
    _write(tmp_path)
    film = write_film(tmp_path)
    for k in range(FRAMES):
        write_image(tmp_path / "normals" / f"{k:05d}.png", to_bytes((view_of(LENS, k).normals + 1) / 2))
    write_image(tmp_path / kind / "preview.png", np.full((2, 2, 3), 255, np.uint8))
    _assert_masks(_imported(tmp_path, film, normals=tmp_path / "normals"))


def test_masks_that_match_no_frame_are_refused(tmp_path) -> None:
    _write(tmp_path, "f_{:04d}", "{:04d}_mask", first=1, mask=1)
    with pytest.raises(InputError, match=r"file: expected one numbered \d, got 0001_mask\.png … 0004_mask\.png"):
        _imported(tmp_path)
    (fewer := tmp_path / "fewer").mkdir()
    _write(fewer, "frame{:d}x")
    (fewer / "masks" / "00000.png").unlink()
    with pytest.raises(InputError, match=r"file: expected one numbered 0, got 00001\.png … 00003\.png"):
        _imported(fewer)


_FILLED = np.pad(np.ones((3, 2), np.uint8), 1)
STORED = {
    # the person is 3 × 2 pixels inside a border of one
    "0/1.png": _FILLED,
    "0/255.png": 255 * _FILLED,
    "ids, 16 bit.png": 3 * _FILLED.astype(np.uint16),
    "0/65535.png": 65535 * _FILLED.astype(np.uint16),
    "bool.npy": _FILLED.astype(bool),
    "SAM 2's.npy": _FILLED.astype(bool)[None],
    "floats.npy": _FILLED[None] * 1.0,
    "last axis.npy": _FILLED[..., None],
}


@pytest.mark.parametrize("name", STORED)
def test_a_mask_is_read_in_every_coding(tmp_path, name) -> None:
    path = tmp_path / name.replace("/", " or ")
    np.save(path, STORED[name]) if path.suffix == ".npy" else write_image(path, STORED[name])
    assert np.array_equal(read_mask(path), 255 * _FILLED)


def test_sixteen_bits_of_coverage_stay_soft(tmp_path) -> None:
    soft = np.linspace(0, 65535, 64).reshape(8, 8).astype(np.uint16)
    write_image(tmp_path / "m.png", soft)
    assert np.abs(read_mask(tmp_path / "m.png") - soft / 257).max() <= 1


def test_a_soft_outline_keeps_the_persons_colour_not_the_walls(tmp_path) -> None:
    red, wall = (srgb_to_linear(np.array(colour) / 255) for colour in ((180, 40, 40), (230, 235, 240)))
    coverage = np.clip((10 - np.abs(np.arange(WIDTH) - WIDTH / 2)) / 5, 0, 1) * np.ones((HEIGHT, 1))
    for k in range(FRAMES):
        write_image(tmp_path / "masks" / f"{k:05d}.png", to_bytes(coverage))
        mixed = coverage[..., None] * red + (1 - coverage[..., None]) * wall
        write_image(tmp_path / "frames" / f"{k:05d}.png", to_bytes(linear_to_srgb(mixed)))
    write_poses(tmp_path)
    capture = _imported(tmp_path)
    seen = capture.load_frame(capture.frames[0])
    outline = (seen.mask > 0.1) & (seen.mask < 0.9)
    expected = linear_to_srgb(red * seen.mask[outline][:, None])
    assert outline.any()
    assert np.abs(seen.image_srgb[outline] - expected).max() < 3 / 255  # 8 bits of a mixture, unmixed


@pytest.mark.parametrize("shape", [(4,), (2, 3, 4, 5)])
def test_arrays_of_other_shapes_are_refused(tmp_path, shape) -> None:
    np.save(tmp_path / "m.npy", np.zeros(shape))
    with pytest.raises(InputError, match=r"m\.npy: mask: expected \[H, W\], got"):
        read_mask(tmp_path / "m.npy")


@pytest.mark.parametrize("distortion", [(), DISTORTION], ids=["straight", "distorted"])
def test_masks_of_another_size_are_refused_for_any_lens(tmp_path, distortion) -> None:
    _write(tmp_path)
    for k in range(FRAMES):
        write_image(tmp_path / "masks" / f"{k:05d}.png", np.zeros((HEIGHT // 2, WIDTH // 2), np.uint8))
    with pytest.raises(InputError, match=rf"masks/0000\d\.png: frame \d: size of mask: expected {WIDTH} x {HEIGHT}"):
        _imported(tmp_path, distortion=distortion)


def test_an_image_of_another_size_is_named(tmp_path) -> None:
    _write(tmp_path)
    write_image(tmp_path / "frames" / "00002.png", np.zeros((HEIGHT // 2, WIDTH, 3), np.uint8))
    with pytest.raises(InputError, match=rf"frames/00002\.png: frame 2: size of image: expected {WIDTH} x {HEIGHT}"):
        _imported(tmp_path)


@pytest.mark.parametrize("given", [(0.1,), (0.1, 0, 0, float("nan")), (0.0,) * 6])
def test_a_distortion_that_opencv_does_not_know_is_refused(tmp_path, given) -> None:
    with pytest.raises(InputError, match=r"--distortion: expected k1 k2 p1 p2 \[k3 …\], as OpenCV has them"):
        _imported(tmp_path, distortion=given)


# Output folders that would lose somebody's files


@pytest.mark.parametrize(
    ("taken", "words"),
    [
        ("images/mine.png", "holds images already"),
        ("masks/mine.png", "holds masks already"),
        ("normals/mine.png", "holds normals already"),
        ("motion.npz", "holds a motion.npz"),
        ("body.npz", "holds a body.npz"),
        ("capture.json", "holds a capture already"),
    ],
)
def test_a_capture_is_not_written_among_other_files(tmp_path, taken, words) -> None:
    _write(tmp_path)
    (tmp_path / "out" / taken).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / "out" / taken).write_bytes(b"mine")
    with pytest.raises(InputError, match=words):
        _imported(tmp_path)
    assert (tmp_path / "out" / taken).read_bytes() == b"mine"


def test_a_capture_is_not_written_among_its_sources(tmp_path) -> None:
    _write(tmp_path)
    given = {"body": str(layouts.body_file(tmp_path)), "poses": tmp_path / "poses.npz", "intrinsics": INTRINSICS}
    for kind, source, more in (
        ("the source", tmp_path / "images", {}),
        ("--masks", tmp_path / "frames", {"masks": tmp_path / "masks"}),
    ):
        if kind == "the source":
            (tmp_path / "frames").rename(tmp_path / "images")
        else:
            (tmp_path / "images").rename(tmp_path / "frames")
        with pytest.raises(InputError, match=f"OUT: expected another folder than that of {kind}"):
            import_source(source, tmp_path, ImportOptions(**given, **more))


def test_an_unwritable_folder_is_refused_before_reading(tmp_path, monkeypatch) -> None:
    source = write_frames(tmp_path)
    (tmp_path / "file").touch()
    monkeypatch.setattr("rnd_trainer.importing.importer._read", lambda *_: pytest.fail("read"))
    options = ImportOptions(body=str(layouts.body_file(tmp_path)), poses=write_poses(tmp_path), intrinsics=INTRINSICS)
    for out in (tmp_path / "file", tmp_path / "file" / "more" / "out"):
        with pytest.raises(InputError, match="output folder cannot be made"):
            import_source(source, out, options)
