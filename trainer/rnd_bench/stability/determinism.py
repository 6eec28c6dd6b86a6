"""Determinism: equal bytes with one and two threads, on EGL and on OSMesa."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np

from rnd_bench.scenes.poses import FPS
from rnd_bench.scenes.subject import Subject
from rnd_runtime.motion.motion import save_motion
from rnd_runtime.playback.frame import FrameRenderer
from rnd_runtime.playback.rasterizer import Kind

from .figures import Figure, Result, at_most, holds, result
from .processes import export, play, run_commands

THREADS = (1, 2)
FRAMES = 8


def same_bytes(subject: Subject) -> Result:
    """Files of export and play with one thread and with two; frames of both OpenGL backends."""
    motion = subject.work / "moving.npz"
    save_motion(motion, subject.walk(FRAMES / FPS))
    options = ("--size", 96, "--format", "png,exr,mp4", "--aov", "normal,depth")
    made: list[dict[str, str]] = []
    for threads in THREADS:
        folder = subject.work / f"same_{threads}"
        folder.mkdir(parents=True, exist_ok=True)
        runs = [
            export(subject.checkpoint, folder / "avatar.onnx"),
            play(subject.avatar_file, motion, folder / "play", "--threads", threads, *options),
        ]
        variables = {"OMP_NUM_THREADS": str(threads), "NUMBA_NUM_THREADS": str(threads)}
        for done in run_commands(folder, runs, **variables):
            if done.code != 0:
                return result(holds("commands that failed", [done.errors[-200:]]))
        made.append(_digests(folder))
    names = sorted(made[0].keys() | made[1].keys())
    different = [name for name in names if made[0].get(name) != made[1].get(name)]
    what = f"{len(names)} files of export and play at one and two threads that differ"
    return result(holds(what, different), backends_agree(subject))


def backends_agree(subject: Subject) -> Figure:
    """Frames by OpenGL, on EGL and on OSMesa, of a moving body."""
    motion, rendered = subject.walk(FRAMES / FPS), []
    backends: tuple[Kind, ...] = ("gl-egl", "gl-osmesa")
    for backend in backends:
        renderer = FrameRenderer(subject.avatar, subject.light, subject.camera(), raster=backend)
        rendered.append([renderer.render(motion, k / FPS).radiance for k in range(FRAMES)])
        renderer.close()
    apart = max(float(np.abs(a - b).max()) for a, b in zip(*rendered))
    return at_most(f"{FRAMES} frames on EGL against OSMesa, largest difference", apart, 0)


def _digests(folder: Path) -> dict[str, str]:
    """SHA-256 of every file; play.json without times and threads."""
    digests = {}
    for path in sorted(folder.rglob("*")):
        if not path.is_file():
            continue
        content = path.read_bytes()
        if path.name == "play.json":
            report = json.loads(content)
            del report["times"], report["settings"]["threads"]
            content = json.dumps(report, sort_keys=True).encode()
        digests[str(path.relative_to(folder))] = hashlib.sha256(content).hexdigest()
    return digests
