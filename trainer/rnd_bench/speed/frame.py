"""Timing of frames in a process of their own, without torch, so that memory and time are a player's.

Motion and light change from frame to frame.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rnd_bench.scenes.scenes import USUAL, bench_camera
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.signals import temporary_folder

Floats32 = NDArray[np.float32]

WARMUP = 5
STEP_S = 1 / 30  # of the motion, from frame to frame
STEP_YAW = 0.02  # radians of the light, from frame to frame
COMPARED = (8, 19, 30, 41, 52, 63, 74, 85)  # frames compared with the reference
DEADLINE_S = 300.0


def summary(taken: Sequence[float]) -> dict[str, float]:
    """Median, p95 and minimum of milliseconds."""
    values = {"median": np.median(taken), "p95": np.percentile(taken, 95), "min": np.min(taken)}
    return {f"ms_{name}": float(value) for name, value in values.items()}


@dataclass(frozen=True)
class Point:
    """What is rendered and how; ``seconds`` bounds the time spent on ``frames``."""

    avatar: str
    motion: str
    hdr: str
    size: int = 512
    shade: str = "table+sun"
    raster: str = "cpu"
    threads: int = 2
    frames: int = 90
    seconds: float = 6.0
    cull: float | None = None
    view: str = USUAL


class Measured(NamedTuple):
    """Times of a point, and its frames ``COMPARED``.

    Attributes:
        row: ms_*, stages (median ms), stages_p95, cold_start_ms (process start to first frame), peak_mb, file_mb, …
        radiance: [K, H, W, 3] linear, premultiplied.
        means: [K, N, 3] m.
    """

    row: dict[str, Any]
    radiance: Floats32
    means: Floats32


def measure(point: Point) -> Measured:
    """Run ``point`` in a process of its own. Raises ``InputError`` where it cannot be rendered here."""
    threads = str(point.threads)
    environment = os.environ | {"NUMBA_NUM_THREADS": threads, "OMP_NUM_THREADS": threads, "OMP_WAIT_POLICY": "PASSIVE"}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)  # cold starts are timed with compiled modules
    with temporary_folder() as out:
        (out / "point.json").write_text(json.dumps(asdict(point)), encoding="utf-8")
        code = "import sys; from rnd_bench.speed.frame import render; render(sys.argv[1], float(sys.argv[2]))"
        line = [sys.executable, "-c", code, str(out), repr(time.monotonic())]
        what = f"{point.raster}, {point.shade}"
        try:
            done = subprocess.run(
                line, env=environment, capture_output=True, text=True, check=False, timeout=DEADLINE_S
            )
        except subprocess.TimeoutExpired as error:
            raise InputError(what, expected=f"an answer within {DEADLINE_S:g} s", got="none") from error
        if done.returncode:
            why = (done.stderr.strip().splitlines() or ["no answer"])[-1]
            why = why.removeprefix(f"{InputError.__module__}.{InputError.__qualname__}: ")
            raise InputError(what, got=why[:200])
        row = json.loads((out / "row.json").read_text("utf-8"))
        with np.load(out / "frames.npz") as frames:
            return Measured(row, frames["radiance"], frames["means"])


def render(folder: str, spawned: float) -> None:
    """Read point.json, write row.json and frames.npz; ``spawned`` is the monotonic clock at the process's start."""
    from rnd_runtime.playback.start import load_ahead

    out = Path(folder)
    point = Point(**json.loads((out / "point.json").read_text("utf-8")))
    _render(point, out, spawned, load_ahead(point.avatar, point.threads))  # as rnd-play does


def _render(point: Point, out: Path, spawned: float, ahead: Any) -> None:
    from rnd_runtime.avatar.avatar import Avatar
    from rnd_runtime.motion.motion import load_motion
    from rnd_runtime.playback.frame import FrameRenderer
    from rnd_runtime.shading.files.load import load_light

    avatar = Avatar.load(point.avatar, threads=point.threads, ahead=ahead)
    motion = load_motion(Path(point.motion), avatar.skeleton)
    light = load_light(Path(point.hdr))
    raster: Any = point.raster
    camera = bench_camera(point.size, point.view)
    renderer = FrameRenderer(avatar, light, camera, shade=point.shade, raster=raster, cull=point.cull)

    def frame(number: int) -> Any:
        renderer.turn(STEP_YAW * number)
        return renderer.render(motion, STEP_S * number)

    frame(0)
    cold_ms = 1e3 * (time.monotonic() - spawned)
    for number in range(1, WARMUP):
        frame(number)
    taken: list[float] = []
    stages: dict[str, list[float]] = {}
    until = time.perf_counter() + point.seconds
    while len(taken) < point.frames and (len(taken) < 5 or time.perf_counter() < until):
        before = time.perf_counter()
        done = frame(WARMUP + len(taken))
        taken.append(1e3 * (time.perf_counter() - before))
        for name, seconds in done.stage_seconds.items():
            stages.setdefault(name, []).append(1e3 * seconds)
    peak_mb = _peak_mb()
    compared = [frame(number).radiance for number in COMPARED]
    means = [avatar.pose(motion, STEP_S * number).means for number in COMPARED]
    row = {
        **summary(taken),
        "stages": {name: float(np.median(values)) for name, values in stages.items()},
        "stages_p95": {name: float(np.percentile(values, 95)) for name, values in stages.items()},
        "cold_start_ms": cold_ms,
        "peak_mb": peak_mb,
        "file_mb": Path(point.avatar).stat().st_size / 1e6,
        "frames": len(taken),
        "warmup": WARMUP,
        "renderer": renderer.draws_with,
    }
    (out / "row.json").write_text(json.dumps(row), encoding="utf-8")
    np.savez(out / "frames.npz", radiance=np.array(compared), means=np.array(means))
    renderer.close()


def _peak_mb() -> float:
    import resource

    try:  # ru_maxrss includes the peak of the parent process
        status = Path("/proc/self/status").read_text(encoding="ascii")
        return next(int(line.split()[1]) for line in status.splitlines() if line.startswith("VmHWM")) / 1024
    except (OSError, StopIteration):
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
