"""The OpenGL rasteriser against the float64 oracle, on EGL and on OSMesa, and against itself to the bit.

EGL and OSMesa must be installed here (scripts/test does it): a missing one fails.
"""

import hashlib
import os
import subprocess
import sys

import numpy as np
import pytest

from rnd_runtime.core.camera import Camera
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.gaussians import Raster
from rnd_runtime.gl.raster import GlRasterizer
from rnd_runtime.raster import oracle as raster_oracle
from support.paths import ROOT

BACKENDS = ("egl", "osmesa")
AGREEMENT_DB = 85.0  # the figure asked for on dense scenes; what is missing is blending that cannot stop at T < 1e-4
MAX_DIFFERENCE = 2 / 255  # FAILURES G10
EXACT = 2e-5  # where no pixel saturates: Mesa's exp2 and float32 blending of ≤ 100 layers
STOPPED_SHARE = 0.01  # T is at most 0.01 before an α ≤ 0.99 that takes it below 1e-4


@pytest.fixture(scope="module")
def rasterizers():
    made = {backend: GlRasterizer(backend) for backend in BACKENDS}
    yield made
    for rasterizer in made.values():
        rasterizer.close()


@pytest.fixture(autouse=True)
def _no_gl_errors(rasterizers):
    _assert_no_errors(rasterizers)
    yield
    _assert_no_errors(rasterizers)


def _assert_no_errors(rasterizers):
    for rasterizer in rasterizers.values():
        with rasterizer.context:
            assert rasterizer.context.error == "GL_NO_ERROR"


@pytest.fixture(params=BACKENDS)
def rasterize(request, rasterizers):
    return rasterizers[request.param]


def _camera(width=96, height=64, distance=3.0):
    return Camera.look_at([0.3, 0.2, distance], [0, 0, 0], width=width, height=height, fov_y=0.7)


def _scene(count=200, channels=3, *, scale=0.08, opacity=(0.05, 0.6), seed=0):
    """Ellipsoids in a ball of 1 m with axes of about ``scale`` m, one of them a tenth as long."""
    rng = np.random.default_rng(seed)
    axes = rng.normal(size=(count, 3, 3)) * scale * np.array([1, 1, 0.1])
    full = axes @ axes.transpose(0, 2, 1)
    return (
        rng.uniform(-0.8, 0.8, (count, 3)).astype(np.float32),
        full[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]].astype(np.float32),
        rng.uniform(*opacity, count).astype(np.float32),
        rng.uniform(0, 1, (count, channels)).astype(np.float32),
    )


def _pictures(raster: Raster):
    return {"image": raster.image, "alpha": raster.alpha, "depth": raster.depth}


def _assert_same_bits(got, expected):
    for name, picture in _pictures(expected).items():
        np.testing.assert_array_equal(_pictures(got)[name], picture, err_msg=name)


def _assert_close(got, expected, tolerance):
    for name, picture in _pictures(expected).items():
        assert _pictures(got)[name].shape == picture.shape
        assert _pictures(got)[name].dtype == np.float32
        size = 4.0 if name == "depth" else 1.0  # m: the depths of these scenes
        np.testing.assert_allclose(_pictures(got)[name], picture, rtol=0, atol=tolerance * size, err_msg=name)


def _psnr(got, expected):
    return -10 * np.log10(np.mean(np.square(np.asarray(got, np.float64) - expected)))


def test_a_dense_scene_agrees_with_the_oracle(rasterize):
    scene, camera = _scene(600, opacity=(0.1, 1.0)), _camera()
    got, expected = rasterize(*scene, camera), raster_oracle.rasterize(*scene, camera)
    assert expected.alpha.max() > 0.999  # pixels do saturate
    assert _psnr(got.image, expected.image) >= AGREEMENT_DB
    _assert_close(got, expected, MAX_DIFFERENCE)


@pytest.mark.parametrize("channels", [0, 1, 2, 3, 4, 7, 12, 23, 24, 30])
def test_any_number_of_channels(rasterize, channels):
    scene, camera = _scene(80, channels), _camera(40, 30)
    _assert_close(rasterize(*scene, camera), raster_oracle.rasterize(*scene, camera), EXACT)


@pytest.mark.parametrize("channels", [4, 12, 30])
def test_targets_and_passes_equal_separate_calls(rasterize, channels):
    *geometry, features = _scene(80, channels)
    together = rasterize(*geometry, features, _camera())
    for first in range(0, channels, 3):
        alone = rasterize(*geometry, features[:, first : first + 3], _camera())
        np.testing.assert_array_equal(together.image[..., first : first + 3], alone.image)
        np.testing.assert_array_equal(together.alpha, alone.alpha)
        np.testing.assert_array_equal(together.depth, alone.depth)


@pytest.mark.parametrize("size", [(1, 1), (1, 4096), (4096, 1), (37, 61), (511, 3)])
def test_sizes(rasterize, size):
    scene = _scene(60, scale=0.03, opacity=(0.02, 0.12))  # all 60 may lie in one pixel
    camera = _camera(*size)
    _assert_close(rasterize(*scene, camera), raster_oracle.rasterize(*scene, camera), EXACT)


@pytest.mark.parametrize("eye", [[0, 0, 0], [0.1, 0.3, -0.2], [0.4, 0, 0.5]])
def test_a_camera_inside_the_cloud(rasterize, eye):
    # ellipses far larger than the picture, centres far outside: where clipping goes wrong first
    scene = _scene()
    camera = Camera.look_at(eye, [0, 0.2, 1], width=64, height=64, fov_y=0.9)
    _assert_close(rasterize(*scene, camera), raster_oracle.rasterize(*scene, camera), EXACT)


def test_off_centre_principal_point(rasterize):
    scene, camera = _scene(), _camera()
    shifted = Camera(96, 64, camera.K + np.array([[0, 0, 61.3], [0, 7.5, -40.2], [0, 0, 0]]), camera.world_to_camera)
    expected = raster_oracle.rasterize(*scene, shifted)
    assert expected.alpha.max() > 0.3
    _assert_close(rasterize(*scene, shifted), expected, EXACT)


@pytest.mark.parametrize("enlarged", [1e2, 1e4, 1e8, 1e16, 1e30])
def test_huge_ellipses_are_clipped_not_lost(rasterize, enlarged):
    means, covariances, opacities, features = _scene(60)
    covariances[:4] *= np.float32(enlarged)
    scene = means, covariances, opacities, features
    _assert_close(rasterize(*scene, _camera()), raster_oracle.rasterize(*scene, _camera()), EXACT)


def test_needles_across_the_picture(rasterize):
    means, covariances, opacities, features = _scene(60)
    along = np.random.default_rng(1).normal(size=(60, 3))
    outer = along[:, :, None] * along[:, None, :]
    covariances = outer[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]].astype(np.float32) * 25
    scene = means, covariances, opacities, features
    # a needle is 1 px wide: float32 covariances leave its edges to the last bits of both projections
    _assert_close(rasterize(*scene, _camera()), raster_oracle.rasterize(*scene, _camera()), MAX_DIFFERENCE)


@pytest.mark.parametrize("count", [0, 1])
def test_none_and_one(rasterize, count):
    scene, camera = _scene(count), _camera(33, 17)
    _assert_close(rasterize(*scene, camera), raster_oracle.rasterize(*scene, camera), EXACT)


def test_what_is_broken_or_behind_leaves_no_trace(rasterize):
    scene, camera = _scene(50), _camera()
    expected = rasterize(*scene, camera)
    broken = tuple(np.concatenate([array[:12], array[:12], array[12:]]) for array in scene)
    means, covariances, opacities, features = broken
    means[12, 0], means[13, 2] = np.nan, np.inf
    covariances[14, 3], covariances[15, 0], covariances[16] = np.nan, np.inf, 0
    opacities[17], opacities[18], opacities[19] = np.nan, 0, np.inf
    features[20, 1] = np.nan
    means[21] = camera.position + np.array([0, 0, 2])  # behind
    means[22] = camera.position  # at
    means[23] = camera.position - np.array([0, 0, 0.099])  # nearer than 10 cm
    _assert_same_bits(rasterize(*broken, camera), expected)


def test_one_gaussian_never_covers_a_pixel_whole(rasterize):
    wide = np.float32([[1, 0, 0, 1, 0, 1]])
    for opacity in (1.0, 7.0):  # an opacity above 1 makes a plateau of 0.99
        alpha = rasterize(np.zeros((1, 3), np.float32), wide, np.float32([opacity]), np.ones((1, 3)), _camera()).alpha
        assert alpha.max() == np.float32(0.99)


def test_equal_depths_are_drawn_by_index(rasterize):
    means, covariances = np.zeros((2, 3), np.float32), np.tile(np.float32([0.1, 0, 0, 0.1, 0, 0.1]), (2, 1))
    camera = Camera.look_at([0, 0, 3], [0, 0, 0], width=9, height=9, fov_y=0.5)
    image = rasterize(means, covariances, np.full(2, 0.9, np.float32), np.eye(2, 3, dtype=np.float32), camera).image
    front, back = image[4, 4, :2]
    assert front > 0.85
    assert back == pytest.approx(front * (1 - front), rel=1e-3)


def test_what_a_pixel_gains_by_not_stopping_is_bounded(rasterize):
    means, covariances = np.zeros((12, 3), np.float32), np.tile(np.float32([9, 0, 0, 9, 0, 9]), (12, 1))
    means[:, 2] = -np.arange(12) / 100
    features = np.ones((12, 1), np.float32)
    for opacity in (0.7, 0.95, 0.98, 1.0):
        scene = means, covariances, np.full(12, opacity, np.float32), features
        got, expected = rasterize(*scene, _camera()), raster_oracle.rasterize(*scene, _camera())
        gain = got.alpha - expected.alpha
        assert gain.min() > -EXACT
        assert gain.max() < STOPPED_SHARE


def test_egl_and_osmesa_give_the_same_bits(rasterizers):
    scene, camera = _scene(600, 7, opacity=(0.1, 1.0)), _camera(130, 70)
    egl, osmesa = (rasterizers[backend](*scene, camera) for backend in BACKENDS)
    _assert_same_bits(egl, osmesa)


def test_kept_buffers_change_nothing(rasterizers):
    small, large = _scene(40, 3), _scene(3000, 5, seed=1)
    views = [_camera(50, 40), _camera(64, 64)]
    rasterize = rasterizers["egl"]
    calls = [(scene, view) for scene in (small, large) for view in views]
    first = [rasterize(*scene, view) for scene, view in calls]
    for k in (3, 0, 2, 1, 1, 0, 3):
        scene, view = calls[k]
        _assert_same_bits(rasterize(*scene, view), first[k])


DIGEST = """
import hashlib, sys
sys.path.insert(0, {folder!r})
from runtime.gl.raster_gl_test import GlRasterizer, _camera, _digest, _scene
with GlRasterizer({backend!r}) as rasterize:
    print(_digest(rasterize(*_scene(600, 4), _camera(200, 150))))
"""


def _digest(raster):
    return hashlib.sha256(b"".join(np.ascontiguousarray(x).tobytes() for x in _pictures(raster).values())).hexdigest()


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_number_of_threads_changes_no_bit(rasterizers, backend):
    here = _digest(rasterizers[backend](*_scene(600, 4), _camera(200, 150)))
    code = DIGEST.format(folder=str(ROOT / "tests"), backend=backend)
    for threads in ("0", "1", "5"):
        environment = {**os.environ, "LP_NUM_THREADS": threads}
        there = subprocess.run(
            [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
        )
        assert there.stdout.strip() == here


def test_sizes_above_the_limit_are_refused_with_both_numbers(rasterizers):
    limit = rasterizers["egl"].context.info["GL_MAX_TEXTURE_SIZE"]
    with pytest.raises(InputError, match=rf"at most {limit} x {limit}, got 2 x {limit + 1}"):
        rasterizers["egl"](*_scene(5), _camera(2, limit + 1))


@pytest.mark.parametrize("wrong", range(4))
def test_wrong_shapes_are_refused(rasterizers, wrong):
    scene = list(_scene(5))
    scene[wrong] = scene[wrong][:, None]
    name = ("means", "covariances", "opacities", "features")[wrong]
    with pytest.raises(InputError, match=rf"{name}: expected shape \(5"):
        rasterizers["egl"](*scene, _camera())
