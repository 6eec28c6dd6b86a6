"""Gradients: the kernel against the torch reference in float64, the reference against differences of the oracle."""

import numpy as np
import pytest
import torch

from rnd_runtime.core.camera import Camera
from rnd_runtime.core.errors import InputError
from rnd_runtime.raster import oracle
from rnd_trainer.render import raster, raster_reference
from support.raster_scenes import off_centre_camera, random_scene

SAME_SUM = 1e-12  # float64, the same terms in another order
DIFFERENCES = 1e-6  # central differences in float64, step 1e-5: relative
GRADIENT = 2e-5  # float32 kernel against float64, relative L2; measured 1e-6 … 3e-6


def tensors(scene, dtype):
    return [torch.tensor(array, dtype=dtype, requires_grad=True) for array in scene]


def incoming(shapes, seed=3):
    rng = np.random.default_rng(seed)
    return [torch.from_numpy(rng.normal(size=shape)) for shape in shapes]


def kernel_and_reference_gradients(scene, camera, *, depth):
    ours, truth = tensors(scene, torch.float32), tensors(scene, torch.float64)
    images = [p for p in raster.rasterize(*ours, camera, depth=depth) if p is not None]
    expected = raster_reference.rasterize(*truth, camera)[: len(images)]
    weights = incoming([image.shape for image in expected])
    sum((p * w.float()).sum() for p, w in zip(images, weights)).backward()
    sum((p * w).sum() for p, w in zip(expected, weights)).backward()
    return [t.grad.double() for t in ours], [t.grad for t in truth]


@pytest.mark.parametrize("size", [(64, 48), (37, 53), (1, 1)])
def test_reference_equals_the_oracle(size):
    scene, camera = random_scene(1), off_centre_camera(*size)
    scene = tuple(array.astype(np.float64) for array in scene)
    images, truth = raster_reference.rasterize(*tensors(scene, torch.float64), camera), None
    truth = oracle.rasterize(*scene, camera)
    for image, expected in zip(images, (truth.image, truth.alpha, truth.depth)):
        np.testing.assert_allclose(image.detach(), expected, atol=SAME_SUM)


def test_reference_gradient_is_that_of_the_oracle():
    """Five Gaussians that cover every pixel: no discontinuities."""
    means, covariances, opacities, features = (a.astype(np.float64) for a in random_scene(2, 5, 2, spread=0.2))
    covariances += [1.0, 0, 0, 1.0, 0, 1.0]
    scene = means, covariances, 0.2 + 0.4 * opacities, features
    camera = off_centre_camera(14, 10)
    parameters = tensors(scene, torch.float64)
    images = raster_reference.rasterize(*parameters, camera)
    weights = incoming([image.shape for image in images])
    sum((p * w).sum() for p, w in zip(images, weights)).backward()

    def loss(arrays):
        truth = oracle.rasterize(*arrays, camera)
        images = truth.image, truth.alpha, truth.depth
        return sum(float((p * w.numpy()).sum()) for p, w in zip(images, weights))

    for k, parameter in enumerate(parameters):
        differences = np.zeros(scene[k].shape)
        for index in np.ndindex(differences.shape):
            moved = [[a.copy() for a in scene] for _ in range(2)]
            moved[0][k][index] += 1e-5
            moved[1][k][index] -= 1e-5
            differences[index] = (loss(moved[0]) - loss(moved[1])) / 2e-5
        scale = np.abs(differences).max()
        np.testing.assert_allclose(parameter.grad, differences, rtol=DIFFERENCES, atol=DIFFERENCES * scale)


@pytest.mark.parametrize(("channels", "depth"), [(1, True), (3, False), (3, True), (7, True), (4, False)])
def test_kernel_gradient_is_that_of_the_reference(channels, depth):
    scene, camera = random_scene(channels, 150, channels), off_centre_camera(70, 50)
    for ours, truth in zip(*kernel_and_reference_gradients(scene, camera, depth=depth)):
        assert torch.linalg.vector_norm(ours - truth) <= GRADIENT * torch.linalg.vector_norm(truth)


def test_kernel_gradient_from_inside_the_cloud():
    """Clamped Jacobians, means far outside the image, saturated pixels."""
    scene = random_scene(5, 400, spread=0.4, size=0.1)
    camera = off_centre_camera(60, 44, eye=(0.02, 0.01, 0.03))
    points = oracle.camera_points(scene[0], camera)
    slopes = points[:, :2] / points[:, 2:]
    seen = (points[:, 2] > 0.01) & (np.abs(slopes - oracle.clamped_slopes(points, camera)) > 0).any(axis=1)
    ours, truth = kernel_and_reference_gradients(scene, camera, depth=True)
    assert truth[0][torch.from_numpy(seen)].abs().max() > 0  # a clamped Gaussian reaches the image
    for a, b in zip(ours, truth):
        assert torch.linalg.vector_norm(a - b) <= GRADIENT * torch.linalg.vector_norm(b)


def test_no_gradient_through_a_clamped_alpha():
    """One pixel at the centre of an opaque Gaussian: α stays 0.99, the colour has a gradient."""
    camera = Camera(1, 1, np.array([[10.0, 0, 0.5], [0, 10, 0.5], [0, 0, 1]]), np.eye(4))
    scene = ([[0.0, 0, 2]], [[0.1, 0, 0, 0.1, 0, 0.1]], [1.0], [[0.3, 0.7]])
    means, covariances, opacities, features = tensors(scene, torch.float32)
    image, alpha, _ = raster.rasterize(means, covariances, opacities, features, camera)
    (image.sum() + alpha.sum()).backward()
    assert alpha.item() == pytest.approx(0.99, rel=1e-6)
    assert not means.grad.any() and not covariances.grad.any() and not opacities.grad.any()
    np.testing.assert_allclose(features.grad, [[0.99, 0.99]], rtol=1e-6)


def test_depth_is_optional():
    scene, camera = random_scene(0), off_centre_camera(20, 16)
    means, covariances, opacities, features = tensors(scene, torch.float64)
    image, alpha, depth = raster.rasterize(means.detach(), covariances.detach(), opacities.detach(), features, camera)
    assert depth is None and image.dtype == alpha.dtype == torch.float32
    image.sum().backward()  # alpha unused: its gradient is None inside
    assert features.grad.dtype == torch.float64 and features.grad.any()


def test_missing_gsplat_names_the_extra(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "gsplat", None)
    with pytest.raises(InputError, match=r"rnd-avatar\[cuda\]"):
        raster._rasterize_cuda(*tensors(random_scene(0), torch.float32), off_centre_camera(8, 8), False)
