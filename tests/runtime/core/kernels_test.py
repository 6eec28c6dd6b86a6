"""Compiled kernels are what the sources say, also of what numba inlines from other files."""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from rnd_runtime.core import kernels, signals
from rnd_runtime.core.kernels import kernels_are_cold

KERNEL = """
from numba import njit
from .inner import FACTOR, inner
@njit(cache=True)
def outer(x):
    return FACTOR * inner(x)
"""
INNER = """
from numba import njit
FACTOR = {factor}
@njit(inline="always")
def inner(x):
    return x + {added}
"""
USE = """
from rnd_runtime.core.kernels import kernels_are_cold, prepare_process
prepare_process()
cold = kernels_are_cold()
from rnd_runtime.raster.kernel import outer
print(outer(1), cold, kernels_are_cold())
"""

FRAMES = """
import resource
import numpy as np
from rnd_runtime.core.kernels import prepare_process
prepare_process()
def frame():
    return [np.ones(100_000, np.float32) for _ in range(100)]
frame(), frame()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(10):
    frame()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.fixture
def clone(tmp_path) -> Path:
    """A clone whose package has one kernel, and our ``core.kernels``."""
    package = tmp_path / "runtime" / "rnd_runtime"
    for room in ("core", "raster"):
        (package / room).mkdir(parents=True)
        (package / room / "__init__.py").touch()
    (package / "__init__.py").touch()
    (tmp_path / "pyproject.toml").touch()
    for module in (kernels, signals):
        shutil.copy(module.__file__, package / "core")
    (package / "raster" / "kernel.py").write_text(KERNEL)
    return tmp_path


def _run(clone: Path, factor: int, added: int, **changes: str) -> str:
    """What the kernel gives for 1 in a process of its own, and whether kernels were cold before and after."""
    (clone / "runtime/rnd_runtime/raster/inner.py").write_text(INNER.format(factor=factor, added=added))
    known = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    environment = known | {"PYTHONPATH": str(clone / "runtime"), "PYTHONDONTWRITEBYTECODE": "1"} | changes
    done = subprocess.run([sys.executable, "-c", USE], env=environment, capture_output=True, text=True, check=True)
    return done.stdout.strip()


def test_an_edit_of_what_is_inlined_compiles_the_kernel_anew(clone):
    for factor, added, value in [(2, 1, "4"), (2, 5, "12"), (3, 5, "18")]:
        assert _run(clone, factor, added) == f"{value} True False"
    stamps = {file: file.stat().st_mtime_ns for file in (clone / ".cache/kernels").rglob("*.nbc")}
    (clone / "runtime/rnd_runtime/raster/.#inner.py").symlink_to("me@here.1234")  # an editor's lock is no source
    assert len(stamps) == 3 and _run(clone, 3, 5) == "18 False False"
    assert stamps == {file: file.stat().st_mtime_ns for file in (clone / ".cache/kernels").rglob("*.nbc")}


def test_few_caches_are_kept_and_a_users_own_stays_his(clone, tmp_path):
    caches = clone / ".cache/kernels"
    for old in "abcdef":
        (caches / old).mkdir(parents=True)
    assert _run(clone, 1, 0) == "1 True False"
    assert len(list(caches.iterdir())) == 4
    mine = {"NUMBA_CACHE_DIR": str(tmp_path / "mine")}
    assert _run(clone, 1, 9, **mine) == "10 True False"
    assert (tmp_path / "mine").is_dir() and len(list(caches.iterdir())) == 4


def test_outside_of_a_clone_numba_chooses_the_folder(clone, tmp_path):
    (clone / "pyproject.toml").unlink()
    home = {"HOME": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path / "cache")}
    assert _run(clone, 2, 1, **home) == "4 True False"
    assert not (clone / ".cache").exists()


def test_only_the_rasterisers_kernels_count(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    for folder, cold in (("others_0123", True), ("raster_0123", False)):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "blend.draw-7.py312.nbi").touch()
        assert kernels_are_cold() == cold


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library")
def test_what_a_frame_frees_is_kept_for_the_next():
    done = subprocess.run([sys.executable, "-c", FRAMES], capture_output=True, text=True, check=True)
    assert int(done.stdout) < 1000  # of 100 000 pages
