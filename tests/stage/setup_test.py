"""The stage's lights, cameras and estimates."""

from __future__ import annotations

import numpy as np
import pytest

mi = pytest.importorskip("mitsuba")
pytest.importorskip("skimage")
mi.set_variant("scalar_rgb")

from rnd_stage.film import estimates  # noqa: E402
from rnd_stage.film.cameras import ring_cameras  # noqa: E402


def test_cameras_are_on_three_rings_and_show_the_whole_person() -> None:
    cameras = ring_cameras(30, 128)
    assert len(cameras) == 30
    heights = {round(float(camera.position[1]), 3) for camera in cameras.values()}
    assert len(heights) == 3
    assert abs(cameras["cam00"].position[0]) < 1e-9 and cameras["cam00"].position[2] > 4
    places = np.array([camera.position for camera in cameras.values()])
    assert min(np.linalg.norm(a - b) for i, a in enumerate(places) for b in places[:i]) > 0.3
    for camera in cameras.values():
        for point in ([0, 0, 0], [0, 1.8, 0], [0.6, 1.8, 0], [-0.6, 1.8, 0.2]):
            pixel = camera.K @ (camera.world_to_camera[:3, :3] @ point + camera.world_to_camera[:3, 3])
            assert (pixel[:2] / pixel[2] > 0).all() and (pixel[:2] / pixel[2] < 128).all()
    assert len(ring_cameras(1, 16)) == 1


def test_estimates_are_the_truth_at_strength_zero_and_the_same_for_a_seed(production) -> None:
    rng = np.random.default_rng(0)
    normals = np.zeros((64, 64, 3))
    normals[..., 2] = -1
    coverage = np.zeros((64, 64))
    coverage[16:48, 20:44] = 1
    np.testing.assert_allclose(
        estimates.estimated_normals(normals, coverage, 1, 0.0)[coverage > 0], normals[coverage > 0], atol=1e-6
    )
    np.testing.assert_array_equal(estimates.estimated_mask(coverage, 1, 0.0), coverage)
    motion = production.motion
    still = estimates.estimated_motion(motion, 1, 0.0)
    np.testing.assert_allclose(still.rotations, motion.rotations, atol=1e-12)
    a, b, c = (estimates.estimated_normals(normals, coverage, seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(a, b)
    assert np.abs(a - c).max() > 0.05
    angle = np.degrees(np.arccos(np.clip(-a[coverage > 0][:, 2], -1, 1)))
    assert 3 < angle.mean() < 20
    mask = estimates.estimated_mask(np.kron(coverage, np.ones((8, 8))), 1)
    truth = np.kron(coverage, np.ones((8, 8))) > 0.5
    iou = ((mask > 0.5) & truth).sum() / ((mask > 0.5) | truth).sum()
    assert 0.9 < iou < 0.995
    drift = estimates.estimated_motion(motion, 1).translations - motion.translations
    assert 0.002 < drift.std() < 0.04
    assert not np.array_equal(drift, rng.normal(size=drift.shape))
