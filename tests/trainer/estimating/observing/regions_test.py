"""Regions: rotation, crops and their inverse."""

import cv2
import numpy as np
import pytest

from rnd_trainer.estimating.observing.regions import Region, Shrunk, crop, moved, uncrop


@pytest.mark.parametrize("top, degrees", [((0, -1), 0), ((1, 0), 90), ((0, 1), 180), ((-1, -1), -45)])
def test_a_body_region_is_rotated_so_that_the_top_is_up(top: tuple[float, float], degrees: float) -> None:
    centre = np.array([200.0, 150.0])
    across = 40 * np.array(top) / np.hypot(*top)
    region = Region.of_body(centre, centre + across)
    assert np.degrees(region.rotation) % 360 == pytest.approx(degrees % 360)
    assert region.size == pytest.approx(2 * 1.25 * 40)
    up = moved(np.array([[128.0, 128.0], [128.0, 28.0]]), region.to_image(256))
    np.testing.assert_allclose(up[0], centre)
    np.testing.assert_allclose((up[1] - up[0]) / np.linalg.norm(up[1] - up[0]), across / 40, atol=1e-9)


@pytest.mark.parametrize("size, side", [(300.0, 256), (900.0, 224), (120.0, 256)])
def test_a_dot_is_where_the_matrix_says(size: float, side: int) -> None:
    image = np.zeros((1000, 800, 3), np.uint8)
    at = np.array([410.5, 520.5])  # the centre of pixel (410, 520)
    cv2.circle(image, (410, 520), 12, (255, 255, 255), -1)
    region = Region(400.0, 500.0, size, 0.4)
    pixels = Shrunk(image, region.size, side).crop(region, side)[..., 0]
    rows, columns = np.indices(pixels.shape)
    middle = np.array([(columns * pixels).sum(), (rows * pixels).sum()]) / pixels.sum() + 0.5
    np.testing.assert_allclose(moved(middle[None], region.to_image(side))[0], at, atol=0.3)


def test_what_is_cropped_comes_back_to_where_it_was() -> None:
    rng = np.random.default_rng(0)
    image = cv2.GaussianBlur(rng.uniform(size=(200, 240)).astype(np.float32), (0, 0), 6)
    region = Region(120.0, 100.0, 110.0, -0.6)
    matrix = region.to_image(256)
    back = uncrop(np.asarray(crop(image, matrix, 256), np.float32), matrix, (240, 200))
    inside = uncrop(np.ones((256, 256), np.float32), matrix, (240, 200)) > 0.999
    assert inside.sum() > 8000
    assert np.abs(back - image)[inside].max() < 0.01


def test_overlap() -> None:
    one = Region(0, 0, 10)
    assert one.overlap(one) == 1
    assert one.overlap(Region(5, 0, 10)) == pytest.approx(1 / 3)
    assert one.overlap(Region(20, 0, 10)) == 0
