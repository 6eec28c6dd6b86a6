"""Shared functions of the commands."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from rnd_runtime.cli.command import log
from rnd_runtime.cli.extras import need_packages

if TYPE_CHECKING:
    from rich.console import Console

WIDTH = 140
"""characters of the widest table"""


def need_extra() -> None:
    """Raise ``InputError``, with the extra to install, if a package for training is missing."""
    need_packages("train", "torch", "safetensors", "scipy")


def log_all(notes: Iterable[str]) -> None:
    """Log each note on a line of its own."""
    for note in notes:
        log(note)


def wide_console() -> Console:
    """Console that wraps lines on a narrow terminal instead of truncating them."""
    from rich.console import Console

    return Console(width=max(Console().width, WIDTH), soft_wrap=True)
