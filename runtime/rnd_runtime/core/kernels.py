"""Kernels before they run: whether they are compiled yet, which takes minutes."""

from __future__ import annotations

import os
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
