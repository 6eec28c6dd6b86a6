"""Commands where nothing but a temporary folder can be written: another user, no home, a read-only package."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from support.paths import ROOT

NOBODY = 65534
LIBRARIES = str(Path(np.__file__).parents[1])
HOMES = {"unset": None, "absent": "/nonexistent", "read-only": "/"}


@pytest.fixture(scope="module")
def box() -> Iterator[Path]:
    """A folder that another user can enter, with a read-only copy of the packages and a writable ``tmp``."""
    folder = Path(tempfile.mkdtemp())
    for package in ("runtime/rnd_runtime", "viewer/rnd_viewer"):
        shutil.copytree(ROOT / package, folder / "packages" / Path(package).name, ignore=_caches)
    for file in [folder, *folder.rglob("*")]:
        file.chmod(0o555 if file.is_dir() else 0o444)
    folder.chmod(0o755)
    (folder / "tmp").mkdir()
    (folder / "tmp").chmod(0o777)
    yield folder
    for file in folder.rglob("*"):
        if file.is_dir():
            file.chmod(0o755)
    shutil.rmtree(folder)


def _caches(folder: str, names: list[str]) -> set[str]:
    return {name for name in names if name == "__pycache__"}


@cache
def _python() -> list[str]:
    """A Python for nobody, or for oneself where one is not root: whom the copy's modes would not bind."""
    if os.getuid() != 0:
        return [sys.executable]
    if shutil.which("setpriv") is None:
        pytest.skip("no setpriv")
    nobody = ["setpriv", f"--reuid={NOBODY}", f"--regid={NOBODY}", "--clear-groups"]
    probe = "import subprocess, sys, numba; subprocess.run([sys.executable, '-c', ''], check=True)"
    for python in (
        sys.executable,
        shutil.which(f"python{sys.version_info.major}.{sys.version_info.minor}", path="/usr/bin"),
    ):
        words = [*nobody, str(python), "-c", probe]
        if python and subprocess.run(words, env={"PYTHONPATH": LIBRARIES}, capture_output=True).returncode == 0:
            return [*nobody, python]
    pytest.skip("another user cannot run this Python")


def _run(box: Path, home: str | None, *words: object) -> subprocess.CompletedProcess[str]:
    """rnd-play in ``box``."""
    paths = os.pathsep.join([str(box / "packages"), LIBRARIES])
    environment = {"PATH": os.environ["PATH"], "PYTHONPATH": paths, "TMPDIR": str(box / "tmp")}
    if home is not None:
        environment["HOME"] = home
    code = "import sys; from rnd_viewer.play.cli import main; sys.exit(main())"
    command = [*_python(), "-c", code, *map(str, words)]
    return subprocess.run(command, env=environment, cwd=box / "tmp", capture_output=True, text=True, timeout=600)


def _environment_allows_home(home: str | None) -> bool:
    return os.getuid() == 0 or home is not None  # one's own home can be written


@pytest.mark.parametrize("home", HOMES.values(), ids=HOMES)
def test_help_and_doctor_say_where_kernels_are_kept(box, home):
    if not _environment_allows_home(home):
        pytest.skip("the home of this user can be written")
    note = rf"rnd-play: compiled kernels are kept in {box}/tmp/rnd-kernels-\d+: no cache folder can be written.*\n"
    for word in ("--help", "--doctor"):
        done = _run(box, home, word)
        assert done.returncode == 0 and re.fullmatch(note, done.stderr), done.stderr
        assert len(done.stdout.splitlines()) > 5
    assert (box / "tmp").stat().st_mode & 0o777 == 0o777
    (folder,) = (box / "tmp").glob("rnd-kernels-*")
    assert folder.stat().st_mode & 0o777 == 0o700


def test_the_images_recipe_copies_what_is_there():
    """Without docker: files, extras, the user and the command are those of the repository."""
    lines = (ROOT / "Dockerfile").read_text("utf-8").replace("\\\n", " ").splitlines()
    steps = [tuple(line.split(maxsplit=1)) for line in lines if line.strip() and not line.startswith("#")]
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    assert steps[0][0] == "FROM"
    python = re.search(r"python:(\d+)\.(\d+)", steps[0][1])
    least = re.search(r"(\d+)\.(\d+)", project["requires-python"])
    assert python and least and tuple(map(int, python.groups())) >= tuple(map(int, least.groups()))
    for kind, words in steps:
        if kind == "COPY" and "--from" not in words:
            assert all((ROOT / file).exists() for file in words.split()[:-1]), words
    extras = re.findall(r"\[([a-z,]+)\]", " ".join(words for kind, words in steps if kind == "RUN"))
    assert extras and {name for group in extras for name in group.split(",")} <= {*project["optional-dependencies"]}
    commands = [words for kind, words in steps if kind == "ENTRYPOINT"]
    assert commands == ['["rnd-play"]'] and "rnd-play" in project["scripts"]
    users = [words for kind, words in steps if kind == "USER"]
    assert users and users[-1] not in ("root", "0")
