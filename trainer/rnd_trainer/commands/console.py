"""Shared functions of the commands."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterable
from typing import TYPE_CHECKING

from rnd_runtime.cli.command import log
from rnd_runtime.core.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console

WIDTH = 140
"""characters of the widest table"""


def need_extra() -> None:
    """Raise ``InputError``, with the extra to install, if a package for training is missing."""
    for package in ("torch", "safetensors", "scipy"):
        if importlib.util.find_spec(package) is None:
            hint = 'needs the extra: pip install "rnd-avatar[train]", in a clone ".[train]"'
            raise InputError(f"{package} is not installed", hint=hint)


def log_all(notes: Iterable[str]) -> None:
    """Log each note on a line of its own."""
    for note in notes:
        log(note)


def wide_console() -> Console:
    """Console that wraps lines on a narrow terminal instead of truncating them."""
    from rich.console import Console

    return Console(width=max(Console().width, WIDTH), soft_wrap=True)
