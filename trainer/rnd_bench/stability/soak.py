"""Hours of playback and of training: memory, pace and determinism.

Every process adds a segment to ``soak_NAME.json`` in the work folder, so that an interrupted soak resumes; slopes are
of single segments. Pace is also reported over that of a fixed load timed after each frame, since the pace of a shared
machine changes by half within an hour.
"""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from rnd_bench.scenes.subject import Subject
from rnd_runtime.core.files import atomic_path
from rnd_runtime.raster.cpu import rasterize
from rnd_trainer.training.training import Training

from .figures import Figure, at_most, below, not_measured
from .small import studio, tiny_config

SLOPE_BYTES = 1000.0
WARM = 200  # frames or steps before memory is read: caches fill
EVERY = 20  # frames or steps between two readings
TOO_SHORT = "too few in one go"
PACE = 1.2  # median of the last tenth over that of the first, among frames or steps of one kind


def soak_playback(subject: Subject, frames: int, state: Path) -> list[Figure]:
    """Play ``frames`` frames of a repeated motion, including those of earlier processes."""
    walk, camera = subject.walk(4.0), subject.camera()
    count = walk.frame_count

    def frame(number: int) -> str:
        posed = subject.avatar.pose(walk, (number % count) / walk.fps)
        radiance = subject.shader.with_yaw(2 * np.pi * (number % count) / count).shade(posed, camera.position)
        raster = rasterize(posed.means, posed.covariances, posed.opacities, radiance, camera)
        return hashlib.sha256(raster.image.tobytes()).hexdigest()

    return _soak("playback", frame, _fixed_load(subject), frames, state, period=count)


def soak_training(subject: Subject, steps: int, state: Path) -> list[Figure]:
    """Train ``steps`` steps of each kind: plain colours, sampled texels, the whole light."""
    config = tiny_config(steps=3 * steps, gaussians=subject.few(400, 4000))
    training = Training(studio(subject), replace(config, stage1_fraction=1 / 3, full_light_fraction=1 / 3))
    training.warm_up()

    def step(number: int) -> str:
        training.step()
        return ""

    borders = [steps, 2 * steps, 3 * steps]
    return _soak("training", step, _fixed_load(subject), 3 * steps, state, borders=borders)


def _fixed_load(subject: Subject) -> Callable[[], object]:
    """A constant render, which measures the machine's current pace."""
    rest, camera = subject.rest, subject.camera()
    return lambda: rasterize(rest.means, rest.covariances, rest.opacities, rest.albedo, camera)


def _soak(
    name: str,
    work: Callable[[int], str],
    load: Callable[[], object],
    total: int,
    state: Path,
    *,
    period: int = 0,
    borders: Sequence[int] = (),
) -> list[Figure]:
    """Call ``work`` and ``load`` until ``total``.

    Args:
        period: frames after which the same bits are expected; 0: never.
        borders: ends of the kinds of steps; by default all are of one kind.
    """
    state = state.with_stem(f"{state.stem}_{name}")
    record: dict[str, Any] = json.loads(state.read_text(encoding="utf-8")) if state.exists() else {}
    segments = record.setdefault("segments", [])
    done = sum(segment["frames"] for segment in segments) if period else 0
    if not period:
        segments.clear()
    first = record.setdefault("bits", {})
    segment: dict[str, Any] = {"frames": 0, "memory": [], "seconds": [], "loads": [], "wrong": 0}
    segments.append(segment)
    for number in range(done, total):
        started = perf_counter()
        bits = work(number)
        worked = perf_counter()
        load()
        segment["seconds"].append(worked - started)
        segment["loads"].append(perf_counter() - worked)
        if period and number % period % 30 == 0:
            segment["wrong"] += first.setdefault(str(number % period), bits) != bits
        if len(segment["seconds"]) > WARM and number % EVERY == 0:
            segment["memory"].append(_resident())
        segment["frames"] += 1
        if number % 500 == 499 or number == total - 1:
            with atomic_path(state) as temporary:
                temporary.write_text(json.dumps(record), encoding="utf-8")
    return _figures(name, segments, bool(period), borders)


def _figures(name: str, segments: list[dict[str, Any]], repeats: bool, borders: Sequence[int]) -> list[Figure]:
    slopes = [_slope(s["memory"]) for s in segments if len(s["memory"]) > 10]
    within = [_slope(part) for s in segments for part in _parts(s["memory"], borders) if len(part) > 10]
    frames = sum(segment["frames"] for segment in segments)
    what = f"{name}, {frames}: memory a frame"
    figures = [below(what, max(slopes), SLOPE_BYTES, "bytes") if slopes else not_measured(what, TOO_SHORT)]
    if within:
        figures.append(below(f"{what}, within each kind of step", max(within), SLOPE_BYTES, "bytes"))
    parts = list(pairwise((0, *borders))) if borders else [(0, None)]
    pace = f"{name}, {frames}: pace {'of each kind of step, ' if borders else ''}end over start"
    long = [s for s in segments if len(s["seconds"]) > 5 * WARM]
    if long:
        by_load = [[taken / beside for taken, beside in zip(s["seconds"], s["loads"])] for s in long]
        paces = {pace: [s["seconds"] for s in long], f"{pace}, over that of a fixed load beside it": by_load}
        for what, series in paces.items():
            slowest = max(_pace(values[start:end]) for values in series for start, end in parts)
            figures.append(replace(below(what, slowest, PACE, "×"), timing=True))
    if repeats:
        wrong = sum(segment["wrong"] for segment in segments)
        figures.append(at_most(f"{name}, {frames}: frames whose bits changed at the same pose", wrong, 0))
    return figures


def _parts(readings: list[int], borders: Sequence[int]) -> list[list[int]]:
    """``readings`` split at the borders: each kind of step allocates memory of its own once."""
    cuts = [max(0, -(-border // EVERY) - WARM // EVERY) for border in (0, *borders)]
    return [readings[start:end] for start, end in pairwise(cuts)]


def _slope(readings: list[int]) -> float:
    """Least-squares slope of the readings, bytes per frame."""
    return float(np.polyfit(EVERY * np.arange(len(readings)), readings, 1)[0])


def _pace(seconds: list[float]) -> float:
    tenth, cold = max(1, len(seconds) // 10), min(WARM // 4, len(seconds) // 10)
    return float(np.median(seconds[-tenth:]) / np.median(seconds[cold : cold + tenth]))


def _resident() -> int:
    """Private dirty and swapped bytes of this process, after malloc has returned freed memory."""
    with contextlib.suppress(OSError, AttributeError):  # glibc only
        ctypes.CDLL(None).malloc_trim(0)
    fields = dict(line.split(":", 1) for line in Path("/proc/self/smaps_rollup").read_text("ascii").splitlines()[1:])
    return 1024 * sum(int(fields[name].split()[0]) for name in ("Private_Dirty", "Swap"))
