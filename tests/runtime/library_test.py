"""The package as a library: what importing it and loading an avatar do to the process."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import textwrap
import tomllib
from typing import Any

import numpy as np
import pytest

import rnd_runtime
from support.paths import ROOT
from support.tiny import ASSETS

OURS = ("NUMBA_CACHE_DIR", "OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "ORT_DISABLE_TELEMETRY")


def _run(code: str, *before: str, **changes: str) -> str:
    """What ``code`` prints in a fresh process, without the variables that commands set."""
    environment = {name: value for name, value in os.environ.items() if name not in OURS} | changes
    done = subprocess.run([*before, sys.executable, "-c", code], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_importing_the_package_changes_nothing_for_the_process():
    code = """
import gc, os, sys
before = dict(os.environ), gc.isenabled(), gc.get_threshold(), set(sys.modules)
import rnd_runtime
assert before[:3] == (dict(os.environ), gc.isenabled(), gc.get_threshold())
print(sorted(name for name in sys.modules if name not in before[3] and not name.startswith("rnd_runtime")
             and sys.modules[name] is None or name in ("numba", "numpy", "onnxruntime")))
"""
    assert _run(code) == "[]"


def test_a_command_prepares_the_process_before_a_kernel_is_loaded():
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"].values()
    modules = sorted(script.partition(":")[0] for script in scripts)
    code = f"""
import importlib, os, sys
for module in {modules}:
    importlib.import_module(module)
assert not {{"numba", "torch", "onnxruntime"}} & set(sys.modules)
from rnd_runtime.cli.command import run_command
run_command("rnd-x", lambda: None)
print([name for name in {OURS} if name not in os.environ])
"""
    assert _run(code) == "[]"


def test_the_docstrings_example_runs(tiny_avatar, tmp_path, monkeypatch):
    lines = textwrap.dedent(rnd_runtime.__doc__.partition("::\n")[2].partition("\nImporting")[0]).strip().splitlines()
    for name, file in (
        ("avatar.onnx", tiny_avatar),
        ("walk.npz", ASSETS / "walk.npz"),
        ("sky.exr", ASSETS / "sky.exr"),
    ):
        (tmp_path / name).symlink_to(file)
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    exec("\n".join(lines).replace("512", "48"), names)
    image = names["image"]
    assert len(lines) <= 10 and image.shape == (48, 48, 4) and image.dtype == np.uint8
    assert image[..., 3].max() == 255 and not image[0, 0].any()


def test_the_packages_names_are_sorted_and_there():
    assert rnd_runtime.__all__ == sorted(rnd_runtime.__all__)
    assert all(hasattr(rnd_runtime, name) for name in rnd_runtime.__all__) and not hasattr(rnd_runtime, "nothing")
    assert {*rnd_runtime.__all__} <= {*dir(rnd_runtime)}


def test_onnxruntime_sends_no_telemetry(tiny_avatar, tmp_path):
    code = f"from rnd_runtime.avatar.avatar import Avatar; Avatar.load({str(tiny_avatar)!r})"
    numba = {"NUMBA_CACHE_DIR": os.environ["NUMBA_CACHE_DIR"]}
    _run(code, HOME=str(tmp_path), XDG_CACHE_HOME=str(tmp_path / ".cache"), **numba)
    assert not list(tmp_path.rglob("*onnxruntime*"))


@pytest.mark.skipif(shutil.which("taskset") is None, reason="taskset is not installed")
def test_threads_are_as_many_as_the_cores_of_the_process(tiny_avatar):
    code = f"""
import os
from rnd_runtime.core.threads import cores
from rnd_runtime.avatar.avatar import Avatar
before = len(os.listdir("/proc/self/task"))
avatar = Avatar.load({str(tiny_avatar)!r}, threads=None)
print(cores(), len(os.listdir("/proc/self/task")) - before)
"""
    numba = {"NUMBA_CACHE_DIR": os.environ["NUMBA_CACHE_DIR"]}
    assert (
        _run(code, "taskset", "-c", str(min(os.sched_getaffinity(0))), **numba) == "1 1"
    )  # the one that opens sessions


def test_a_players_start_loads_neither_scipy_nor_opengl_nor_other_readers(tiny_avatar, tmp_path):
    code = f"""
import sys
from rnd_viewer.play.cli import main
assert main([{str(tiny_avatar)!r}, "--motion", {str(ASSETS / "walk.npz")!r}, "--hdr", {str(ASSETS / "sky.exr")!r},
             "--size", "16", "--frames", "0:1", "--raster", "cpu", "--out", {str(tmp_path / "out")!r}]) == 0
unneeded = ["rnd_runtime.gl.frame", "rnd_runtime.motion.readers.bvh", "rnd_runtime.motion.readers.unpickle", "torch"]
print([name for name in unneeded if name in sys.modules])
"""
    assert _run(code, NUMBA_CACHE_DIR=os.environ["NUMBA_CACHE_DIR"]).splitlines()[-1] == "[]"
