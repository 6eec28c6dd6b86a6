"""Which rasteriser is taken where."""

import numpy as np
import pytest

from rnd_runtime.core.camera import Camera
from rnd_runtime.core.errors import InputError
from rnd_runtime.gl import context as gl_context
from rnd_runtime.playback.rasterizer import make_rasterizer

CAMERA = Camera.look_at([0, 0, 2], [0, 0, 0], width=9, height=7, fov_y=0.8)
ONE_GAUSSIAN = (
    np.zeros((1, 3), np.float32),
    np.array([[0.01, 0, 0, 0.01, 0, 0.01]], np.float32),
    np.array([0.5], np.float32),
    np.array([[1.0, 0.5, 0.25]], np.float32),
)


def _no_context(backend):
    raise InputError("no OpenGL 3.3 context")


@pytest.mark.parametrize(
    ("renderer", "start"), [("NVIDIA H200/PCIe/SSE2", "gl (egl, "), ("llvmpipe (LLVM 15.0.6, 256 bits)", "cpu")]
)
def test_auto_takes_gl_on_a_gpu_and_the_kernel_on_a_cpu(monkeypatch, renderer, start):
    monkeypatch.setattr(gl_context, "renderer", lambda context: renderer)
    with make_rasterizer("auto") as rasterizer:
        assert rasterizer.name.startswith(start)
        assert rasterizer(*ONE_GAUSSIAN, CAMERA).alpha.max() > 0.4


def test_auto_takes_the_kernel_where_no_context_can_be_made(monkeypatch):
    monkeypatch.setattr(gl_context, "create_context", _no_context)
    assert make_rasterizer("auto").name == "cpu"


def test_gl_is_refused_where_no_context_can_be_made(monkeypatch):
    monkeypatch.setattr(gl_context, "create_context", _no_context)
    with pytest.raises(InputError, match="no OpenGL"):
        make_rasterizer("gl")


@pytest.mark.parametrize("backend", ["egl", "osmesa"])
def test_gl_is_taken_when_asked_for_and_named(backend):
    with make_rasterizer(f"gl-{backend}") as rasterizer:
        assert rasterizer.name.startswith(f"gl ({backend}, ")


def test_all_draw_the_same():
    pictures = []
    for kind in ("cpu", "gl"):
        with make_rasterizer(kind) as rasterizer:
            pictures.append(rasterizer(*ONE_GAUSSIAN, CAMERA))
    for name in ("image", "alpha", "depth"):
        cpu, gl = (getattr(picture, name) for picture in pictures)
        assert cpu.shape == gl.shape
        np.testing.assert_allclose(cpu, gl, atol=1e-5)  # one float32 exp2 against another, at α up to 0.5
