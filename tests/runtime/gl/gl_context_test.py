"""Headless contexts: both backends for real, several at once, and what is said when nothing works.

EGL and OSMesa must be installed here (scripts/test does it): a missing one fails.
"""

import numpy as np
import pytest

from rnd_runtime.core.errors import InputError
from rnd_runtime.gl import context as gl_context
from rnd_runtime.gl.context import create_context, is_software

BACKENDS = ("egl", "osmesa")


def _filled(context, value):
    """The number that a 3 × 2 float picture cleared to ``value`` holds."""
    framebuffer = context.simple_framebuffer((3, 2), 1, dtype="f4")
    framebuffer.clear(value)
    pixels = np.frombuffer(framebuffer.read(components=1, dtype="f4"), np.float32)
    for attachment in framebuffer.color_attachments:
        attachment.release()
    framebuffer.release()
    assert (pixels == pixels[0]).all()
    return float(pixels[0])


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_context_draws(backend):
    context = create_context(backend)
    with context:
        assert context.error == "GL_NO_ERROR"
        assert _filled(context, 0.25) == 0.25
        context.extra.flush()
        assert context.error == "GL_NO_ERROR"
    assert context.version_code >= 330
    assert context.extra.backend == backend
    context.release()


def test_contexts_of_both_backends_live_side_by_side():
    contexts = [create_context(backend) for backend in (*BACKENDS, *BACKENDS)]
    for turn in range(3):
        for index, context in enumerate(contexts):
            with context:
                assert _filled(context, turn + index / 8) == turn + index / 8
                assert context.error == "GL_NO_ERROR"
    for context in contexts[::2]:
        context.release()
    for context in contexts[1::2]:  # they outlive the release of others
        with context:
            assert _filled(context, 0.5) == 0.5
        context.release()


@pytest.mark.parametrize(
    ("name", "software"),
    [
        ("llvmpipe (LLVM 15.0.6, 256 bits)", True),
        ("softpipe", True),
        ("ANGLE (Google, Vulkan 1.3.0 (SwiftShader Device (Subzero)), SwiftShader driver)", True),
        ("Microsoft Basic Render Driver", True),
        ("Apple Software Renderer", True),
        ("NVIDIA H200/PCIe/SSE2", False),
        ("Mesa Intel(R) UHD Graphics 770 (ADL-S GT1)", False),
        ("AMD Radeon RX 6800 (radeonsi, navi21, LLVM 15.0.7, DRM 3.49)", False),
        ("Apple M2", False),
    ],
)
def test_software_is_told_by_the_renderer(monkeypatch, name, software):
    monkeypatch.setattr(gl_context, "renderer", lambda context: name)
    assert is_software(None) is software


def _broken(version):
    raise OSError("out of order")


@pytest.mark.parametrize("backend", BACKENDS)
def test_where_there_is_no_newer_opengl_an_older_one_does(monkeypatch, backend):
    asked, loader = [], gl_context._LOADERS[backend]

    def old(version):
        asked.append(version)
        if version > 330:
            raise OSError("too new")
        return loader(version)

    monkeypatch.setitem(gl_context._LOADERS, backend, old)
    context = create_context(backend)
    assert asked == [430, 330]
    with context:
        assert _filled(context, 0.5) == 0.5
    context.release()


def test_auto_takes_egl_then_osmesa(monkeypatch):
    context = create_context("auto")
    assert context.extra.backend == "egl"
    context.release()
    monkeypatch.setitem(gl_context._LOADERS, "egl", _broken)
    context = create_context("auto")
    assert context.extra.backend == "osmesa"
    context.release()


@pytest.mark.parametrize(
    ("backend", "hint"),
    [
        ("auto", "apt-get install libegl1 libgl1-mesa-dri"),
        ("auto", "apt-get install libosmesa6"),
        ("egl", "apt-get install libegl1 libgl1-mesa-dri"),
        ("osmesa", "apt-get install libosmesa6"),
    ],
)
def test_what_to_install_is_said_when_nothing_works(monkeypatch, backend, hint):
    for name in gl_context._LOADERS:
        monkeypatch.setitem(gl_context._LOADERS, name, _broken)
    with pytest.raises(InputError) as caught:
        create_context(backend)
    assert hint in str(caught.value)
    assert "out of order" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_unknown_backend_is_refused():
    with pytest.raises(InputError, match=r"expected auto \| egl \| osmesa \| window, got 'vulkan'"):
        create_context("vulkan")
