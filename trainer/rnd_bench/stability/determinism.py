"""The same command, the same bytes: at one and at two threads, on EGL and on OSMesa."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np

from rnd_bench.scenes.poses import FPS
from rnd_bench.scenes.subject import Subject
from rnd_runtime.gl.context import create_context
from rnd_runtime.gl.raster import GlRasterizer
from rnd_runtime.motion.motion import save_motion
from rnd_runtime.playback.frame import FrameRenderer
from rnd_runtime.playback.rasterizer import Kind

from .figures import Figure, Result, at_most, holds
from .processes import export, play, run_commands

THREADS = (1, 2)
FRAMES = 8  # of a motion in which every joint turns


def same_bytes(subject: Subject) -> Result:
    """Files of export and play, each made at one thread and at two; frames of both OpenGL backends."""
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
                return Result((holds("commands that failed", [done.errors[-200:]]),))
        made.append(_digests(folder))
    names = sorted(made[0].keys() | made[1].keys())
    different = [name for name in names if made[0].get(name) != made[1].get(name)]
    what = f"{len(names)} files of export and play at one and two threads that differ"
    return Result((holds(what, different), frames_agree(subject), backends_agree(subject)))


def frames_agree(subject: Subject) -> Figure:
    """Everything after the encoders by OpenGL, on EGL and on OSMesa, of a body in motion."""
    motion, rendered = subject.walk(FRAMES / FPS), []
    backends: tuple[Kind, ...] = ("gl-egl", "gl-osmesa")
    for backend in backends:
        renderer = FrameRenderer(subject.avatar, subject.light, subject.camera(), raster=backend)
        rendered.append([renderer.render(motion, k / FPS).radiance for k in range(FRAMES)])
        renderer.close()
    apart = max(float(np.abs(a - b).max()) for a, b in zip(*rendered))
    return at_most(f"{FRAMES} frames on EGL against OSMesa, largest difference", apart, 0)


def _digests(folder: Path) -> dict[str, str]:
    """SHA-256 of every file; of play.json without its timings and the number of threads."""
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


def backends_agree(subject: Subject) -> Figure:
    """One call of the splatter on EGL and on OSMesa."""
    posed, camera = subject.avatar.pose(subject.walk(0.3), 0.2), subject.camera()
    radiance = subject.shader.shade(posed, camera.position)
    images = []
    for backend in ("egl", "osmesa"):
        raster = GlRasterizer(context=create_context(backend))
        images.append(raster(posed.means, posed.covariances, posed.opacities, radiance, camera).image)
        raster.close()
    return at_most("EGL against OSMesa, largest difference", float(np.abs(images[0] - images[1]).max()), 0)
