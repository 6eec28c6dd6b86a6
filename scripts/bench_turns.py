"""Frames of one avatar by two checkouts of this project, turn by turn: what a change to the player is worth.

python scripts/bench_turns.py BEFORE AFTER --avatar FILE.onnx [--shade table] [--turns 120] --json FILE

A machine that others use too is faster in one minute than in the next by more than most changes are worth. So each
checkout draws in a process of its own, eight frames at a time by turns, and what counts is the median over the turns of
the ratio of their medians, with a standard error. Motion and light change from frame to frame; the kernels of both are
compiled first.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

ROOT = Path(__file__).parent.parent
PACKAGES = ("runtime", "trainer", "export", "viewer")
FRAMES, WARM_UP = 8, 2  # of a turn: those that count, and those before them
STEP_S, TURN = 1 / 30, 0.02  # of the motion and, in radians, of the light from frame to frame
MEDIANS_ERROR = 1.25  # standard error of a median in those of a mean, for normal deviates


class Player:
    """A checkout that draws on demand, in a process of its own."""

    def __init__(self, checkout: Path, avatar: Path, shade: str, threads: int) -> None:
        paths = os.pathsep.join(str(checkout / package) for package in PACKAGES)
        environment = os.environ | {"PYTHONPATH": paths, "NUMBA_NUM_THREADS": str(threads)}
        environment.pop("NUMBA_CACHE_DIR", None)  # each checkout has its own kernels
        line = [sys.executable, __file__, "--draw", str(avatar), shade, str(threads)]
        self._process = subprocess.Popen(
            line, cwd=checkout, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def turn(self, first: int) -> list[dict[str, float]]:
        """ms of each stage, and of the "frame", of the frames from ``first`` on."""
        assert self._process.stdin and self._process.stdout
        self._process.stdin.write(f"{first}\n")
        self._process.stdin.flush()
        answer: list[dict[str, float]] = json.loads(self._process.stdout.readline() or "[]")
        if not answer:
            raise SystemExit(2)  # it has said why
        return answer

    def close(self) -> None:
        assert self._process.stdin
        self._process.stdin.close()
        self._process.wait()


def draw(avatar_file: str, shade: str, threads: str) -> None:
    """What such a process does: one line of times for each line that says where to begin."""
    from rnd_bench.scenes.scenes import USUAL, bench_camera
    from rnd_runtime.avatar.avatar import Avatar
    from rnd_runtime.motion.motion import load_motion
    from rnd_runtime.playback.frame import FrameRenderer
    from rnd_runtime.shading.light import load_light

    avatar = Avatar.load(avatar_file, threads=int(threads))
    motion = load_motion(ROOT / "assets/walk.npz", avatar.skeleton)
    light = load_light(ROOT / "assets/sky.exr")
    renderer = FrameRenderer(avatar, light, bench_camera(512, USUAL), shade=shade)
    for line in sys.stdin:
        first, taken = int(line), []
        for number in range(first - WARM_UP, first + FRAMES):
            started = perf_counter()
            renderer.turn(TURN * number)
            frame = renderer.render(motion, STEP_S * number)
            whole = perf_counter() - started
            taken.append({name: 1e3 * s for name, s in {"frame": whole, **frame.stage_seconds}.items()})
        print(json.dumps(taken[WARM_UP:]), flush=True)


def compared(players: Sequence[Player], turns: int) -> list[dict[str, Any]]:
    """Rows by stage: medians and 95th percentiles in ms of both, and the ratio with its standard error."""
    taken: tuple[list[Any], list[Any]] = ([], [])
    for turn in range(turns):
        for k in (0, 1) if turn % 2 == 0 else (1, 0):
            taken[k].append(players[k].turn(WARM_UP + turn * FRAMES % 200))
        print(f"\r{turn + 1} of {turns} turns", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    rows = []
    for stage in taken[0][0][0]:
        before, after = (np.array([[frame[stage] for frame in turn] for turn in own]) for own in taken)
        ratios = np.median(after, 1) / np.median(before, 1)
        rows.append(
            {
                "stage": stage,
                "ratio": float(np.median(ratios)),
                "ratio_se": float(MEDIANS_ERROR * ratios.std() / np.sqrt(turns)),
                "before_ms": float(np.median(before)),
                "after_ms": float(np.median(after)),
                "before_p95": float(np.percentile(before, 95)),
                "after_p95": float(np.percentile(after, 95)),
            }
        )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkouts", type=Path, nargs=2, metavar=("BEFORE", "AFTER"))
    parser.add_argument("--avatar", type=Path, required=True)
    parser.add_argument("--shade", default="table")
    parser.add_argument("--turns", type=int, default=120)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--json", type=Path, required=True)
    options = parser.parse_args()

    from rnd_runtime.core.errors import run_command
    from rnd_runtime.core.files import existing_file, sha256_of, write_json
    from rnd_runtime.playback.doctor import machine

    def command() -> None:
        for checkout in options.checkouts:
            existing_file(checkout / "runtime/rnd_runtime/playback/frame.py", what="checkout's player")
        avatar = existing_file(options.avatar, what="avatar").resolve()
        players = [Player(checkout.resolve(), avatar, options.shade, options.threads) for checkout in options.checkouts]
        try:
            for player in players:
                player.turn(WARM_UP)
            rows = compared(players, options.turns)
        finally:
            for player in players:
                player.close()
        about = {
            **{name: _commit(checkout) for name, checkout in zip(("before", "after"), options.checkouts)},
            "avatar_sha256": sha256_of(avatar),
            "size": 512,
            "shade": options.shade,
            "threads": options.threads,
            "turns": options.turns,
            "frames": FRAMES,
            "machine": machine(),
        }
        write_json(options.json, [row | about for row in rows])
        for row in rows:
            print(
                f"{row['stage']:10} {row['before_ms']:6.2f} → {row['after_ms']:6.2f} ms, "
                f"{row['ratio']:.3f} ± {row['ratio_se']:.3f}"
            )

    raise SystemExit(run_command("bench_turns", command))


def _commit(checkout: Path) -> str:
    line = ["git", "-C", str(checkout), "rev-parse", "--short", "HEAD"]
    return subprocess.run(line, capture_output=True, text=True, check=False).stdout.strip()


if __name__ == "__main__":
    if sys.argv[1:2] == ["--draw"]:
        draw(*sys.argv[2:])
    else:
        main()
