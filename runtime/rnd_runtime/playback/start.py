"""Loading of an avatar's networks during a command's imports."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING

from rnd_runtime.core.threads import cores

if TYPE_CHECKING:
    from rnd_runtime.avatar.networks import Networks


def load_ahead(avatar: str | Path | None, threads: int | None = None) -> Future[Networks] | None:
    """Start loading the networks of ``avatar`` in another thread, for ``avatar.avatar.Avatar.load``.

    None without an avatar, or with more ``threads`` (of onnxruntime) than cores.
    """
    if avatar is None or not (threads is None or 1 <= threads <= cores()):
        return None
    executor = ThreadPoolExecutor(1, "ahead")
    ahead = executor.submit(_networks, avatar, threads)
    executor.shutdown(wait=False)
    return ahead


def _networks(avatar: str | Path, threads: int | None) -> Networks:
    from rnd_runtime.avatar.networks import Networks

    return Networks.load(avatar, threads)
