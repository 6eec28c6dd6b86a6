"""Paired times of one avatar's frames by two checkouts of this project.

Each checkout renders in a process of its own, eight frames at a time, alternating, so that the machine's load is the
same for both. Reported is the median of the paired ratios, with its standard error.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import existing_file

PACKAGES = ("runtime", "trainer", "export", "viewer")
FRAMES, WARM_UP = 8, 2  # frames of a pair that are timed, and those before them
MEDIAN_ERROR = 1.25  # standard error of a median over that of a mean, for normal deviates

# runs with a checkout's own packages; one line of times for each line on stdin
RENDER = """
import json, sys
from time import perf_counter
from rnd_runtime.core.kernels import prepare_process
prepare_process()
from rnd_runtime.avatar.avatar import Avatar
from rnd_runtime.core.camera import Camera
from rnd_runtime.motion.motion import load_motion
from rnd_runtime.playback.frame import FrameRenderer
from rnd_runtime import load_light
avatar, motion, hdr, shade, size, threads, frames, warm_up = sys.argv[1:]
avatar = Avatar.load(avatar, threads=int(threads))
motion, light = load_motion(motion, avatar.skeleton), load_light(hdr)
camera = Camera.look_at([1.163, 0.9, 3.195], [0, 0.875, 0], width=int(size), height=int(size), fov_y=0.704)
renderer = FrameRenderer(avatar, light, camera, shade=shade)
for line in sys.stdin:
    first, times = int(line), []
    for number in range(first - int(warm_up), first + int(frames)):
        started = perf_counter()
        renderer.turn(0.02 * number)
        frame = renderer.render(motion, number / 30)
        total = perf_counter() - started
        times.append({name: 1e3 * s for name, s in {"frame": total, **frame.stage_seconds}.items()})
    print(json.dumps(times[int(warm_up):]), flush=True)
"""


class Checkout:
    """A checkout that renders on demand, in a process of its own."""

    def __init__(self, folder: Path, files: Sequence[Path], shade: str, size: int, threads: int) -> None:
        existing_file(folder / "runtime/rnd_runtime/playback/frame.py", what="checkout's player")
        self.folder = folder.resolve()
        paths = os.pathsep.join(str(self.folder / package) for package in PACKAGES)
        environment = os.environ | {"PYTHONPATH": paths, "NUMBA_NUM_THREADS": str(threads)}
        environment.pop("NUMBA_CACHE_DIR", None)  # each checkout has its own kernels
        arguments = [*(str(file.resolve()) for file in files), shade, *map(str, (size, threads, FRAMES, WARM_UP))]
        self._process = subprocess.Popen(
            [sys.executable, "-c", RENDER, *arguments],
            cwd=self.folder,
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def render(self, first: int) -> list[dict[str, float]]:
        """Milliseconds of each stage, and of the whole "frame", of the frames from ``first`` on."""
        assert self._process.stdin and self._process.stdout
        self._process.stdin.write(f"{first}\n")
        self._process.stdin.flush()
        answer: list[dict[str, float]] = json.loads(self._process.stdout.readline() or "[]")
        if not answer:
            raise InputError("checkout", expected="frames", got="a failure, see above", file=self.folder)
        return answer

    def close(self) -> None:
        self._process.communicate()

    @property
    def commit(self) -> str:
        line = ["git", "-C", str(self.folder), "rev-parse", "--short", "HEAD"]
        return subprocess.run(line, capture_output=True, text=True, check=False).stdout.strip()


def compare(checkouts: Sequence[Checkout], pairs: int, on_pair: Callable[[int], None]) -> list[dict[str, Any]]:
    """A row for each stage: median and p95 in ms of both checkouts, and the ratio with its standard error."""
    for checkout in checkouts:
        checkout.render(WARM_UP)
    rounds: tuple[list[Any], list[Any]] = ([], [])
    for pair in range(pairs):
        for k in (0, 1) if pair % 2 == 0 else (1, 0):
            rounds[k].append(checkouts[k].render(WARM_UP + pair * FRAMES % 200))
        on_pair(pair + 1)
    rows = []
    for stage in rounds[0][0][0]:
        old, new = (np.array([[frame[stage] for frame in frames] for frames in one]) for one in rounds)
        ratios = np.median(new, 1) / np.median(old, 1)
        row = {
            "stage": stage,
            "ratio": float(np.median(ratios)),
            "ratio_se": float(MEDIAN_ERROR * ratios.std() / np.sqrt(pairs)),
        }
        for name, values in {"before": old, "after": new}.items():
            row |= {f"{name}_ms": float(np.median(values)), f"{name}_p95": float(np.percentile(values, 95))}
        rows.append(row)
    return rows
