"""What a ground adds to a frame: frames with and without it, alternating."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from rnd_bench.scenes.scenes import bench_camera
from rnd_bench.speed.frame import STEP_S, STEP_YAW, summary
from rnd_runtime.avatar.avatar import Avatar
from rnd_runtime.ground.standing import ground_of
from rnd_runtime.motion.motion import load_motion
from rnd_runtime.playback.frame import FrameRenderer
from rnd_runtime.shading.files.load import load_light

COLOUR = np.array([0.5, 0.5, 0.5], np.float32)
"""background, so that the shadow is drawn"""
WARMUP = 4


def cost(avatar: Path, motion: Path, hdr: Path, *, size: int, threads: int, pairs: int) -> dict[str, Any]:
    """Milliseconds of a frame up to its 8-bit image over a colour, with and without a ground.

    Motion and light change from pair to pair. ``added_ms`` is the median of the paired differences, ``ground_ms`` the
    stage alone.
    """
    loaded = Avatar.load(avatar, threads=threads)
    moves = load_motion(motion, loaded.skeleton)
    with FrameRenderer(loaded, load_light(hdr), bench_camera(size)) as renderer:
        plane = ground_of(loaded, moves)
        taken: dict[bool, list[float]] = {False: [], True: []}
        stage: list[float] = []
        for pair in range(WARMUP + pairs):
            renderer.turn(STEP_YAW * pair)
            encoded = loaded.encode(moves, STEP_S * pair)
            for with_ground in (False, True) if pair % 2 else (True, False):
                renderer.ground = plane if with_ground else None
                started = time.perf_counter()
                frame = renderer.draw(encoded, srgb=False)
                _ = replace(frame, background=COLOUR).srgb
                taken[with_ground].append(1e3 * (time.perf_counter() - started))
                if with_ground:
                    stage.append(1e3 * frame.stage_seconds["ground"])
    added = np.array(taken[True][WARMUP:]) - np.array(taken[False][WARMUP:])
    return {
        "what": "cost",
        "gaussians": len(loaded.posed(encoded).means),
        "size": size,
        "threads": threads,
        "pairs": pairs,
        "added_ms": float(np.median(added)),
        "added_ms_p25": float(np.percentile(added, 25)),
        "ground": summary(stage[WARMUP:]),
        "frame_without": summary(taken[False][WARMUP:]),
        "frame_with": summary(taken[True][WARMUP:]),
    }
