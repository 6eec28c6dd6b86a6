"""Kernels before they run: whether they are compiled yet, which takes minutes, and what their compiler loads."""

from __future__ import annotations

import os
import sys
from pathlib import Path

COMPILING = "compiling kernels for this machine, once: up to two minutes"


def kernels_are_cold() -> bool:
    """Whether numba keeps nothing of this package yet, where it would keep it.

    Cheap, and no more than a hint: of several kernels the first that is kept makes it false.
    """
    own = Path(__file__).parent
    if kept := os.environ.get("NUMBA_CACHE_DIR"):
        folders = list(Path(kept).glob(f"{own.name}_*"))
    else:
        from numba.misc.appdirs import AppDirs  # where numba goes if an installation is not ours to write

        users = Path(AppDirs(appname="numba", appauthor=False).user_cache_dir)
        folders = [own / "__pycache__", *users.glob(f"{own.name}_*")]
    return not any(file for folder in folders for file in folder.glob("*.nbi"))


def load_numba_without_scipy() -> None:
    """Spare a process of ours a fifth of a second: numba loads scipy, where it is installed, for products of arrays.

    Our kernels have none. Kernels of others that share the process cannot have any afterwards either, so this is for
    commands, not for libraries.
    """
    if "scipy.linalg" in sys.modules:
        return
    sys.modules["scipy.linalg"] = None  # type: ignore[assignment]  # an import of it fails
    try:
        import numba.np.arraymath  # noqa: F401
    finally:
        del sys.modules["scipy.linalg"]
