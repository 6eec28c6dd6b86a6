"""Optical flow of a person: known motions, and what is left out."""

import cv2
import numpy as np
import pytest

from rnd_trainer.estimating.flow import CELLS, Flow, flow_of

SIZE = 240


def disc(texture: bool, shift: tuple[float, float] = (0, 0), degrees: float = 0) -> tuple[np.ndarray, np.ndarray]:
    """A disc at the image's middle, moved: image [SIZE, SIZE, 3], mask."""
    rng = np.random.default_rng(3)
    noise = cv2.GaussianBlur(rng.normal(size=(SIZE, SIZE, 1)).astype(np.float32), (0, 0), 2)
    plain = 128 + (300 * noise[..., None] if texture else 0 * noise[..., None])
    y, x = np.mgrid[:SIZE, :SIZE] - SIZE / 2
    mask = np.where(np.hypot(x, y) < 80, 255, 0).astype(np.uint8)
    image = np.where(mask[..., None] > 0, np.clip(plain, 0, 255), 30).repeat(3, -1)[..., :3].astype(np.uint8)
    matrix = cv2.getRotationMatrix2D((SIZE / 2, SIZE / 2), degrees, 1.0)
    matrix[:, 2] += shift
    moved, moved_mask = (cv2.warpAffine(a, matrix, (SIZE, SIZE), flags=cv2.INTER_LINEAR) for a in (image, mask))
    return moved, moved_mask


def test_a_known_motion_is_found_inside_the_mask_alone() -> None:
    degrees, shift = 4.0, (5.0, -3.0)
    images, masks = zip(disc(True), disc(True, shift, degrees))
    flow = flow_of(images.__getitem__, masks, 15.0)[0]
    angle = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    inside = SIZE / 2 + 55 * np.stack([np.cos(angle), np.sin(angle)], 1)
    cos, sin = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    expected = (inside - SIZE / 2) @ np.array([[cos, -sin], [sin, cos]]) - (inside - SIZE / 2) + shift
    found = flow.at(0, inside)
    assert np.isfinite(found).all(1).mean() > 0.9
    known = np.isfinite(found).all(1)
    assert np.median(np.linalg.norm(found - expected, axis=1)[known]) < 0.25
    outside = SIZE / 2 + 95 * np.stack([np.cos(angle), np.sin(angle)], 1)
    assert np.isnan(flow.at(0, outside)).all()


def test_what_has_no_texture_or_is_gone_is_unknown() -> None:
    images, masks = zip(disc(False), disc(False, (4.0, 0.0)))
    middle = np.array([[SIZE / 2, SIZE / 2]])
    assert np.isnan(flow_of(images.__getitem__, masks, 15.0)[0].at(0, middle)).all()
    images, masks = zip(disc(True), (disc(True)[0], np.zeros((SIZE, SIZE), np.uint8)))
    assert np.isnan(flow_of(images.__getitem__, masks, 15.0)[0].displacement).all()
    images, masks = zip(disc(True), disc(False))  # another surface
    assert np.isnan(flow_of(images.__getitem__, masks, 15.0)[0].at(0, middle)).all()


@pytest.mark.parametrize("count", [0, 1])
def test_fewer_than_two_frames_have_none(count: int) -> None:
    image, mask = disc(True)
    flows = flow_of(lambda k: image, [mask] * count, 15.0)
    assert [flow.displacement.shape for flow in flows] == 2 * [(0, CELLS, CELLS, 2)]


@pytest.mark.parametrize(("rate", "gaps"), [(5.0, [1]), (15.0, [1, 2]), (30.0, [2, 4]), (60.0, [4, 8]), (240.0, [8])])
def test_gaps_are_of_the_same_times_at_any_rate(rate: float, gaps: list[int]) -> None:
    """Frame k is moved by k pixels."""
    images, masks = zip(*(disc(True, (k, 0.0)) for k in range(9)))
    flows = flow_of(images.__getitem__, masks, rate)
    assert [flow.gap for flow in flows] == gaps
    for flow in flows:
        assert len(flow.boxes) == len(flow.displacement) == 9 - flow.gap
        np.testing.assert_allclose(flow.at(0, np.array([[SIZE / 2, SIZE / 2]])), [[flow.gap, 0]], atol=0.1)


def test_cells_are_found_by_pixels_of_the_image() -> None:
    displacement = np.full((1, CELLS, CELLS, 2), np.nan, np.float16)
    displacement[0, 32:34, 64] = 3, -2
    displacement[0, 32:34, 65] = 5, -2
    flow = Flow(1, np.array([[100.0, 50, 100 + 2 * CELLS, 50 + 4 * CELLS]]), displacement)
    centre = np.array([100 + 2 * 64.5, 50 + 4 * 32.5])
    np.testing.assert_allclose(flow.at(0, centre[None] + [[1.0, 0.0]]), [[4, -2]], atol=0.05)
    assert np.isnan(flow.at(0, centre[None] + [[0.0, 4.0]])).all()
    assert np.isnan(flow.at(0, np.array([[0.0, 0.0]]))).all()
