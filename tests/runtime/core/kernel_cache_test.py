"""What is compiled is what the sources say, also of what numba inlines from other files."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

import rnd_runtime
from rnd_runtime.core.kernels import kernels_are_cold
from support.tiny import ASSETS

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


@pytest.fixture
def clone(tmp_path) -> Path:
    """A clone of a package of one kernel, with our way of keeping it."""
    package = tmp_path / "runtime" / "rnd_runtime"
    package.mkdir(parents=True)
    (tmp_path / "pyproject.toml").touch()
    own = Path(rnd_runtime.__file__).parent / "_kernel_cache.py"
    (package / "_kernel_cache.py").write_text(own.read_text("utf-8"), "utf-8")
    (package / "__init__.py").write_text(
        "from ._kernel_cache import keep_kernels_by_source\nkeep_kernels_by_source()\n"
    )
    (package / "kernel.py").write_text(KERNEL)
    return tmp_path


USE = "from rnd_runtime.kernel import outer; print(outer(1))"


def _run(clone: Path, code: str = USE, **changes: str) -> str:
    """What ``code`` prints in a process of its own: what the kernel gives for 1."""
    known = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    environment = known | {"PYTHONPATH": str(clone / "runtime"), **changes}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    return done.stdout.strip()


def test_an_edit_of_what_is_inlined_compiles_the_kernel_anew(clone):
    inner, kept = clone / "runtime/rnd_runtime/inner.py", clone / ".cache/kernels"
    for folders, (factor, added, value) in enumerate([(2, 1, "4"), (2, 5, "12"), (3, 5, "18")], 1):
        inner.write_text(INNER.format(factor=factor, added=added))
        assert _run(clone) == value
        assert len(list(kept.iterdir())) == folders
    stamp = {file: file.stat().st_mtime_ns for file in kept.rglob("*.nbc")}
    assert len(stamp) == 3 and _run(clone) == "18"
    assert stamp == {file: file.stat().st_mtime_ns for file in kept.rglob("*.nbc")}  # found, not made again


def test_few_states_of_the_sources_are_kept_and_a_folder_of_the_users_is_his(clone, tmp_path):
    inner = clone / "runtime/rnd_runtime/inner.py"
    for added in range(6):
        inner.write_text(INNER.format(factor=1, added=added))
        assert _run(clone) == str(1 + added)
    assert len(list((clone / ".cache/kernels").iterdir())) == 4
    inner.write_text(INNER.format(factor=1, added=9))
    assert _run(clone, NUMBA_CACHE_DIR=str(tmp_path / "mine")) == "10"
    assert (tmp_path / "mine").is_dir() and len(list((clone / ".cache/kernels").iterdir())) == 4


def test_an_editors_lock_is_no_source(clone):
    """Emacs marks a buffer that is not saved by a link to nowhere beside the file."""
    inner = clone / "runtime/rnd_runtime/inner.py"
    inner.write_text(INNER.format(factor=2, added=1))
    inner.with_name(".#inner.py").symlink_to("me@here.1234")
    assert _run(clone) == "4" and (clone / ".cache/kernels").is_dir()


def test_kernels_are_cold_until_one_of_ours_is_kept(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "none"))
    assert kernels_are_cold()
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    for folder, cold in (("others_0123", True), ("rnd_runtime_0123", False)):
        (tmp_path / folder).mkdir()
        assert kernels_are_cold()
        (tmp_path / folder / "raster.draw-7.py312.nbi").touch()
        assert kernels_are_cold() == cold


def test_where_numba_keeps_kernels_is_where_they_are_looked_for(clone, tmp_path):
    """By numba itself: in the folder that it is told, and beside the sources."""
    inner, package = clone / "runtime/rnd_runtime/inner.py", clone / "runtime/rnd_runtime"
    inner.write_text(INNER.format(factor=2, added=1))
    own = Path(rnd_runtime.__file__).parent / "kernels.py"
    (package / "kernels.py").write_text(own.read_text("utf-8"), "utf-8")
    (package / "__init__.py").write_text("")
    code = "from rnd_runtime.core.kernels import kernels_are_cold; print(kernels_are_cold())"
    home = {"HOME": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path / "cache")}
    for places in (home | {"NUMBA_CACHE_DIR": str(tmp_path / "kept")}, home):
        assert _run(clone, code, **places) == "True"
        _run(clone, **places)
        assert _run(clone, code, **places) == "False"


def test_a_players_start_loads_neither_scipy_nor_opengl_nor_other_readers(tiny_avatar, tmp_path):
    code = f"""
import sys
from rnd_viewer.play.cli import main
assert main([{str(tiny_avatar)!r}, "--motion", {str(ASSETS / "walk.npz")!r}, "--hdr", {str(ASSETS / "sky.exr")!r},
             "--size", "16", "--frames", "0:1", "--raster", "cpu", "--out", {str(tmp_path / "out")!r}]) == 0
unneeded = ["scipy.linalg",
    "rnd_runtime.gl.frame", "rnd_runtime.motion.readers.mocap", "rnd_runtime.motion.readers.unpickle", "torch"]
print([name for name in unneeded if sys.modules.get(name)])
import scipy.linalg, numba, numpy
print(scipy.linalg.norm([3, 4]), numba.njit(lambda a: a.sum())(numpy.ones(3)))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-2:] == ["[]", "5.0 3.0"]
    assert "leaked" not in done.stderr  # as nanobind says of what the interpreter's end did not reach
