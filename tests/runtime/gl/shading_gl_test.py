"""Shading in GLSL against the compiled kernels, on EGL and on OSMesa.

EGL and OSMesa must be installed here (scripts/test does it): a missing one fails.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from rnd_runtime.gl.passes import GaussianTexture
from rnd_runtime.gl.shading import GlShading
from rnd_runtime.gl.surfaces import SurfaceUpload
from rnd_runtime.shading.files.load import load_light
from rnd_runtime.shading.light import Light, texel_directions
from rnd_runtime.shading.shader import Shader
from support import gl_devices
from support.gl_devices import BACKENDS
from support.paths import ASSETS
from support.shading_scenes import ball, probe

MODES = ("ao", "table", "table+sun", "lights:64", "brute")
CAMERA = np.array([0.5, 0.4, 4.0])  # of the ball
EYE = np.array([0.5, 1.2, 3.2])  # of the walking body
# Of a Gaussian's radiance, or of a thousandth of the brightest one's: float32 sums of up to 2 048 terms in another
# order, and highlights of α = 0.008, where rounding moves them by 1e-5 of their width (2.5e-5 measured).
RADIANCE = 1e-4
# Share of Gaussians whose shadow may differ: a texel on a disc's very edge is inside for one and outside for the other.
FLIPPED = 2e-3


devices = gl_devices.devices(
    shading=GlShading, upload=SurfaceUpload, order=partial(GaussianTexture, components=1, dtype="i4")
)


@pytest.fixture(params=BACKENDS)
def device(request, devices):
    return devices[request.param]


def _shade(device, shader, gaussians, camera=CAMERA, order=None):
    """Radiance [len(order), 3]; by default of all Gaussians in their own order."""
    order = np.arange(len(gaussians.means)) if order is None else order
    with device.context:
        surfaces = device.upload.write(gaussians)
        ranks = device.order.write(order[:, None].astype(np.int32))
        texture = device.shading.shade(shader, surfaces, ranks, len(order), camera, gaussians.root_rotation)
        radiance = np.frombuffer(texture.read(), np.float32).reshape(-1, 4)[: len(order), :3]
        assert device.context.error == "GL_NO_ERROR"
    return radiance


def _differences(got, expected):
    """[N], relative to each Gaussian's radiance, or to a thousandth of the brightest one's where that is more."""
    size = np.maximum(np.abs(expected).max(1), 1e-3 * np.abs(expected).max())
    return np.abs(got - expected).max(1) / np.maximum(size, 1e-30)


@pytest.mark.parametrize("roughness", [(0.35, 0.99), (0.0, 0.3)])
@pytest.mark.parametrize(("yaw", "up"), [(0.7, "y"), (-2.0, "z")])
@pytest.mark.parametrize("mode", MODES)
def test_every_mode_is_the_kernels(device, mode, yaw, up, roughness):
    gaussians = ball(1500, roughness=roughness)
    shader = Shader(probe(height=64, sun=4000, yaw=yaw, up=up), mode)
    assert bool(shader.directional) == (mode == "table+sun")
    got, expected = _shade(device, shader, gaussians), shader.shade(gaussians, CAMERA)
    assert _differences(got, expected).max() < RADIANCE


@pytest.fixture(scope="module")
def walker(avatar, motion):
    return avatar.pose(motion, 0.3)


def test_two_suns_cast_two_shadows(device, walker):
    directions = texel_directions(64, 128)
    radiance = np.full((64, 128, 3), 0.2, np.float32)
    for towards, colour in (([0.8, 0.5, 0.3], [900, 300, 100]), ([-0.6, 0.3, 0.7], [100, 500, 700])):
        radiance[directions @ (towards / np.linalg.norm(towards)) > np.cos(np.radians(3))] = colour
    shader = Shader(Light(radiance))
    assert len(shader.directional) == 2
    got, expected = _shade(device, shader, walker, EYE), shader.shade(walker, EYE)
    assert (_differences(got, expected) > RADIANCE).mean() < FLIPPED


@pytest.mark.parametrize("yaw", [0.0, 2.1])
def test_shadows_of_a_body_are_the_kernels(device, walker, yaw):
    shader = Shader(load_light(ASSETS / "sky.exr", yaw=yaw))
    assert shader.directional
    shadowless = replace(walker, opacities=np.zeros_like(walker.opacities))  # what is transparent casts nothing
    got, expected = _shade(device, shader, walker, EYE), shader.shade(walker, EYE)
    open_sky = shader.shade(shadowless, EYE)
    assert (_differences(open_sky, expected) > 0.1).mean() > 0.02  # a body does shadow itself
    assert (_differences(got, expected) > RADIANCE).mean() < FLIPPED
    assert _differences(_shade(device, shader, shadowless, EYE), open_sky).max() < RADIANCE


def test_turning_and_relighting_leave_nothing_behind(devices):
    device, gaussians = devices["egl"], ball(300)
    shaders = [Shader(probe(height=64, sun=4000), mode) for mode in MODES]
    turned = [shader.with_yaw(1.1) for shader in shaders]
    first = [_shade(device, shader, gaussians) for shader in (*shaders, *turned)]
    for k in (0, 5, 7, 2, 1, 6, 9, 4, 3, 8, 0):
        np.testing.assert_array_equal(_shade(device, [*shaders, *turned][k], gaussians), first[k])
    assert (first[1] != first[6]).any()


def test_any_number_of_gaussians_in_any_order_of_calls(devices):
    device, shader = devices["egl"], Shader(probe(height=64, sun=4000))
    for count in (1, 1023, 1024, 1025, 5000, 3):
        gaussians = ball(count)
        expected = shader.shade(gaussians, CAMERA)
        assert (_differences(_shade(device, shader, gaussians), expected) > RADIANCE).mean() <= FLIPPED


@pytest.mark.parametrize("mode", MODES)
def test_egl_and_osmesa_give_the_same_bits(devices, mode):
    gaussians, shader = ball(1500), Shader(probe(height=64, sun=4000), mode)
    egl, osmesa = (_shade(devices[backend], shader, gaussians) for backend in BACKENDS)
    np.testing.assert_array_equal(egl, osmesa)


def test_what_is_no_number_shadows_nobody(device, walker, sky):
    shader = Shader(sky)
    whole = np.arange(len(walker.means)) >= 4
    means, normals = walker.means.copy(), walker.normals.copy()
    means[0, 0], means[1, 1], normals[2, 2], normals[3, 0] = np.nan, np.inf, np.nan, -np.inf
    broken = replace(walker, means=means, normals=normals)
    got, expected = _shade(device, shader, broken, EYE)[whole], shader.shade(broken, EYE)[whole]
    assert (_differences(got, expected) > RADIANCE).mean() < FLIPPED
