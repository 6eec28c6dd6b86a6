"""What is seen of a person beside others."""

from __future__ import annotations

import cv2
import numpy as np

from rnd_trainer.estimating.observing.observe import _apart, _outside


def disc(x: int) -> np.ndarray:
    return cv2.GaussianBlur(cv2.circle(np.zeros((100, 140), np.uint8), (x, 50), 30, 255, -1), (0, 0), 2)


def test_a_mask_ends_where_somebody_else_begins() -> None:
    mine, theirs = disc(40), disc(85)
    spilled = np.maximum(mine, np.where(np.arange(140) < 85, theirs, 0).astype(np.uint8))
    mask, hidden = _apart(spilled, mine, [np.zeros_like(mine), theirs])
    assert (mask > 127)[mine > 127].all() and mask[:, 75:].max() < 128
    assert hidden[50, 72:85].min() == 255 and hidden[:, :50].max() == 0 and hidden[:, 110:].max() == 0
    assert not (np.minimum(mask, hidden) > 127).any()
    alone, nothing = _apart(spilled, mine, [])
    assert alone is spilled and not nothing.any()


def test_distances_from_the_person_go_on_beyond_the_image() -> None:
    points = np.array([[[40.5, 50.5], [100.5, 50.5], [4.5, 2.5], [200.0, 50.5]]])
    expected = np.maximum(np.hypot(points[..., 0] - 40.5, points[..., 1] - 50.5) - 30, 0)
    np.testing.assert_allclose(_outside(disc(40), points), expected, atol=2)
    assert not _outside(np.zeros((100, 140), np.uint8), points).any()
