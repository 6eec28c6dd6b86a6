"""A folder of frames: whose mask is whose, which of them may be taken, and pictures of the wrong size."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import layouts
from known_scene import BETAS, FRAMES, HEIGHT, WIDTH, view_of
from rnd_runtime.capture import Capture, load_capture
from rnd_runtime.errors import InputError
from rnd_runtime.images import write_image
from rnd_trainer.importing.importer import import_source
from rnd_trainer.importing.options import Choice, ImportOptions

CAMERA = layouts.video_camera(77.0)
BENT = (1e-4, 0.0, 0.0, 0.0)  # a lens whose distortion moves nothing by a pixel


def _masks() -> list[np.ndarray]:
    return [(255 * view_of(CAMERA, k).mask).astype(np.uint8) for k in range(FRAMES)]


def _write(folder: Path, frame_name: str = "{:05d}", mask_name: str = "{:05d}", first: int = 0) -> None:
    for k, mask in enumerate(_masks()):
        picture = np.where(mask[..., None] > 0, np.uint8([180, 120, 90]), np.uint8(60))
        write_image(folder / "frames" / f"{frame_name.format(first + k)}.png", picture.astype(np.uint8))
        write_image(folder / "masks" / f"{mask_name.format(first + k)}.png", mask)
    world = layouts.camera_world()
    np.savez(folder / "poses.npz", thetas=world.thetas, trans=world.trans, betas=BETAS)


def _imported(folder: Path, **more: object) -> Capture:
    options = ImportOptions(
        body=str(layouts.body_file(folder)), poses=folder / "poses.npz", intrinsics=(77, 77, WIDTH / 2, HEIGHT / 2),
        **{"masks": folder / "masks"} | more,
    )  # fmt: skip
    import_source(folder / "frames", folder / "out", options)
    return load_capture(folder / "out")


@pytest.mark.parametrize(
    ("frame_name", "mask_name"), [("{:05d}", "{:05d}"), ("{:05d}", "mask_{:d}"), ("f{:d}.me", "f{:d}.me")]
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
    with pytest.raises(InputError, match=expected):
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


@pytest.mark.parametrize("given", [(0.1,), (0.1, 0, 0, float("nan")), (0.0,) * 6])
def test_a_distortion_that_opencv_does_not_know_is_refused(tmp_path, given) -> None:
    _write(tmp_path)
    with pytest.raises(InputError, match=r"--distortion: expected k1 k2 p1 p2 \[k3 …\], as OpenCV has them"):
        _imported(tmp_path, distortion=given)
