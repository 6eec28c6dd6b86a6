"""A picture finished on an OpenGL device against what the CPU does to it, on EGL and on OSMesa."""

from __future__ import annotations

import functools

import numpy as np
import pytest

from rnd_runtime.core.camera import Camera
from rnd_runtime.core.gaussians import Raster
from rnd_runtime.gl import finish as finish_gl
from rnd_runtime.gl.finish import GlFinish
from rnd_runtime.playback.frame import FrameRenderer
from rnd_runtime.raster.outline import sharpened
from rnd_runtime.raster.tone import code_steps, tone_map
from support import gl_devices
from support.gl_devices import BACKENDS

SIZES = [(64, 48), (1, 1), (5, 3), (511, 37), (6, 2)]  # rows with and without numbers to spare
ROUNDING = 2e-7  # relative: the device may fuse a product and a sum

devices = gl_devices.devices(
    toned=functools.partial(GlFinish, tone=True), plain=functools.partial(GlFinish, tone=False)
)


@pytest.fixture(params=BACKENDS)
def device(request, devices):
    with devices[request.param].context as context:
        yield devices[request.param]
        assert context.error == "GL_NO_ERROR"


def _camera(width, height):
    return Camera.look_at([0, 0, 3], [0, 0, 0], width=width, height=height, fov_y=0.5)


def _picture(width, height):
    """[H, W, 4] premultiplied, of all coverages and of radiances from none to much."""
    draw = np.random.default_rng(width)
    alpha = np.clip(draw.uniform(-0.3, 1.3, (height, width, 1)), 0, 1)
    return np.concatenate([alpha * 4 ** draw.uniform(-8, 1, (height, width, 3)), alpha], axis=2).astype("f4")


def _finished(finish, context, picture):
    camera = _camera(picture.shape[1], picture.shape[0])
    blended = context.texture((camera.width, camera.height), 4, picture.tobytes(), dtype="f4")
    finish.run(blended, camera)
    blended.release()
    return finish.read(camera)


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_outlines_are_those_of_the_cpu(device, width, height):
    picture = _picture(width, height)
    image, alpha = picture[..., :3], picture[..., 3]
    expected = sharpened(Raster(image.copy(), alpha.copy(), np.zeros_like(alpha)))
    for finish in (device.toned, device.plain):
        ours = _finished(finish, device.context, picture)
        assert ours.image.flags.c_contiguous and ours.alpha.flags.c_contiguous
        np.testing.assert_allclose(ours.image, expected.image, rtol=ROUNDING)
        np.testing.assert_allclose(ours.alpha, expected.alpha, rtol=ROUNDING)


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_codes_are_those_of_the_cpu(device, width, height):
    ours = _finished(device.toned, device.context, _picture(width, height))
    np.testing.assert_array_equal(ours.srgb, tone_map(ours.image, ours.alpha))
    assert _finished(device.plain, device.context, _picture(width, height)).srgb is None


def test_every_step_is_where_the_cpu_has_it(device):
    """The least radiance of every code, and the greatest of the one before."""
    steps = code_steps()[1:-1]
    values = np.concatenate([steps, np.nextafter(steps, np.float32(0)), [0, 1, 7, 1e-30]]).astype(np.float32)
    values = np.resize(values, (3, 200, 3))
    opaque = np.ones((3, 200, 1), np.float32)
    ours = _finished(device.toned, device.context, np.concatenate([values, opaque], axis=2))
    np.testing.assert_array_equal(ours.image, values)
    np.testing.assert_array_equal(ours.srgb, tone_map(values, opaque[..., 0]))


def test_one_size_after_another(device):
    for width, height in (*SIZES, *SIZES[::-1]):
        picture = _picture(width, height)
        ours = _finished(device.toned, device.context, picture)
        assert ours.image.shape == (height, width, 3) == ours.srgb.shape
        np.testing.assert_allclose(ours.alpha.max(), picture[..., 3].max(), rtol=0.6)


@pytest.mark.parametrize("raster", ["gl-egl", "gl-osmesa"])
def test_a_frame_takes_the_devices_codes(avatar, motion, sky, raster, monkeypatch):
    camera = Camera.look_at([0.5, 1.2, 3.2], [0, 0.9, 0], width=190, height=256, fov_y=0.65)
    monkeypatch.setattr(finish_gl, "is_software", lambda _: False)  # as on a GPU
    monkeypatch.setattr("rnd_runtime.playback.frame.tone_map", lambda *_: pytest.fail("the CPU tone maps"))
    renderer = FrameRenderer(avatar, sky, camera, raster=raster)
    frame = renderer.render(motion, 0.3)
    renderer.close()
    assert frame.srgb.max() > 100
    np.testing.assert_array_equal(frame.srgb, tone_map(frame.radiance, frame.alpha))
