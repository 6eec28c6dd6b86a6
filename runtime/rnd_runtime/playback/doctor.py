"""Diagnosis of this machine, with installation advice: ``rnd-play --doctor``."""

from __future__ import annotations

import platform
import subprocess
import sys
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

from rnd_runtime.core.threads import cores
from rnd_runtime.gl.context import INSTALL

PROBE_SECONDS = 60.0  # time limit: drivers may hang
PACKAGES = ("numpy", "numba", "onnxruntime", "moderngl", "OpenImageIO")

# Each runs in its own process, as a broken GL driver may crash it.
_GL_PROBE = """
from rnd_runtime.gl.context import create_context
info = create_context({backend!r}).info
print(info["GL_RENDERER"], "|", info["GL_VERSION"])
"""
_CHOICE_PROBE = """
from rnd_runtime.playback.rasterizer import make_rasterizer
print(make_rasterizer("auto").name)
"""
_NUMBA_PROBE = """
import numba
@numba.njit(parallel=True)
def run(n):
    total = 0
    for i in numba.prange(n):
        total += i
    return total
run(9)
print(f"{numba.get_num_threads()}, {numba.threading_layer()}")
"""
_ONNX_PROBE = """
import onnxruntime
print(", ".join(onnxruntime.get_available_providers()))
"""


class Finding(NamedTuple):
    label: str
    value: str
    advice: str | None  # one line


def report() -> list[Finding]:
    """Examine renderers, onnxruntime, numba, the CPU and versions; takes a few seconds and raises nothing."""
    probes = {
        "egl": _start(_GL_PROBE.format(backend="egl")),
        "osmesa": _start(_GL_PROBE.format(backend="osmesa")),
        "rasteriser": _start(_CHOICE_PROBE),
        "onnxruntime": _start(_ONNX_PROBE),
        "numba": _start(_NUMBA_PROBE),
    }
    found = {name: _outcome(process) for name, process in probes.items()}
    return [
        _gl_finding("OpenGL, EGL", "egl", *found["egl"]),
        _gl_finding("OpenGL, OSMesa", "osmesa", *found["osmesa"], needed=not found["egl"][0]),
        Finding("rasteriser", *_rasterizer(*found["rasteriser"])),
        Finding("onnxruntime providers", found["onnxruntime"][1], _reinstall("onnxruntime", found["onnxruntime"][0])),
        Finding("numba threads", found["numba"][1], _reinstall("numba", found["numba"][0])),
        Finding("CPU", machine(), None),
        Finding("system", f"{platform.platform()}, Python {platform.python_version()}", None),
        *(Finding(name, *_version(name)) for name in ("rnd-avatar", *PACKAGES)),
    ]


def machine() -> str:
    """CPU model, its microarchitecture as named by LLVM, and cores.

    On cloud machines the model's name does not determine whether it has AVX-512.
    """
    return f"{_cpu_model()} ({_microarchitecture()}), {cores()} cores"


def _start(code: str) -> subprocess.Popen[str]:
    return subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def _outcome(process: subprocess.Popen[str]) -> tuple[bool, str]:
    """Whether the probe succeeded, and its last line of output or error."""
    try:
        output, errors = process.communicate(timeout=PROBE_SECONDS)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
        return False, f"no answer within {PROBE_SECONDS:.0f} s"
    if process.returncode == 0 and output.strip():
        return True, output.strip().splitlines()[-1]
    if process.returncode < 0:
        return False, f"crashed with signal {-process.returncode}"
    return False, (errors.strip().splitlines() or ["no answer"])[-1]


def _gl_finding(label: str, backend: str, works: bool, value: str, *, needed: bool = True) -> Finding:
    if works:
        return Finding(label, value, None)
    return Finding(label, "missing", f"{INSTALL[backend]}{'' if needed else ' (optional: EGL works)'}: {value}")


def _rasterizer(works: bool, line: str) -> tuple[str, str | None]:
    """Choice of ``--raster auto``."""
    return (line, None) if works else ("cpu", f"--raster cpu, as looking for a GPU fails: {line}")


def _reinstall(package: str, works: bool) -> str | None:
    return None if works else f"pip install --force-reinstall {package}"


def _version(package: str) -> tuple[str, str | None]:
    try:
        return metadata.version(package), None
    except metadata.PackageNotFoundError:
        return "missing", f"pip install {package}"


def _cpu_model() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text("utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def _microarchitecture() -> str:
    try:
        from llvmlite.binding import get_host_cpu_name  # type: ignore[import-untyped]
    except (ImportError, OSError):  # numba is missing
        return platform.machine()
    return str(get_host_cpu_name())
