"""Each formula of the oracle against finite differences, sampling or a closed form."""

import numpy as np
import pytest

from rnd_runtime.core.camera import Camera
from rnd_runtime.raster import oracle

EXACT = 1e-12  # float64, a few operations
DIFFERENCES = 1e-6  # central differences, step 1e-5, of smooth functions: relative
QUADRATURE = 1e-3  # one sample a pixel of a Gaussian 10 px wide, cut where it jumps by 1/255: relative


def camera(width=64, height=48, *, cx=25.0, cy=30.0):
    view = Camera.look_at([0.4, 0.3, -2.0], [0.1, 0.0, 0.2], width=width, height=height, fov_y=0.7)
    K = view.K.copy()
    K[0, 0] *= 1.2
    K[:2, 2] = cx, cy
    return Camera(width, height, K, view.world_to_camera)


def straight(width, height, focal=100.0):
    """A camera at the origin whose axes are the world's."""
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return Camera(width, height, K, np.eye(4))


def isotropic(*sigmas):
    return np.array([[s * s, 0, 0, s * s, 0, s * s] for s in sigmas])


def test_points_follow_the_pinhole_matrix():
    view, points = camera(), np.random.default_rng(0).normal(size=(20, 3)) * 0.3
    homogeneous = np.c_[points, np.ones(20)] @ view.world_to_camera.T
    in_camera = oracle.camera_points(points, view)
    np.testing.assert_allclose(in_camera, homogeneous[:, :3], atol=EXACT)
    projected = homogeneous[:, :3] @ view.K.T
    pixels = oracle.image_points(in_camera, view)
    np.testing.assert_allclose(pixels, projected[:, :2] / projected[:, 2:], rtol=EXACT)


def test_jacobian_is_the_derivative_of_the_projection():
    view = camera()
    points = oracle.camera_points(np.random.default_rng(1).normal(size=(20, 3)) * 0.2, view)
    jacobians = oracle.projection_jacobians(points, view)
    for axis, step in enumerate(1e-5 * np.eye(3)):
        difference = oracle.image_points(points + step, view) - oracle.image_points(points - step, view)
        np.testing.assert_allclose(jacobians[:, :, axis], difference / 2e-5, rtol=DIFFERENCES, atol=1e-6)


def test_slopes_are_held_inside_the_widened_picture():
    """Left border at −cx/fx, right at (width − cx)/fx, each moved out by 0.3 · half the width / fx."""
    K = np.array([[50.0, 0, 10], [0, 40.0, 30], [0, 0, 1]])
    view = Camera(64, 48, K, np.eye(4))
    points = np.array([[-9.0, -9, 2], [9, 9, 2], [0.1, 0.2, 2]])
    low = -(10 + 0.15 * 64) / 50, -(30 + 0.15 * 48) / 40
    high = (54 + 0.15 * 64) / 50, (18 + 0.15 * 48) / 40
    expected = np.array([low, high, (0.05, 0.1)])
    np.testing.assert_allclose(oracle.clamped_slopes(points, view), expected, rtol=EXACT)
    # outside, the Jacobian is the one of the point on the limit with the same depth
    on_limit = np.c_[expected * 2, [2, 2, 2]]
    np.testing.assert_allclose(
        oracle.projection_jacobians(points, view), oracle.projection_jacobians(on_limit, view), rtol=EXACT
    )


def test_image_covariance_is_that_of_projected_samples():
    rng, view = np.random.default_rng(2), camera()
    axes = rng.normal(size=(3, 3)) * [[2e-3], [5e-3], [1e-3]]
    mean, covariance = np.array([0.05, 0.1, 0.2]), axes.T @ axes
    upper = covariance[np.triu_indices(3)][None]
    samples = mean + rng.normal(size=(200_000, 3)) @ axes
    pixels = oracle.image_points(oracle.camera_points(samples, view), view)
    projected = oracle.image_covariances(mean[None], upper, view)[0] - oracle.DILATION * np.eye(2)
    # 200 000 samples know a variance to 0.3 %; the projection is linear to 0.2 % over 5 mm at 2 m
    np.testing.assert_allclose(np.cov(pixels.T), projected, atol=0.01 * np.trace(projected))


def test_alpha_falls_with_the_mahalanobis_distance():
    covariance = np.array([[9.0, 3.0], [3.0, 5.0]])
    root = np.linalg.cholesky(covariance)
    offsets = np.array([[0, 0], [1, 0], [0, 2]]) @ root.T
    np.testing.assert_allclose(oracle.alphas(offsets, covariance, 0.8), 0.8 * np.exp([0, -0.5, -2.0]), rtol=EXACT)


def test_alpha_is_clamped_and_cut():
    offsets = np.zeros((1, 2))
    assert oracle.alphas(offsets, np.eye(2), 1.0) == 0.99
    assert oracle.alphas(offsets, np.eye(2), 1.001 / 255) == 1.001 / 255
    assert oracle.alphas(offsets, np.eye(2), 0.999 / 255) == 0.0


def test_reach_touches_the_ellipse():
    covariance, opacity = np.array([[9.0, 3.0], [3.0, 5.0]]), 0.7
    half = oracle.reach(covariance, opacity)
    for axis in range(2):  # the ellipse's extreme point along an axis lies where Σ⁻¹d is parallel to it
        extreme = covariance[axis] / covariance[axis, axis] * half[axis]
        assert oracle.alphas(extreme * 0.999, covariance, opacity) > 0
        assert oracle.alphas(extreme * 1.001, covariance, opacity) == 0
        distance = extreme @ np.linalg.inv(covariance) @ extreme
        assert opacity * np.exp(-0.5 * distance) == pytest.approx(1 / 255, rel=EXACT)


def test_blending_stops_before_the_transmittance_falls_below_its_limit():
    transmittance, weights = np.ones(1), []
    for alpha in (0.99, 0.98, 0.6, 0.1):  # 1 → 0.01 → 2e-4 → would be 8e-5; 0.1 alone would leave 1.8e-4
        weight, transmittance = oracle.blend(transmittance, np.array([alpha]))
        weights.append(weight[0])
    np.testing.assert_allclose(weights, [0.99, 0.0098, 0, 0], rtol=1e-10)


def test_two_clamped_gaussians_are_both_drawn():
    """They leave (1 − 0.99)², which is 1e-4 in numbers and either side of it in floats."""
    _, left = oracle.blend(np.ones(1), np.array([0.99]))
    assert oracle.blend(left, np.array([0.99]))[0] == pytest.approx(0.0099)
    assert oracle.blend(left, np.array([0.99], np.float32))[0] == pytest.approx(0.0099)


def test_equal_depths_keep_their_order():
    depths = np.tile([2.0, 1.0], 500)
    assert oracle.front_to_back(depths).tolist() == [*range(1, 1000, 2), *range(0, 1000, 2)]


def test_one_gaussian_has_closed_form_moments():
    """Volume 2π√det·(o − 1/255); second moment Σ'·2π√det·(o − (1 + ln 255o)/255)."""
    view = straight(200, 160)
    mean, opacity = np.array([[0.07, -0.04, 2.0]]), np.array([0.6])
    upper = np.array([[0.05, 0.02, 0, 0.03, 0, 0.01]])
    raster = oracle.rasterize(mean, upper, opacity, np.array([[0.25, 2.0]]), view)
    shape = oracle.image_covariances(mean, upper, view)[0]
    scale = 2 * np.pi * np.sqrt(np.linalg.det(shape))
    volume = raster.alpha.sum()
    assert volume == pytest.approx(scale * (0.6 - 1 / 255), rel=QUADRATURE)
    y, x = np.mgrid[:160, :200] + 0.5
    centre = np.array([(raster.alpha * x).sum(), (raster.alpha * y).sum()]) / volume
    np.testing.assert_allclose(centre, [100 + 3.5, 80 - 2.0], rtol=QUADRATURE)
    d = np.stack([x - 103.5, y - 78.0])
    second = np.einsum("ihw,jhw,hw->ij", d, d, raster.alpha)
    expected = shape * scale * (0.6 - (1 + np.log(255 * 0.6)) / 255)
    np.testing.assert_allclose(second, expected, rtol=5 * QUADRATURE)
    np.testing.assert_allclose(raster.image, raster.alpha[..., None] * [0.25, 2.0], rtol=EXACT)
    np.testing.assert_allclose(raster.depth, raster.alpha * 2.0, rtol=EXACT)


def test_the_nearer_of_two_covers_the_farther():
    view = straight(9, 9)  # the mean falls on the centre of pixel (4, 4)
    means, sizes = np.array([[0, 0, 3.0], [0, 0, 2.0]]), isotropic(0.2, 0.1)
    raster = oracle.rasterize(means, sizes, np.array([0.5, 0.8]), np.eye(2), view)
    np.testing.assert_allclose(raster.image[4, 4], [0.2 * 0.5, 0.8], rtol=EXACT)
    assert raster.alpha[4, 4] == pytest.approx(0.9, rel=EXACT)
    assert raster.depth[4, 4] == pytest.approx(0.8 * 2 + 0.1 * 3, rel=EXACT)


def test_boxes_leave_nothing_out():
    """The same sum with every Gaussian evaluated at every pixel."""
    rng, view = np.random.default_rng(5), camera()
    means, opacities = rng.normal(size=(60, 3)) * 0.4, rng.uniform(0, 1, 60)
    axes = rng.normal(size=(60, 3, 3)) * 0.05
    upper = (axes @ axes.transpose(0, 2, 1))[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    raster = oracle.rasterize(means, upper, opacities, np.ones((60, 1)), view)
    points = oracle.camera_points(means, view)
    pixels, shapes = oracle.image_points(points, view), oracle.image_covariances(means, upper, view)
    grid = np.stack(np.meshgrid(np.arange(64) + 0.5, np.arange(48) + 0.5), axis=-1)
    transmittance, alpha = np.ones((48, 64)), np.zeros((48, 64))
    for i in oracle.front_to_back(points[:, 2]):
        weight, transmittance = oracle.blend(transmittance, oracle.alphas(grid - pixels[i], shapes[i], opacities[i]))
        alpha += weight
    assert 0.2 < alpha.mean() < 0.9  # the scene is neither empty nor full
    np.testing.assert_array_equal(raster.alpha, alpha)


@pytest.mark.parametrize(
    ("mean", "upper", "opacity", "feature"),
    [
        ((0, 0, -2), (0.01, 0, 0, 0.01, 0, 0.01), 0.5, 1.0),
        ((0, 0, 0), (0.01, 0, 0, 0.01, 0, 0.01), 0.5, 1.0),
        ((0, 0, 0.0999), (0.01, 0, 0, 0.01, 0, 0.01), 0.5, 1.0),
        ((0, np.nan, 2), (0.01, 0, 0, 0.01, 0, 0.01), 0.5, 1.0),
        ((0, 0, np.inf), (0.01, 0, 0, 0.01, 0, 0.01), 0.5, 1.0),
        ((0, 0, 2), (0, 0, 0, 0, 0, 0), 0.5, 1.0),
        ((0, 0, 2), (0.01, np.nan, 0, 0.01, 0, 0.01), 0.5, 1.0),
        ((0, 0, 2), (np.inf, 0, 0, 0.01, 0, 0.01), 0.5, 1.0),
        ((0, 0, 2), (0.01, 5, 0, 0.01, 0, 0.01), 0.5, 1.0),
        ((0, 0, 2), (0.01, 0, 0, 0.01, 0, 0.01), 0.9 / 255, 1.0),
        ((0, 0, 2), (0.01, 0, 0, 0.01, 0, 0.01), np.nan, 1.0),
        ((0, 0, 2), (0.01, 0, 0, 0.01, 0, 0.01), 0.5, np.nan),
    ],
)
def test_what_is_not_drawn(mean, upper, opacity, feature):
    rows = np.array([mean, (0, 0, 3)], float), np.array([upper, (0.01, 0, 0, 0.01, 0, 0.01)], float)
    arrays = (*rows, np.array([opacity, 0.5]), np.array([[feature], [1.0]]))
    assert oracle.drawn(*arrays, straight(8, 8)).tolist() == [False, True]
