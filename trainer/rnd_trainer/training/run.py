"""A training from where it stands to its last step: the log, the states, and Ctrl-C."""

from __future__ import annotations

import json
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

from rnd_runtime.core.files import atomic_path

from .metrics_log import row_of
from .training import Step, Training


def run(training: Training, folder: Path, *, on_step: Callable[[Step], None], on_preview: Callable[[], None]) -> bool:
    """Train to the last step after a rehearsal, saving every ``save_every`` steps and at the end.

    Ctrl-C finishes the step in hand, saves, and returns True where steps are left: resuming continues the very same
    curve.
    """
    config, total = training.config, training.schedule.total
    if training.step_index < config.steps:
        training.rehearse()
    with _keep_until(folder / "metrics.jsonl", training.step_index) as log, _deferred_interrupt() as interrupted:
        while training.step_index < total and not interrupted():
            step = training.step()
            row = {"step": step.index, "stage": step.stage, "seconds": round(training.seconds, 3), **step.terms}
            log.write(json.dumps(row | ({"skipped": True} if step.skipped else {})) + "\n")
            on_step(step)
            if training.step_index % config.save_every == 0:
                log.flush()
                training.save(folder)
            if training.step_index % config.preview_every == 0 or training.step_index == total:
                on_preview()
        training.save(folder)
        return interrupted() and training.step_index < total


def _keep_until(path: Path, step: int) -> TextIO:
    """The metrics log, without rows at or after ``step``: those steps will be done again. Damaged rows go too."""
    kept = []
    if path.exists():
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
        kept = [line for line in lines if (row := row_of(line)) is not None and row["step"] < step]
    with atomic_path(path) as temporary:
        temporary.write_text("".join(line + "\n" for line in kept), encoding="utf-8")
    return path.open("a", encoding="utf-8", buffering=1)  # line by line: --view reads along


@contextmanager
def _deferred_interrupt() -> Iterator[Callable[[], bool]]:
    """Turn the first Ctrl-C into a flag; a second one interrupts at once."""
    pressed = False

    def handle(number: int, frame: object) -> None:
        nonlocal pressed
        if pressed:
            raise KeyboardInterrupt
        pressed = True

    if threading.current_thread() is not threading.main_thread():  # only the main thread may handle signals
        yield lambda: False
        return
    before = signal.signal(signal.SIGINT, handle)
    try:
        yield lambda: pressed
    finally:
        signal.signal(signal.SIGINT, before)
