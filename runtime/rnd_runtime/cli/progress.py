"""How far a long command is: a bar on a terminal, else a line every 30 s. For commands only."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterable, Iterator
from typing import TypeVar

from rich.console import Console
from rich.progress import BarColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Bar

from .command import is_quiet, log

Item = TypeVar("Item")
INTERVAL = 30.0
"""seconds between two lines where stderr is no terminal"""
_WINDOW = 60.0
"""seconds over which the speed is estimated,"""
_REPORTS = 20
"""and reports at least: one may have waited for something else"""


class Progress:
    """A context in which phases, one after the other, report how far they are; silent under ``--quiet``.

    ::

        with Progress() as progress:
            progress.phase("fitting the light", 40)
            for step in range(40):
                progress.update(step + 1, loss=loss)

    A terminal shows a bar; elsewhere stderr gets a line as a phase begins, and every 30 s
    ``fitting the light · 12/40 · loss 0.0312 · 2 min left``. Log lines of ``core.command`` go above the bar.
    """

    def __init__(self) -> None:
        console = Console(stderr=True)
        self._bar = None
        if console.is_terminal and not is_quiet():
            columns = (
                TextColumn("{task.description}", markup=False),
                BarColumn(),
                TextColumn("{task.fields[state]}", markup=False),
                TimeRemainingColumn(),
            )
            self._bar = Bar(*columns, console=console, speed_estimate_period=_WINDOW)
            self._task = self._bar.add_task("", total=None, state="", visible=False)
        self._name = ""
        self._total: float | None = None
        self._seen: deque[tuple[float, float]] = deque()
        self._next = 0.0

    def __enter__(self) -> Progress:
        if self._bar:
            self._bar.start()
        return self

    def __exit__(self, *exception: object) -> None:
        if self._bar:
            self._bar.stop()

    def phase(self, name: str, total: float | None = None, *, done: float = 0) -> None:
        """Begin the phase ``name`` of ``total`` steps (unknown if None), ``done`` of which were done before."""
        now = time.monotonic()
        self._name, self._total, self._next = name, total, now + INTERVAL
        self._seen = deque([(now, done)])
        if self._bar:
            self._bar.reset(self._task, description=name, total=total, completed=int(done), state="", visible=True)
        else:
            log(name)

    def update(self, done: float, *, step: str | None = None, loss: float | None = None) -> None:
        """Report that ``done`` of the phase's total is done.

        Args:
            step: what is shown of it, ``done/total`` by default: a phase whose steps cost differently counts cost.
            loss: shown too.
        """
        words = [step or (f"{done:g}" if self._total is None else f"{done:g}/{self._total:g}")]
        if loss is not None:
            words.append(f"loss {loss:.4f}")
        if self._bar:
            self._bar.update(self._task, completed=done, state=" · ".join(words))
            return
        now = time.monotonic()
        self._seen.append((now, done))
        while len(self._seen) > _REPORTS and self._seen[1][0] < now - _WINDOW:
            self._seen.popleft()
        if now >= self._next:
            self._next = now + INTERVAL
            log(" · ".join([self._name, *words, *self._left()]))

    def forget_speed(self) -> None:
        """Estimate the time left from the next report on, as after a first step that compiles."""
        self._seen.clear()

    def at(self, name: str, done: float, total: float) -> None:
        """Report that ``done`` of ``total`` steps of the phase ``name`` are done; another name begins a phase."""
        if name != self._name:
            self.phase(name, total, done=done)
        self.update(done)

    def _left(self) -> Iterator[str]:
        (before, first), (now, done) = self._seen[0], self._seen[-1]
        if self._total is not None and done > first:
            yield f"{_duration((self._total - done) * (now - before) / (done - first))} left"


def track(name: str, items: Iterable[Item], total: int) -> Iterator[Item]:
    """Yield ``items`` as a phase ``name`` of ``total`` steps; the first does not count for the time left."""
    with Progress() as progress:
        progress.phase(name, total)
        for done, item in enumerate(items, 1):
            yield item
            if done == 1:
                progress.forget_speed()
            progress.update(done)


def _duration(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
