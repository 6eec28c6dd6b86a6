"""A folder of frames: whose mask is whose, which of them may be taken, and pictures of the wrong size."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from rnd_runtime.capture.capture import Capture, load_capture
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.images import to_bytes, write_image
from rnd_trainer.importing.images import read_mask
from rnd_trainer.importing.importer import import_source
from rnd_trainer.importing.options import Choice, ImportOptions
from support import layouts
from support.known_scene import BETAS, FRAMES, HEIGHT, WIDTH, view_of

CAMERA = layouts.video_camera(77.0)
BENT = (1e-4, 0.0, 0.0, 0.0)  # a lens whose distortion moves nothing by a pixel


def _masks() -> list[np.ndarray]:
    return [(255 * view_of(CAMERA, k).mask).astype(np.uint8) for k in range(FRAMES)]


def _picture(mask: np.ndarray) -> np.ndarray:
    return np.where(mask[..., None] > 0, np.uint8([180, 120, 90]), np.uint8(60)).astype(np.uint8)


def _write(
    folder: Path, frame_name: str = "{:05d}", mask_name: str = "{:05d}", first: int = 0, first_mask: int | None = None
) -> None:
    first_mask = first if first_mask is None else first_mask
    for k, mask in enumerate(_masks()):
        write_image(folder / "frames" / f"{frame_name.format(first + k)}.png", _picture(mask))
        write_image(folder / "masks" / f"{mask_name.format(first_mask + k)}.png", mask)
    world = layouts.camera_world()
    np.savez(folder / "poses.npz", thetas=world.thetas, trans=world.trans, betas=BETAS)


def _film(folder: Path) -> Path:
    layouts.write_video(folder / "me.mp4", [_picture(mask) for mask in _masks()])
    return folder / "me.mp4"


def _imported(folder: Path, source: Path | None = None, **more: object) -> Capture:
    options = ImportOptions(
        body=str(layouts.body_file(folder)),
        poses=folder / "poses.npz",
        intrinsics=(77, 77, WIDTH / 2, HEIGHT / 2),
        **{"masks": folder / "masks"} | more,
    )
    import_source(source or folder / "frames", folder / "out", options)
    return load_capture(folder / "out")


@pytest.mark.parametrize(
    ("frame_name", "mask_name"),
    [
        ("{:05d}", "{:05d}"),
        ("{:05d}", "mask_{:d}"),
        ("f{:d}.me", "f{:d}.me"),
        ("f_{:04d}", "f_{:04d}_mask"),
        ("f_{:d}", "f_{:d}.jpg"),
    ],
)
@pytest.mark.parametrize("first", [0, 1, 17])
def test_masks_are_found_by_the_names_of_the_frames(tmp_path, frame_name, mask_name, first) -> None:
    """Wherever the frames' numbers begin: ffmpeg counts from one."""
    _write(tmp_path, frame_name, mask_name, first)
    capture = _imported(tmp_path)
    assert len(capture.frames) == FRAMES
    for frame in capture.frames:
        mask = capture.load_frame(frame).mask
        assert np.array_equal(mask > 0.5, view_of(CAMERA, frame.frame).mask), frame.frame


def test_masks_whose_numbers_cannot_be_told_are_refused_where_the_frames_have_some(tmp_path) -> None:
    """By their places, each would be of the frame before."""
    _write(tmp_path, "f_{:04d}", "{:04d}_mask", first=1)
    with pytest.raises(InputError, match=r"file: expected one numbered \d, got 0001_mask\.png … 0004_mask\.png"):
        _imported(tmp_path)


@pytest.mark.parametrize("names", ["{:05d}", "mask_{:d}"])
@pytest.mark.parametrize("first", [0, 1])
def test_masks_of_frames_without_numbers_may_be_counted_from_one(tmp_path, names, first) -> None:
    """Where there are as many as frames: a video's, or pictures that are called otherwise."""
    _write(tmp_path, "frame{:d}x", names)
    for k in reversed(range(FRAMES)):
        (tmp_path / "masks" / f"{names.format(k)}.png").rename(tmp_path / "masks" / f"{names.format(k + first)}.png")
    capture = _imported(tmp_path)
    for frame in capture.frames:
        assert np.array_equal(capture.load_frame(frame).mask > 0.5, view_of(CAMERA, frame.frame).mask)
    notes = json.loads((tmp_path / "out" / "capture.json").read_text())["import"]["notes"]
    assert ("masks are numbered from 1, frames from 0: taken for the same" in notes) == bool(first)


COUNTED = {
    # the names of frames and masks, the number of the first of each
    "ffmpeg's, masks from 0": ("f_{:04d}", "{:05d}", 1, 0),
    "called alike": ("{:05d}", "{:05d}", 1, 0),
    "masks from 1": ("{:05d}", "{:05d}", 0, 1),
    "a part, masks from 0": ("f_{:d}", "f_{:d}", 51, 0),
}


@pytest.mark.parametrize("choice", [Choice(), Choice(start=1), Choice(stop=3)], ids=["all", "late", "early"])
@pytest.mark.parametrize("name", COUNTED)
def test_as_many_masks_as_frames_may_be_counted_from_elsewhere(tmp_path, name, choice) -> None:
    """Whichever frames are taken of them."""
    frame_name, mask_name, first, first_mask = COUNTED[name]
    _write(tmp_path, frame_name, mask_name, first, first_mask)
    capture = _imported(tmp_path, choice=choice)
    for frame in capture.frames:
        assert np.array_equal(capture.load_frame(frame).mask > 0.5, view_of(CAMERA, frame.frame).mask)
    notes = json.loads((tmp_path / "out" / "capture.json").read_text())["import"]["notes"]
    assert f"masks are numbered from {first_mask}, frames from {first}: taken for the same" in notes


def test_masks_that_are_not_as_many_as_the_frames_are_those_of_their_numbers(tmp_path) -> None:
    _write(tmp_path, "f_{:d}", "{:d}", first=1)
    (tmp_path / "masks" / "1.png").rename(tmp_path / "masks" / "0.png")
    (tmp_path / "masks" / "preview.png").hardlink_to(tmp_path / "masks" / "0.png")
    (tmp_path / "masks" / "5.png").hardlink_to(tmp_path / "masks" / "0.png")
    capture = _imported(tmp_path, choice=Choice(start=1))
    assert len(capture.frames) == FRAMES - 1
    for frame in capture.frames:
        assert np.array_equal(capture.load_frame(frame).mask > 0.5, view_of(CAMERA, frame.frame).mask)


@pytest.mark.parametrize("kind", ["masks", "normals"])
def test_a_picture_without_a_number_is_no_mask_of_a_videos_frames(tmp_path, kind) -> None:
    """Nor are they its normals: frames of a video have no name that it could go on."""
    _write(tmp_path)
    film = _film(tmp_path)
    for k in range(FRAMES):
        view = view_of(CAMERA, k)
        write_image(tmp_path / "normals" / f"{k:05d}.png", to_bytes((view.normals + 1) / 2))
    write_image(tmp_path / kind / "preview.png", np.full((2, 2, 3), 255, np.uint8))
    capture = _imported(tmp_path, film, normals=tmp_path / "normals")
    assert len(capture.frames) == FRAMES
    for frame in capture.frames:
        assert np.array_equal(capture.load_frame(frame).mask > 0.5, view_of(CAMERA, frame.frame).mask)


def test_masks_from_one_that_are_fewer_than_the_frames_are_those_of_their_numbers(tmp_path) -> None:
    _write(tmp_path, "frame{:d}x")
    (tmp_path / "masks" / "00000.png").unlink()
    with pytest.raises(InputError, match=r"file: expected one numbered 0, got 00001\.png … 00003\.png"):
        _imported(tmp_path)


_FILLED = np.pad(np.ones((3, 2), np.uint8), 1)
STORED = {
    # what a mask's file holds: the person is 3 × 2 pixels inside a border of one
    "0/1.png": _FILLED,
    "0/255.png": 255 * _FILLED,
    "0/1, 16 bit.png": _FILLED.astype(np.uint16),
    "ids, 16 bit.png": 3 * _FILLED.astype(np.uint16),
    "0/255, 16 bit.png": 255 * _FILLED.astype(np.uint16),
    "0/65535.png": 65535 * _FILLED.astype(np.uint16),
    "0/1, 16 bit.npy": _FILLED.astype(np.uint16),
    "bool.npy": _FILLED.astype(bool),
    "SAM 2's.npy": _FILLED.astype(bool)[None],
    "floats.npy": _FILLED[None] * 1.0,
    "last axis.npy": _FILLED[..., None],
}


@pytest.mark.parametrize("name", STORED)
def test_a_mask_is_read_whatever_it_is_stored_as(tmp_path, name) -> None:
    path = tmp_path / name.replace("/", " or ")
    np.save(path, STORED[name]) if path.suffix == ".npy" else write_image(path, STORED[name])
    assert np.array_equal(read_mask(path), 255 * _FILLED)


def test_sixteen_bits_of_coverage_stay_soft(tmp_path) -> None:
    soft = np.linspace(0, 65535, 64).reshape(8, 8).astype(np.uint16)
    write_image(tmp_path / "m.png", soft)
    assert np.abs(read_mask(tmp_path / "m.png") - soft / 257).max() <= 1


@pytest.mark.parametrize("shape", [(4,), (2, 3, 4, 5)])
def test_an_array_that_is_no_mask_is_refused(tmp_path, shape) -> None:
    np.save(tmp_path / "m.npy", np.zeros(shape))
    with pytest.raises(InputError, match=r"m\.npy: mask: expected \[H, W\], got"):
        read_mask(tmp_path / "m.npy")


@pytest.mark.parametrize(
    ("choice", "frames"),
    [
        (Choice(start=1), {1: "train", 2: "train", 3: "novel_pose"}),
        (Choice(stop=3), {0: "train", 1: "train", 2: "novel_pose"}),
        (Choice(every=3), {0: "train", 3: "novel_pose"}),
    ],
)
def test_splits_are_of_the_frames_that_may_be_taken(tmp_path, choice, frames) -> None:
    _write(tmp_path)
    capture = _imported(tmp_path, choice=choice)
    assert {frame.frame: frame.split for frame in capture.frames} == frames


@pytest.mark.parametrize("distortion", [(), BENT], ids=["straight", "bent"])
def test_masks_of_another_size_are_refused_whatever_the_lens(tmp_path, distortion) -> None:
    _write(tmp_path)
    for k, mask in enumerate(_masks()):
        write_image(tmp_path / "masks" / f"{k:05d}.png", mask[::2, ::2])
    expected = f"size of mask: expected {WIDTH} x {HEIGHT} as the camera, got {WIDTH // 2} x {HEIGHT // 2}"
    with pytest.raises(InputError, match=rf"masks/0000\d\.png: frame \d: {expected}"):
        _imported(tmp_path, distortion=distortion)


def test_a_picture_of_another_size_is_named(tmp_path) -> None:
    _write(tmp_path)
    write_image(tmp_path / "frames" / "00002.png", np.zeros((HEIGHT // 2, WIDTH, 3), np.uint8))
    with pytest.raises(InputError) as caught:
        _imported(tmp_path)
    assert str(caught.value) == (
        f"{tmp_path / 'frames' / '00002.png'}: frame 2: size of image: expected {WIDTH} x {HEIGHT} as the first, "
        f"got {WIDTH} x {HEIGHT // 2}"
    )


def _refusal(folder: Path, source: str, out: Path, **more: object) -> str:
    options = ImportOptions(
        body=str(layouts.body_file(folder)),
        poses=folder / "poses.npz",
        intrinsics=(77, 77, WIDTH / 2, HEIGHT / 2),
        **more,
    )
    before = sorted(folder.rglob("*"))
    with pytest.raises(InputError) as caught:
        import_source(folder / source, out, options)
    assert sorted(folder.rglob("*")) == before
    return str(caught.value)


@pytest.mark.parametrize("name", ["images", "masks", "normals"])
def test_a_capture_is_not_written_among_other_files(tmp_path, name) -> None:
    _write(tmp_path)
    out = tmp_path / "out"
    write_image(out / name / "somebodys.png", _masks()[0])
    expected = f"{out}: holds {name} already (choose another folder, or remove them)"
    assert _refusal(tmp_path, "frames", out) == expected


def test_a_capture_is_not_written_among_what_it_is_made_of(tmp_path, monkeypatch) -> None:
    _write(tmp_path)
    (tmp_path / "frames").rename(tmp_path / "images")
    expected = "OUT: expected another folder than that of {}, got {}"
    assert _refusal(tmp_path, "images", tmp_path) == expected.format("the source", tmp_path)
    (tmp_path / "images").rename(tmp_path / "frames")
    assert _refusal(tmp_path, "frames", tmp_path, masks=tmp_path / "masks") == expected.format("--masks", tmp_path)
    (tmp_path / "masks").rename(tmp_path / "normals")
    monkeypatch.chdir(tmp_path)
    said = _refusal(tmp_path, "frames", Path(), normals=tmp_path / "normals")
    assert said == expected.format("--normals", ".")


def test_a_folder_that_cannot_be_made_is_refused_before_anything_is_read(tmp_path, monkeypatch) -> None:
    _write(tmp_path)
    (tmp_path / "file").touch()
    monkeypatch.setattr("rnd_trainer.importing.importer._read", lambda *_: pytest.fail("read"))
    for out in (tmp_path / "file", tmp_path / "file" / "more" / "out"):
        assert _refusal(tmp_path, "frames", out).startswith(f"{out}: output folder cannot be made: got ")


@pytest.mark.parametrize("given", [(0.1,), (0.1, 0, 0, float("nan")), (0.0,) * 6])
def test_a_distortion_that_opencv_does_not_know_is_refused(tmp_path, given) -> None:
    _write(tmp_path)
    with pytest.raises(InputError, match=r"--distortion: expected k1 k2 p1 p2 \[k3 …\], as OpenCV has them"):
        _imported(tmp_path, distortion=given)
