"""What a command sets up before numba is loaded, and where compiled kernels are stored between runs.

numba recompiles a kernel when the file of its outermost function changes, but not when what is inlined from other
files does. So in a clone there is one cache for each state of the sources. Files of an installed package all change
at once, and numba's own cache serves.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

COMPILING = "compiling kernels for this machine, once: up to two minutes"

_MAX_CACHES = 4
_PACKAGE = Path(__file__).parents[1]
# Idle OpenMP threads that sleep at once take up to 0.5 ms to wake on a virtual machine, at each of a frame's nine
# kernels; those that spin for long take the cores from others. 5000 is about 0.1 ms: a frame of 30 000 Gaussians takes
# 19.5 ms instead of 24, and beside two busy processes 33 instead of 35 to 52.
_ENVIRONMENT = {"OMP_WAIT_POLICY": "passive", "GOMP_SPINCOUNT": "5000", "ORT_DISABLE_TELEMETRY": "1"}


def prepare_process() -> None:
    """Set this process's environment for a command: threads that wait, no telemetry, a kernel cache by sources.

    Variables that are set stay. For commands and tests, before numba, torch or onnxruntime is loaded.
    """
    for name, value in _ENVIRONMENT.items():
        os.environ.setdefault(name, value)
    if "NUMBA_CACHE_DIR" not in os.environ and "numba" not in sys.modules and (folder := _cache_of_sources()):
        os.environ["NUMBA_CACHE_DIR"] = str(folder)


def kernels_are_cold() -> bool:
    """Whether no kernel of the rasteriser is cached yet: a cheap hint, false from the first one on."""
    raster = _PACKAGE / "raster"
    if kept := os.environ.get("NUMBA_CACHE_DIR"):
        folders = list(Path(kept).glob(f"{raster.name}_*"))
    else:
        from numba.misc.appdirs import AppDirs  # numba's place for installations that cannot be written

        users = Path(AppDirs(appname="numba", appauthor=False).user_cache_dir)
        folders = [raster / "__pycache__", *users.glob(f"{raster.name}_*")]
    return not any(file for folder in folders for file in folder.glob("*.nbi"))


def _cache_of_sources() -> Path | None:
    """A clone's cache folder for its sources as they are; None outside of a clone, or if it cannot be written."""
    clone = _PACKAGE.parents[1]
    if not (clone / "pyproject.toml").is_file():
        return None
    with suppress(OSError):
        digest = hashlib.sha256()
        for file in _sources(clone):
            digest.update(file.relative_to(clone).as_posix().encode() + file.read_bytes())
        folder = clone / ".cache" / "kernels" / digest.hexdigest()[:16]
        new = not folder.is_dir()
        folder.mkdir(parents=True, exist_ok=True)
        if new:
            _remove_oldest(folder.parent)
        return folder
    return None


def _remove_oldest(caches: Path) -> None:
    with suppress(OSError):  # another process removes them too
        for old in sorted(caches.iterdir(), key=lambda path: path.stat().st_mtime)[:-_MAX_CACHES]:
            shutil.rmtree(old, ignore_errors=True)


def _sources(clone: Path) -> Iterator[Path]:
    """This package, whose constants kernels hold, and other files that define kernels."""
    yield from sorted(_PACKAGE.rglob("[!.]*.py"))  # a name with a dot is an editor's
    for file in sorted((clone / "trainer").rglob("[!.]*.py")):
        if b"njit" in file.read_bytes():
            yield file
