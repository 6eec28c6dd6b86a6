"""Soak: hours of playback and of training, watched for memory, pace and bits.

Resumable: every process adds its segment to ``soak_NAME.json`` in the work folder (a file for playback and one for
training: writing the other's twenty thousand numbers would be seen in this one's memory); slopes are taken within
segments. Pace is given as it was, and over that of a fixed load, timed after each frame: on a machine whose own pace
changes by half within the hour the second tells more.
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

from rnd_bench.scenes.figures import Figure, at_most, below, not_measured
from rnd_bench.scenes.subject import Subject
from rnd_runtime.core.files import atomic_path
from rnd_runtime.raster.cpu import rasterize

from .trainings import studio, tiny_config

SLOPE_BYTES = 1000.0
WARM = 200
"""frames or steps before memory is watched: caches fill"""
EVERY = 20
"""frames or steps between two readings"""
TOO_SHORT = "too few in one go"
PACE = 1.2
"""median of the last tenth over that of the first, among frames or steps of one kind"""


def soak_playback(subject: Subject, frames: int, state: Path) -> list[Figure]:
    """Play ``frames`` frames, over and over the same motion; counts what earlier processes did."""
    walk, camera = subject.walk(4.0), subject.camera()
    count = walk.frame_count

    def frame(number: int) -> str:
        posed = subject.avatar.pose(walk, (number % count) / walk.fps)
        shader = subject.shader.turned(2 * np.pi * (number % count) / count)
        radiance = shader.shade(posed, camera.position)
        raster = rasterize(posed.means, posed.covariances, posed.opacities, radiance, camera)
        return hashlib.sha256(raster.image.tobytes()).hexdigest()

    return _soak("playback", frame, _fixed_load(subject), frames, state, same=count)


def soak_training(subject: Subject, steps: int, state: Path) -> list[Figure]:
    """Train in one go (a resumed training is R11's), after a rehearsal as every training has.

    Steps are of three kinds: plain colours, drawn texels, the whole light. The last does twice the first's work by
    design, so each kind gets ``steps`` steps, and its end is compared with its own start. The third stage, whose steps
    have no picture, is left out.
    """
    from rnd_trainer.training.training import Training

    borders = [steps, 2 * steps, 3 * steps]
    config = replace(
        tiny_config(steps=3 * steps, gaussians=subject.few(400, 4000)), stage1_fraction=1 / 3, full_light_fraction=1 / 3
    )
    training = Training(studio(subject), config)
    training.rehearse()

    def step(number: int) -> str:
        training.step()
        return ""

    return _soak("training", step, _fixed_load(subject), 3 * steps, state, same=0, borders=borders)


def _fixed_load(subject: Subject) -> Callable[[], object]:
    """One picture, always the same: how fast the machine is just now."""
    rest, camera = subject.rest, subject.camera()
    return lambda: rasterize(rest.means, rest.covariances, rest.opacities, rest.albedo, camera)


def _soak(
    name: str,
    work: Callable[[int], str],
    load: Callable[[], object],
    total: int,
    state: Path,
    *,
    same: int,
    borders: Sequence[int] = (),
) -> list[Figure]:
    """``load``: timed after each frame or step, since a machine that others use has a pace of its own.

    ``same``: after how many frames the same bits must come back; 0 where nothing repeats.

    ``borders``: where each kind of frame or step ends; by default all are of one kind.
    """
    state = state.with_stem(f"{state.stem}_{name}")
    record: dict[str, Any] = json.loads(state.read_text(encoding="utf-8")) if state.exists() else {}
    segments = record.setdefault("segments", [])
    done = sum(segment["frames"] for segment in segments) if same else 0
    if not same:
        segments.clear()
    first = record.setdefault("bits", {})
    memory: list[int] = []
    seconds: list[float] = []
    loads: list[float] = []
    wrong = 0
    segment: dict[str, Any] = {"frames": 0, "memory": memory, "seconds": seconds, "loads": loads, "wrong": 0}
    segments.append(segment)
    for number in range(done, total):
        started = perf_counter()
        bits = work(number)
        worked = perf_counter()
        load()
        seconds.append(worked - started)
        loads.append(perf_counter() - worked)
        if same and number % same % 30 == 0:  # every second's first frame is remembered
            wrong += first.setdefault(str(number % same), bits) != bits
        if len(seconds) > WARM and number % EVERY == 0:
            memory.append(_resident())
        segment["frames"] += 1
        segment["wrong"] = wrong
        if number % 500 == 499:
            _save(state, record)
    _save(state, record)
    return _figures(name, segments, bool(same), borders)


def _figures(name: str, segments: list[dict[str, Any]], same: bool, borders: Sequence[int]) -> list[Figure]:
    slopes = [_slope(s["memory"]) for s in segments if len(s["memory"]) > 10]
    long = [(s["seconds"], s["loads"]) for s in segments if len(s["seconds"]) > 10 * WARM // 2]
    frames = sum(segment["frames"] for segment in segments)
    what = f"{name}, {frames}: memory a frame"
    figures = [below(what, max(slopes), SLOPE_BYTES, "bytes") if slopes else not_measured(what, TOO_SHORT)]
    within = [_slope(part) for s in segments for part in _parts(s["memory"], borders) if len(part) > 10]
    if within:
        what = f"{name}, {frames}: memory a frame, within each kind of step"
        figures.append(below(what, max(within), SLOPE_BYTES, "bytes"))
    parts = list(pairwise((0, *borders))) if borders else [(0, None)]
    pace = f"{name}, {frames}: pace {'of each kind of step, ' if borders else ''}end over start"
    if long:
        slowest = max(_pace(seconds[start:end]) for seconds, _ in long for start, end in parts)
        figures.append(replace(below(pace, slowest, PACE, "×"), timing=True))
        by_load = [[taken / beside for taken, beside in zip(*times)] for times in long]
        slowest = max(_pace(ratios[start:end]) for ratios in by_load for start, end in parts)
        over = f"{pace}, over that of a fixed load beside it"
        figures.append(replace(below(over, slowest, PACE, "×"), timing=True))
    if same:
        wrong = sum(segment["wrong"] for segment in segments)
        figures.append(at_most(f"{name}, {frames}: frames whose bits changed at the same pose", wrong, 0))
    return figures


def _parts(readings: list[int], borders: Sequence[int]) -> list[list[int]]:
    """``readings`` cut where a kind of frame or step begins, which asks for memory of its own, once."""
    places = [max(0, -(-border // EVERY) - WARM // EVERY) for border in (0, *borders)]
    return [readings[start:end] for start, end in pairwise(places)]


def _slope(readings: list[int]) -> float:
    """Bytes a frame, least squares over the readings."""
    return float(np.polyfit(EVERY * np.arange(len(readings)), readings, 1)[0])


def _pace(seconds: list[float]) -> float:
    tenth, cold = max(1, len(seconds) // 10), min(WARM // 4, len(seconds) // 10)
    return float(np.median(seconds[-tenth:]) / np.median(seconds[cold : cold + tenth]))


def _resident() -> int:
    """Bytes that this process wrote and holds. Clean pages are files', ours as long as no other process maps them too:
    torch's 170 MB of code come and go with other people's programs. What malloc keeps of freed memory, tens of MB that
    come and go with the largest of them, is given back first: a leak would stay.
    """
    with contextlib.suppress(OSError, AttributeError):  # glibc has it
        ctypes.CDLL(None).malloc_trim(0)
    fields = dict(line.split(":", 1) for line in Path("/proc/self/smaps_rollup").read_text("ascii").splitlines()[1:])
    return 1024 * sum(int(fields[name].split()[0]) for name in ("Private_Dirty", "Swap"))


def _save(state: Path, record: dict[str, Any]) -> None:
    with atomic_path(state) as temporary:
        temporary.write_text(json.dumps(record), encoding="utf-8")
