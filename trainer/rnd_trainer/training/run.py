"""Training loop: steps, log, status, states, previews and Ctrl-C."""

from __future__ import annotations

import json
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, TextIO

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import atomic_path, write_json
from rnd_runtime.core.signals import at_end, on_signal

from .saving import save_training
from .training import POSE_FIT, StepResult, Training

METRICS_FILE, STATUS_FILE = "metrics.jsonl", "status.json"
"""in a run's folder: one row per step; current progress"""
PHASES = {1: "geometry", 2: "albedo and light", 3: "unseen poses"}
"""names of the stages"""
WARM_UP = "warming up"
STATUS_S = 1.0
"""seconds between two writes of the status"""
RECENT = 200
"""steps over which the speed is estimated"""


def run(
    training: Training,
    folder: Path,
    *,
    on_step: Callable[[StepResult], None],
    on_preview: Callable[[], None],
    on_phase: Callable[[str, float, float], None] = lambda name, done, total: None,
) -> bool:
    """Train to the last step, saving every ``save_every`` steps and at the end.

    The first Ctrl-C, SIGTERM or SIGHUP finishes the current step, or leaves a fit of poses, and saves; resuming
    continues the same curve.

    Args:
        folder: for ``metrics.jsonl``, ``status.json``, states and checkpoint.
        on_phase: called with name, done and total when a phase begins, and during searches.

    Returns:
        Whether a signal stopped the training.
    """
    config, total = training.config, training.schedule.total
    status = _Status(training, folder / STATUS_FILE)
    stage, interrupted = 0, False

    def begin(name: str, done: float, of: float) -> None:
        status.write(name)
        on_phase(name, done, of)

    def search(name: str, done: float, of: float) -> None:
        nonlocal stage
        stage = 0  # the stage's phase begins afterwards
        begin(name, done, of)
        if interrupted and name == POSE_FIT:
            raise _LeaveError

    def interrupt() -> None:
        nonlocal interrupted
        interrupted = True

    def stop() -> None:
        with suppress(OSError, InputError):  # e.g. of a full disk
            status.end("stopped")

    training.on_search = search
    try:
        with at_end(stop):
            if training.step_index < config.steps:
                begin(WARM_UP, 0, 1)
                training.warm_up()
            with _log_up_to(folder / METRICS_FILE, training.step_index) as log, on_signal(interrupt):
                while training.step_index < total and not interrupted:
                    if training.stage != stage:
                        stage = training.stage
                        cost = training.schedule.cost
                        begin(PHASES[stage], cost(training.step_index), cost(total))
                    try:
                        step = training.step()
                    except _LeaveError:
                        break
                    row = {"step": step.index, "stage": step.stage, "seconds": round(training.seconds, 3), **step.terms}
                    log.write(json.dumps(row | ({"skipped": True} if step.skipped else {})) + "\n")
                    status.write(PHASES[step.stage])
                    on_step(step)
                    if training.step_index % config.save_every == 0:
                        log.flush()
                        save_training(training, folder)
                    if training.step_index % config.preview_every == 0 or training.step_index == total:
                        on_preview()
                save_training(training, folder)
    except BaseException:
        stop()
        raise
    stopped = training.step_index < total
    status.end("stopped" if stopped else "finished")
    return stopped


class _LeaveError(Exception):
    """Leaves a step before it has begun."""


class _Status:
    """Writer of ``status.json``: phase, step, steps, seconds, seconds left, and how the training ended."""

    def __init__(self, training: Training, path: Path) -> None:
        self._training, self._path = training, path
        self._phase, self._written = "", 0.0
        self._recent: deque[tuple[float, float]] = deque(maxlen=RECENT)  # seconds and cost after each step

    def write(self, phase: str) -> None:
        """Record a step; write the file if the phase is new or the last write older than ``STATUS_S``."""
        training = self._training
        self._recent.append((training.seconds, training.schedule.cost(training.step_index)))
        if phase != self._phase or time.monotonic() - self._written > STATUS_S:
            self._phase = phase
            self._write(None)

    def end(self, how: str) -> None:
        """Write the final status, ``finished`` or ``stopped``."""
        self._write(how)

    def _write(self, ended: str | None) -> None:
        training = self._training
        self._written = time.monotonic()
        values: dict[str, Any] = {
            "phase": self._phase,
            "step": training.step_index,
            "steps": training.schedule.total,
            "seconds": round(training.seconds, 1),
            "seconds_left": self._seconds_left(),
            "ended": ended,
        }
        write_json(self._path, values)

    def _seconds_left(self) -> float | None:
        if not self._recent:
            return None
        (before, first), (now, done) = self._recent[0], self._recent[-1]
        left = self._training.schedule.cost(self._training.schedule.total) - done
        return round(left * (now - before) / (done - first), 1) if done > first else None


def _log_up_to(path: Path, step: int) -> TextIO:
    """Open the metrics log for appending, without damaged rows and rows from ``step`` on."""
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines() if path.exists() else []
    valid = [line for line in lines if (row := _row(line)) is not None and row["step"] < step]
    with atomic_path(path) as temporary:
        temporary.write_text("".join(line + "\n" for line in valid), encoding="utf-8")
    return path.open("a", encoding="utf-8", buffering=1)  # line-buffered for rnd-view


def _row(line: str) -> dict[str, Any] | None:
    try:
        row = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return row if isinstance(row, dict) and isinstance(row.get("step"), int) else None
