"""Lines on a terminal as they are."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console


def print_plain(console: Console, line: str) -> None:
    """Print ``line`` letter by letter: a name with [b] or :b: in it means neither bold nor a button, and a terminal's
    edge breaks nothing that is to be copied."""
    console.print(line, markup=False, emoji=False, highlight=False, soft_wrap=True)
