"""The camera by its background: sway is taken out, cuts and walks are refused."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_trainer.estimating.observing.camera_motion import steady

SIZE = (320, 240)  # width, height
FOCAL = 330.0
COUNT = 16


class Clip:
    def __init__(self, images: list[np.ndarray]) -> None:
        self.images, self.numbers = images, range(len(images))
        self.width, self.height = SIZE

    def frame(self, number: int) -> np.ndarray:
        return self.images[number]


def texture(seed: int, size: tuple[int, int] = (640, 480)) -> np.ndarray:
    rng = np.random.default_rng(seed)
    noise = rng.uniform(size=(size[1], size[0], 3)).astype(np.float32)
    blurred = sum(cv2.GaussianBlur(noise, (0, 0), s) * s for s in (2, 6, 20))
    low, high = blurred.min(), blurred.max()
    return (255 * (blurred - low) / (high - low)).astype(np.uint8)


def seen(world: np.ndarray, homography: np.ndarray) -> np.ndarray:
    """The middle of ``world`` [480, 640, 3] through a homography of the image."""
    centre = np.array([[1, 0, 160], [0, 1, 120], [0, 0, 1.0]])
    return cv2.warpPerspective(world, np.linalg.inv(centre @ np.linalg.inv(homography)), SIZE)


def with_person(image: np.ndarray, k: int) -> np.ndarray:
    """A moving block in front, on a sixth of the image."""
    image = image.copy()
    left = 100 + 4 * k
    image[60:220, left : left + 70] = texture(9)[60:220, left : left + 70]
    return image


def rotated(angles: np.ndarray) -> np.ndarray:
    lens = np.array([[FOCAL, 0, 160], [0, FOCAL, 120], [0, 0, 1.0]])
    return lens @ axis_angle_to_matrix(angles) @ np.linalg.inv(lens)


def sway(k: int) -> np.ndarray:
    return 0.012 * np.array([np.sin(k), np.cos(1.7 * k) - 1, 0.5 * np.sin(0.6 * k)])


def test_hand_held_sway_is_taken_out() -> None:
    world = texture(0)
    clip = Clip([with_person(seen(world, rotated(sway(k))), k) for k in range(COUNT)])
    calm = steady(clip, list(clip.numbers))
    assert calm.moved_px > 3
    inner = np.s_[20:-20, 20:60]
    raw = np.std([clip.frame(k)[inner] for k in clip.numbers], axis=0).mean()
    left = np.std([calm.frame(k)[inner] for k in clip.numbers], axis=0).mean()
    assert left < 0.2 * raw


def test_a_camera_on_a_tripod_is_left_alone() -> None:
    rng = np.random.default_rng(0)
    world = seen(texture(0), np.eye(3)).astype(np.float32)
    images = [np.clip(world + rng.normal(scale=2, size=world.shape), 0, 255).astype(np.uint8) for _ in range(COUNT)]
    clip = Clip([with_person(image, k) for k, image in enumerate(images)])
    calm = steady(clip, list(clip.numbers))
    assert not calm.homographies
    np.testing.assert_array_equal(calm.frame(3), clip.frame(3))


def test_a_plain_wall_counts_as_still() -> None:
    clip = Clip([np.full((SIZE[1], SIZE[0], 3), 128, np.uint8)] * COUNT)
    assert not steady(clip, list(clip.numbers)).homographies


def walking() -> list[np.ndarray]:
    """A near and a far half of the background move by different amounts."""
    far, near = texture(0), texture(1)
    images = []
    for k in range(COUNT):
        image = seen(far, np.array([[1, 0, 1.0 * k], [0, 1, 0], [0, 0, 1.0]]))
        close = seen(near, np.array([[1, 0, 3.2 * k], [0, 1, 0], [0, 0, 1.0]]))
        stripes = (np.arange(SIZE[1]) // 40 % 2).astype(bool)
        image[stripes] = close[stripes]
        images.append(image)
    return images


def zooming() -> list[np.ndarray]:
    grown = [
        np.array([[s, 0, 160 * (1 - s)], [0, s, 120 * (1 - s)], [0, 0, 1.0]]) for s in 1 + 0.015 * np.arange(COUNT)
    ]
    return [seen(texture(0), matrix) for matrix in grown]


def panning() -> list[np.ndarray]:
    return [seen(texture(0), rotated(np.array([0, 0.03 * k, 0]))) for k in range(COUNT)]


@pytest.mark.parametrize("images, words", [(walking, "walks"), (zooming, "zooms"), (panning, "pans")])
def test_other_cameras_are_refused(images, words: str) -> None:
    clip = Clip(images())
    with pytest.raises(InputError, match=words):
        steady(clip, list(clip.numbers))


def test_a_cut_is_named_by_its_frame() -> None:
    first, second = seen(texture(0), np.eye(3)), seen(texture(5), np.eye(3))
    clip = Clip([first] * 7 + [second] * 9)
    with pytest.raises(InputError, match="frame 7: cut in the video"):
        steady(clip, list(clip.numbers))
