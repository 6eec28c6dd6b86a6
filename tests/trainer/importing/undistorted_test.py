"""Videos without the distortion of their lens."""

from __future__ import annotations

from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from rnd_runtime.core.errors import InputError
from rnd_trainer.importing.videos.undistorted import undistorted

LENS = (300.0, 310.0, 161.0, 118.0)
DISTORTION = (-0.25, 0.1, 0.002, -0.001)


def _dot(x: float, y: float) -> np.ndarray:
    """An image with a soft dot around a position, pixel centres at +0.5."""
    columns, rows = np.meshgrid(np.arange(320) + 0.5, np.arange(240) + 0.5)
    spot = 255 * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / 18)
    return np.repeat(spot[..., None], 3, axis=2).astype(np.uint8)


def test_a_point_moves_to_where_a_pinhole_sees_it() -> None:
    at = np.array([40.0, 60.0])
    K = np.array([[LENS[0], 0, LENS[2]], [0, LENS[1], LENS[3]], [0, 0, 1]])
    expected = cv2.undistortPoints(at.reshape(1, 1, 2), K, np.array(DISTORTION), P=K).ravel()
    video = SimpleNamespace(width=320, height=240, fps=30.0, numbers=[7], frame=lambda number: _dot(*at))
    straight = undistorted(video, LENS, DISTORTION)
    seen = straight.frame(7)[..., 0].astype(float)
    columns, rows = np.meshgrid(np.arange(320) + 0.5, np.arange(240) + 0.5)
    found = [(seen * grid).sum() / seen.sum() for grid in (columns, rows)]
    assert np.linalg.norm(expected - at) > 5
    np.testing.assert_allclose(found, expected, atol=0.3)
    assert (straight.fps, straight.numbers) == (30.0, [7])


def test_without_distortion_it_is_the_video_itself() -> None:
    video = SimpleNamespace()
    assert undistorted(video, (), ()) is video


def test_distortion_needs_the_lens() -> None:
    with pytest.raises(InputError, match="--intrinsics"):
        undistorted(SimpleNamespace(), (), DISTORTION)
