"""Headless OpenGL contexts: EGL first, then OSMesa, then a hidden window; 4.3 where available, else 3.3.

A context is current only inside ``with context:``, releases of its objects included. Several may exist in one process.
The blocks must not be nested: EGL and OSMesa share Mesa's one "current" slot per thread without coordination.
"""

from __future__ import annotations

import ctypes
import re
import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, Protocol, get_args

import glcontext
import moderngl

from rnd_runtime.core.errors import InputError, first_line

Backend = Literal["auto", "egl", "osmesa", "window"]

INSTALL = {"egl": "apt-get install libegl1 libgl1-mesa-dri", "osmesa": "apt-get install libosmesa6"}
OSMESA_LIBRARIES = ("libOSMesa.so.8", "libOSMesa.so.6", "libOSMesa.so")
GL_VERSION = 330  # core, the minimum
COMPUTE_VERSION = 430  # compute shaders, for sorting on the device
SOFTWARE_RENDERERS = re.compile(
    r"llvmpipe|softpipe|swrast|swiftshader|software render|software raster|basic render", re.I
)


class Loader(Protocol):
    """The interface that moderngl needs of a platform's context."""

    def load_opengl_function(self, name: str) -> int: ...

    def __enter__(self) -> Any: ...

    def __exit__(self, *error: object) -> Any: ...

    def release(self) -> None: ...


@dataclass(frozen=True)
class Platform:
    """Content of ``context.extra``: the backend, and glFlush, which moderngl lacks."""

    backend: str
    flush: Callable[[], None]


def create_context(backend: Backend = "auto") -> moderngl.Context:
    """Make a headless OpenGL core context, 4.3 or newer where available, else 3.3.

    Args:
        backend: "egl" (GPUs and Mesa's llvmpipe), "osmesa" (software, Mesa before 25.1), "window" (X11, Windows,
            macOS) or "auto", the first of them that works.

    Raises:
        InputError: none works; the message names the packages to install.
    """
    if backend not in get_args(Backend):
        raise InputError("OpenGL backend", expected=" | ".join(get_args(Backend)), got=repr(backend))
    failures = []
    for name, open_loader in _LOADERS.items():
        if backend in ("auto", name):
            for version in (COMPUTE_VERSION, GL_VERSION):
                try:
                    return _context_of(name, open_loader(version), version)
                except Exception as error:  # glcontext, moderngl and ctypes raise nothing more precise
                    failure = f"{name}: {first_line(error)}"
            failures.append(failure)
    hint = INSTALL.get(backend, f"{INSTALL['egl']}, or {INSTALL['osmesa']}")
    raise InputError("no OpenGL 3.3 context", got="; ".join(failures), hint=hint)


def is_software(context: moderngl.Context) -> bool:
    """Whether the context renders on the CPU (llvmpipe, softpipe, SwiftShader), by GL_RENDERER."""
    return SOFTWARE_RENDERERS.search(renderer(context)) is not None


def renderer(context: moderngl.Context) -> str:
    """GL_RENDERER, such as ``llvmpipe (LLVM 15.0.6, 256 bits)``."""
    return str(context.info["GL_RENDERER"])


def _context_of(backend: str, loader: Loader, version: int) -> moderngl.Context:
    with loader:  # a new context becomes current; leaving resets that
        try:
            settings: dict[str, Any] = {"context": loader}
            context = moderngl.create_context(require=version, standalone=True, **settings)
        except Exception:
            loader.release()
            raise
        flush = ctypes.CFUNCTYPE(None)(loader.load_opengl_function("glFlush"))
        context.extra = Platform(backend, flush)
        context.info  # noqa: B018  moderngl caches it, and queries GL while the context is current
    return context


def _open_egl(version: int) -> Loader:
    if sys.platform != "linux":
        raise OSError(f"not on {sys.platform}")
    # EGL provides GL's functions itself: libGL need not be installed
    loader: Loader = glcontext.get_backend_by_name("egl")(
        mode="standalone", glversion=version, libgl="libEGL.so.1", libegl="libEGL.so.1"
    )
    return loader


def _open_window(version: int) -> Loader:
    loader: Loader = glcontext.default_backend()(mode="standalone", glversion=version)
    return loader


class OSMesa:
    """Mesa's off-screen context (GL/osmesa.h) as moderngl's ``context=``."""

    _UNSIGNED_BYTE = 0x1401

    def __init__(self, version: int = GL_VERSION) -> None:
        asked = (
            (0x33, 0x34),  # OSMESA_PROFILE, OSMESA_CORE_PROFILE
            (0x36, version // 100),  # OSMESA_CONTEXT_MAJOR_VERSION
            (0x37, version // 10 % 10),  # OSMESA_CONTEXT_MINOR_VERSION
        )
        self._library = _first_library(*OSMESA_LIBRARIES)
        pointer = ctypes.c_void_p
        self._library.OSMesaCreateContextAttribs.restype = pointer
        self._library.OSMesaCreateContextAttribs.argtypes = [pointer, pointer]
        self._library.OSMesaMakeCurrent.argtypes = [pointer, pointer, *[ctypes.c_int] * 3]
        self._library.OSMesaMakeCurrent.restype = ctypes.c_ubyte
        self._library.OSMesaDestroyContext.argtypes = [pointer]
        self._library.OSMesaGetProcAddress.restype = pointer
        self._library.OSMesaGetProcAddress.argtypes = [ctypes.c_char_p]
        flat = [number for pair in asked for number in pair]
        attributes = (ctypes.c_int * (len(flat) + 1))(*flat, 0)
        self._handle = self._library.OSMesaCreateContextAttribs(attributes, None)
        if not self._handle:
            raise OSError("OSMesaCreateContextAttribs failed")
        self._pixel = (ctypes.c_ubyte * 4)()  # its unused 1 × 1 image

    def load_opengl_function(self, name: str) -> int:
        return self._library.OSMesaGetProcAddress(name.encode()) or 0

    def __enter__(self) -> OSMesa:
        if not self._library.OSMesaMakeCurrent(self._handle, self._pixel, self._UNSIGNED_BYTE, 1, 1):
            raise OSError("OSMesaMakeCurrent failed")
        return self

    def __exit__(self, *error: object) -> None:
        self._library.OSMesaMakeCurrent(None, None, 0, 0, 0)

    def release(self) -> None:
        if self._handle:
            self._library.OSMesaDestroyContext(self._handle)
            self._handle = None


def _first_library(*names: str) -> ctypes.CDLL:
    for name in names:
        try:
            return ctypes.CDLL(name)
        except OSError:
            continue
    raise OSError(f"{names[0]} not found")


_LOADERS: dict[str, Callable[[int], Loader]] = {"egl": _open_egl, "osmesa": OSMesa, "window": _open_window}
