"""What a command sets up before numba is loaded, and where compiled kernels are stored between runs.

numba recompiles a kernel when the file of its outermost function changes, but not when what is inlined from other
files does. So in a clone there is one cache for each state of the sources. Files of an installed package all change
at once, and numba's own cache serves.
"""

from __future__ import annotations

import atexit
import ctypes
import hashlib
import os
import shutil
import stat
import sys
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from .signals import at_end

COMPILING = "compiling kernels for this machine, once: up to two minutes"

_MAX_CACHES = 4
_PACKAGE = Path(__file__).parents[1]
# Idle OpenMP threads that sleep at once take up to 0.5 ms to wake on a virtual machine, at each of a frame's nine
# kernels; those that spin for long take the cores from others. 5000 is about 0.1 ms: a frame of 30 000 Gaussians takes
# 19.5 ms instead of 24, and beside two busy processes 33 instead of 35 to 52.
_ENVIRONMENT = {"OMP_WAIT_POLICY": "passive", "GOMP_SPINCOUNT": "5000", "ORT_DISABLE_TELEMETRY": "1"}
# Bytes that glibc keeps when they are freed: M_TRIM_THRESHOLD (-1), of pieces up to M_MMAP_THRESHOLD (-3). Every
# frame takes the same memory: of fifty people 8 500 pages, whose faults took a seventh of its time.
_KEPT = {-1: 256 << 20, -3: 32 << 20}


def prepare_process() -> str | None:
    """Set up this process for a command: threads that wait, kept memory, no telemetry, a kernel cache by sources.

    Variables that are set stay. For commands and tests, before numba, torch or onnxruntime is loaded.

    Returns:
        A sentence for the user where only a temporary folder can hold the kernels.
    """
    for name, value in _ENVIRONMENT.items():
        os.environ.setdefault(name, value)
    with suppress(AttributeError, TypeError, OSError):  # another C library
        for parameter, size in _KEPT.items():
            ctypes.CDLL(None).mallopt(parameter, size)
    if "NUMBA_CACHE_DIR" in os.environ or "numba" in sys.modules:
        return None
    folder, note = _cache_of_sources(), None
    if folder is None and not _numba_can_write():
        folder = _temporary_cache()
        note = f"compiled kernels are kept in {folder}: no cache folder can be written; NUMBA_CACHE_DIR names one"
    if folder is not None:
        os.environ["NUMBA_CACHE_DIR"] = str(folder)
    return note


def kernels_are_cold(package: Path = _PACKAGE / "raster") -> bool:
    """Whether no kernel of the folder ``package`` is cached yet: a cheap hint, false from the first one on."""
    if chosen := os.environ.get("NUMBA_CACHE_DIR"):
        folders = list(Path(chosen).glob(f"{package.name}_*"))
    else:
        from numba.misc.appdirs import AppDirs  # numba's folder for read-only installations

        users = Path(AppDirs(appname="numba", appauthor=False).user_cache_dir)
        folders = [package / "__pycache__", *users.glob(f"{package.name}_*")]
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
        if not os.access(folder, os.W_OK | os.X_OK):  # numba refuses a folder that it cannot write
            return None
        if new:
            _remove_oldest(folder.parent)
        return folder
    return None


def _numba_can_write() -> bool:
    """Whether numba can write beside the sources or in the user's cache folder."""
    if os.name == "nt":
        return True
    mac = sys.platform == "darwin"
    users = "~/Library/Caches" if mac else os.environ.get("XDG_CACHE_HOME", "~/.cache")
    for folder in (_PACKAGE / "raster" / "__pycache__", Path(os.path.expanduser(users), "numba")):  # noqa: PTH111
        with suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True)
            if os.access(folder, os.W_OK | os.X_OK):
                return True
    return False


def _temporary_cache() -> Path:
    """A private folder of the user, the same at every call; else one that is removed with the process."""
    folder = Path(tempfile.gettempdir()) / f"rnd-kernels-{os.getuid()}"
    with suppress(OSError):
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()  # its owner could have put code into it
        if stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o077:
            return folder
    folder = Path(tempfile.mkdtemp(prefix="rnd-kernels-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    at_end(lambda: shutil.rmtree(folder, ignore_errors=True)).__enter__()
    return folder


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
