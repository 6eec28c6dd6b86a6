"""The numba kernel against the oracle, to the bit between runs and threads, and on what is degenerate."""

import numba
import numpy as np
import pytest

from rnd_runtime.core.camera import Camera
from rnd_runtime.core.errors import InputError
from rnd_runtime.raster import cpu as raster_cpu
from rnd_runtime.raster import oracle
from rnd_runtime.raster.outline import sharpened
from support.raster_scenes import off_centre_camera, random_scene

PSNR = 115.0  # dB to the oracle; measured 135–150
PICTURES = ("image", "alpha", "depth")


def psnr(picture, truth):
    """Against a peak of 1, or of the truth where that is larger (depths in metres)."""
    peak = max(1.0, float(np.abs(truth).max(initial=0)))
    return -10 * np.log10(np.mean((picture - truth) ** 2) / peak**2 + 1e-30)


def assert_agree(scene, camera, at_least=PSNR):
    ours, truth = raster_cpu.rasterize(*scene, camera), oracle.rasterize(*scene, camera)
    for name in PICTURES:
        picture, expected = getattr(ours, name), getattr(truth, name)
        assert picture.dtype == np.float32 and picture.shape == expected.shape
        assert psnr(picture, expected) >= at_least, name
    return truth


def gradients(scene, camera, seed=9):
    raster, state = raster_cpu.forward(*scene, camera)
    rng = np.random.default_rng(seed)
    incoming = [rng.normal(size=getattr(raster, name).shape).astype(np.float32) for name in PICTURES]
    return raster, raster_cpu.backward(state, *incoming)


@pytest.mark.parametrize("size", [(1, 1), (4096, 1), (1, 4096), (37, 53), (64, 48), (16, 16)])
@pytest.mark.parametrize("channels", [1, 3, 7])
def test_agrees_with_the_oracle(size, channels):
    truth = assert_agree(random_scene(channels, 200, channels), off_centre_camera(*size))
    assert truth.alpha.any()


def test_agrees_from_inside_the_cloud():
    """Gaussians behind, beside and just in front of the camera: the clamped Jacobian and the near plane."""
    scene = random_scene(3, 600, spread=0.3, size=0.03)
    truth = assert_agree(scene, off_centre_camera(80, 60, eye=(0.02, 0.01, 0.03)))
    assert truth.alpha.mean() > 0.5


def test_agrees_on_needles_and_discs():
    """Flat and thin to one part in a million of the variance, at any angle."""
    means, _, opacities, features = random_scene(4)
    rng = np.random.default_rng(4)
    turns, _ = np.linalg.qr(rng.normal(size=(150, 3, 3)))
    variances = np.where(rng.uniform(size=(150, 1)) < 0.5, [1e-2, 1e-2, 1e-8], [4e-2, 1e-8, 1e-8])
    full = np.einsum("nij,nj,nkj->nik", turns, variances, turns)
    upper = full[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]].astype(np.float32)
    assert_agree((means, upper, opacities, features), off_centre_camera(90, 70))


def test_huge_gaussians_are_drawn():
    means, covariances, opacities, features = random_scene(5, 20)
    covariances[::2] *= 1e10
    truth = assert_agree((means, covariances, opacities, features), off_centre_camera(40, 30))
    assert truth.alpha.min() > 0.5


def test_nearly_equal_depths_are_told_apart():
    """float32's next depth behind 1 m, in a scene 50 m deep; the nearer one comes last in the arrays."""
    near, far = np.float32(1), np.nextafter(np.float32(1), np.float32(2))
    means = np.array([[0, 0, 50], [0, 0, far], [0, 0, near]], np.float32)
    covariances = np.array([[1e-4, 0, 0, 1e-4, 0, 1e-4]] * 3, np.float32)
    camera = Camera(9, 9, np.array([[100.0, 0, 4.5], [0, 100, 4.5], [0, 0, 1]]), np.eye(4))
    image = raster_cpu.rasterize(
        means, covariances, np.full(3, 0.9, np.float32), np.eye(3, dtype=np.float32), camera
    ).image
    np.testing.assert_allclose(image[4, 4], [0.009, 0.09, 0.9], rtol=1e-5)
    means[1:] = means[2]  # equal depths: the first in the arrays is in front
    image = raster_cpu.rasterize(
        means, covariances, np.full(3, 0.9, np.float32), np.eye(3, dtype=np.float32), camera
    ).image
    np.testing.assert_allclose(image[4, 4], [0.009, 0.9, 0.09], rtol=1e-5)


@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="one thread only")
def test_same_bits_for_any_number_of_threads():
    scene, camera = random_scene(7, 1500, 5), off_centre_camera(150, 110)
    threads = numba.get_num_threads()
    results = []
    try:
        for count in (1, 2, 2):
            numba.set_num_threads(count)
            results.append(gradients(scene, camera))
    finally:
        numba.set_num_threads(threads)
    (raster, grads), *others = results
    assert any(grad.any() for grad in grads)
    for other, other_grads in others:
        for name in PICTURES:
            np.testing.assert_array_equal(getattr(raster, name), getattr(other, name))
        for grad, other_grad in zip(grads, other_grads):
            np.testing.assert_array_equal(grad, other_grad)


def test_what_is_degenerate_is_not_drawn_and_gets_no_gradient():
    """The same bits as without those rows."""
    scene, camera = random_scene(8, 60), off_centre_camera(60, 40)
    expected, expected_grads = gradients(scene, camera)
    nan, inf = np.nan, np.inf
    good = (0.0, 0.0, 0.0), (0.01, 0, 0, 0.01, 0, 0.01), 0.5, (1.0, 1.0, 1.0)
    behind = tuple(camera.position - (camera.world_to_camera[2, :3]))
    bad = [
        ((nan, 0, 0), *good[1:]),
        ((0, inf, 0), *good[1:]),
        (behind, *good[1:]),
        (tuple(camera.position), *good[1:]),
        (good[0], (0,) * 6, *good[2:]),
        (good[0], (nan,) * 6, *good[2:]),
        (good[0], (inf,) * 6, *good[2:]),
        (good[0], (0.01, nan, 0, 0.01, 0, 0.01), *good[2:]),
        (good[0], (0.01, 0.2, 0, 0.01, 0, 0.01), *good[2:]),  # indefinite
        (*good[:2], nan, good[3]),
        (*good[:2], inf, good[3]),
        (*good[:2], -1.0, good[3]),
        (*good[:2], 0.0, good[3]),
        (*good[:3], (1.0, nan, 1.0)),
        (*good[:3], (1.0, -inf, 1.0)),
    ]
    rows = [np.array(column, np.float32) for column in zip(*bad)]
    mixed = tuple(np.concatenate([row, array]) for row, array in zip(rows, scene))
    raster, grads = gradients(mixed, camera)
    for name in PICTURES:
        np.testing.assert_array_equal(getattr(raster, name), getattr(expected, name))
    for grad, expected_grad in zip(grads, expected_grads):
        assert not grad[: len(bad)].any()
        np.testing.assert_array_equal(grad[len(bad) :], expected_grad)
        assert np.isfinite(grad).all()


@pytest.mark.parametrize("n", [0, 5])
def test_nothing_in_view_gives_zeros(n):
    """No Gaussians, or all of them behind the camera."""
    scene = random_scene(1, n, 2)
    camera = off_centre_camera(20, 10)
    scene = (scene[0] - 10 * camera.world_to_camera[2, :3].astype(np.float32), *scene[1:])
    raster, grads = gradients(scene, camera)
    assert raster.image.shape == (10, 20, 2) and raster.alpha.shape == raster.depth.shape == (10, 20)
    assert not raster.image.any() and not raster.alpha.any() and not raster.depth.any()
    assert [grad.shape for grad in grads] == [(n, 3), (n, 6), (n,), (n, 2)]
    assert not any(grad.any() for grad in grads)


def test_depth_is_optional():
    scene, camera = random_scene(2), off_centre_camera(40, 30)
    full = raster_cpu.rasterize(*scene, camera)
    raster, state = raster_cpu.forward(*scene, camera, depth=False)
    np.testing.assert_array_equal(raster.image, full.image)
    np.testing.assert_array_equal(raster.alpha, full.alpha)
    assert not raster.depth.any()
    grads = raster_cpu.backward(state, np.ones_like(raster.image), np.ones_like(raster.alpha))
    _, state = raster_cpu.forward(*scene, camera)
    with_depth = raster_cpu.backward(
        state, np.ones_like(raster.image), np.ones_like(raster.alpha), np.zeros_like(raster.depth)
    )
    for grad, other in zip(grads, with_depth):
        np.testing.assert_array_equal(grad, other)


def test_outlines_are_sharp_where_asked_for():
    scene, camera = random_scene(2), off_centre_camera(40, 30)
    expected = sharpened(raster_cpu.rasterize(*scene, camera, depth=False))
    ours = raster_cpu.rasterize(*scene, camera, depth=False, outlines=True)
    for name in PICTURES:
        np.testing.assert_array_equal(getattr(ours, name), getattr(expected, name))
    assert ((ours.alpha > 0.1) & (ours.alpha < 0.9)).any()


def test_only_visible_gaussians_are_rendered():
    scene, camera = random_scene(2), off_centre_camera(40, 30)
    visible = np.arange(len(scene[0])) % 3 > 0
    expected = raster_cpu.rasterize(*(array[visible] for array in scene), camera)
    np.testing.assert_array_equal(raster_cpu.rasterize(*scene, camera, visible=visible).image, expected.image)
    with pytest.raises(InputError, match="chosen Gaussians: expected shape"):
        raster_cpu.rasterize(*scene, camera, visible=visible[1:])


def test_other_layouts_and_types_are_taken():
    scene, camera = random_scene(2), off_centre_camera(40, 30)
    expected = raster_cpu.rasterize(*scene, camera)
    others = [np.asfortranarray(array.astype(np.float64)) for array in scene]
    for array in others:
        array.flags.writeable = False
    np.testing.assert_array_equal(raster_cpu.rasterize(*others, camera).image, expected.image)


@pytest.mark.parametrize(("wrong", "name"), [(0, "means"), (1, "covariances"), (2, "opacities"), (3, "features")])
def test_wrong_shapes_are_refused(wrong, name):
    scene = list(random_scene(0, 10))
    scene[wrong] = scene[wrong][:-1] if wrong else scene[wrong][:, :2]
    with pytest.raises(InputError, match=f"^{name}: expected shape"):
        raster_cpu.rasterize(*scene, off_centre_camera(8, 8))


def test_shapes_that_kernels_would_read_beyond_are_refused():
    scene, camera = random_scene(0, 10), off_centre_camera(8, 6)
    raster, state = raster_cpu.forward(*scene, camera)
    for wrong in range(3):
        grads = [raster.image, raster.alpha, raster.depth]
        grads[wrong] = grads[wrong][:-1]
        with pytest.raises(InputError, match="gradient of "):
            raster_cpu.backward(state, *grads)
