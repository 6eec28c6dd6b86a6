"""The start of a command of ours: what its compiler loads, and Python's collector, which can wait until then."""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rnd_runtime.avatar.networks import Networks


@contextmanager
def quick_start(avatar: str | Path | None = None, threads: int | None = None) -> Iterator[Future[Networks] | None]:
    """For commands, not for libraries: numba loads without scipy, and no garbage is collected until ``settle``.

    Loading makes half a million objects that stay, which Python would look through again and again: a tenth of the
    time to the first frame. To be left when the command has ended.

    Args:
        avatar: a file whose networks are loaded meanwhile, for ``avatar.avatar.Avatar.load``, which also tells
            what is wrong with it; a command that ends before waits for it. threads: of onnxruntime; with more than
            there are cores nothing is loaded.
    """
    gc.disable()
    aside = ThreadPoolExecutor(1, "ahead")
    try:
        sound = threads is None or 1 <= threads <= (os.cpu_count() or 1)
        ahead = aside.submit(_networks, avatar, threads) if avatar is not None and sound else None
        aside.shutdown(wait=False)
        _load_numba_without_scipy()
        yield ahead
    finally:
        gc.unfreeze()  # or libraries would report what the interpreter's end does not reach
        gc.enable()


def settle() -> None:
    """Within ``quick_start``: what there is is not looked through any more, what comes is collected as ever."""
    if not gc.isenabled():
        gc.freeze()
        gc.enable()


def _networks(avatar: str | Path, threads: int | None) -> Networks:
    from rnd_runtime.avatar.networks import Networks

    return Networks.load(avatar, threads)


def _load_numba_without_scipy() -> None:
    """Spares a process of ours a fifth of a second: numba loads scipy, where it is installed, for products of arrays.

    Our kernels have none. Kernels of others that share the process cannot have any afterwards either.
    """
    if "scipy.linalg" in sys.modules:
        return
    sys.modules["scipy.linalg"] = None  # type: ignore[assignment]  # an import of it fails
    try:
        import numba.np.arraymath  # noqa: F401
    finally:
        del sys.modules["scipy.linalg"]
