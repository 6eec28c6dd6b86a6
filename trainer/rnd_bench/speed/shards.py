"""How playback of one clip spreads over processes: every frame stands alone, so shards need not talk."""

from __future__ import annotations

import itertools
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from rnd_runtime.avatar.avatar import Avatar
from rnd_runtime.core.errors import InputError
from rnd_runtime.playback.doctor import machine

REPEATS = 3
"""of each way, which take turns; the median is reported"""
FPS = 120
"""of the clip: more frames of the motion, so that what a process needs to start is not most of it"""
PLAY = "import sys; from rnd_viewer.play.cli import main; sys.exit(main(sys.argv[1:]))"


class Way(NamedTuple):
    """So many processes, each with so many threads; of one thread, a process overlaps no frames either."""

    processes: int
    threads: int


def ways(cores: int) -> list[Way]:
    """One thread alone, all in one process, and a process for each core; the first is what the rest are beside."""
    return list(dict.fromkeys([Way(1, 1), Way(1, cores), Way(cores, 1)]))


def bench_shards(avatar: Path, motion: Path, hdr: Path, frames: int, size: int, cores: int) -> Iterator[dict[str, Any]]:
    """Rows of wall time from the first process' start to the last one's end, PNGs written, and the speed-up.

    ``start_seconds`` is what a process needs for one frame, and ``speed_up_drawing`` the speed-up of the rest.

    Args:
        avatar, motion, hdr: of ``rnd-play``.
        frames: of the clip at ``FPS``, from its start; size: picture side in pixels.
        cores: processes, or threads, at most.

    Raises:
        InputError: ``rnd-play`` failed; with its last line.
    """
    inputs = [
        str(avatar),
        "--motion",
        str(motion),
        "--hdr",
        str(hdr),
        "--size",
        str(size),
        "--format",
        "png",
        "--fps",
        str(FPS),
    ]
    seconds: dict[Way, list[float]] = {way: [] for way in ways(cores)}
    starts: list[float] = []
    for _ in range(REPEATS):
        starts.append(_play(Way(1, 1), inputs, 1))
        for way, taken in seconds.items():
            taken.append(_play(way, inputs, frames))
    gaussians = Avatar.load(avatar, threads=1).gaussians
    alone, start = statistics.median(seconds[Way(1, 1)]), statistics.median(starts)
    for way, taken in seconds.items():
        median = statistics.median(taken)
        yield {
            "processes": way.processes,
            "threads": way.threads,
            "seconds": median,
            "fps": frames / median,
            "speed_up": alone / median,
            "start_seconds": start,
            "speed_up_drawing": (alone - start) / (median - start),
            "frames": frames,
            "size": size,
            "avatar": avatar.name,
            "gaussians": gaussians,
            "machine": machine(),
        }


def shards(frames: int, count: int) -> list[tuple[int, int]]:
    """``count`` ranges START, END that cover ``frames`` and differ in length by one at most."""
    edges = [frames * k // count for k in range(count + 1)]
    return list(itertools.pairwise(edges))


def _play(way: Way, inputs: list[str], frames: int) -> float:
    """Seconds that the clip takes."""
    environment = os.environ | {"OMP_NUM_THREADS": str(way.threads)}
    with tempfile.TemporaryDirectory() as out:
        started = time.perf_counter()
        processes = [
            subprocess.Popen(
                [
                    sys.executable,
                    "-c",
                    PLAY,
                    *inputs,
                    "--threads",
                    str(way.threads),
                    "--frames",
                    f"{start}:{end}",
                    "--out",
                    out,
                    *([] if way.threads > 1 else ["--no-pipeline"]),
                ],
                env=environment,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                text=True,
            )
            for start, end in shards(frames, way.processes)
        ]
        said = [process.communicate()[1] for process in processes]
        taken = time.perf_counter() - started
        for process, text in zip(processes, said):
            if process.returncode:
                raise InputError("rnd-play", got=(text.strip().splitlines() or ["no answer"])[-1])
        written = len(list(Path(out, "frames").glob("*.png")))
        if written != frames:
            raise InputError("--frames", expected=f"at most the clip's {written}", got=frames)
    return taken
