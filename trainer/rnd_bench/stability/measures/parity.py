"""Rows R1–R3: parity of torch and onnxruntime, of stored precisions and of thread counts."""

from __future__ import annotations

import subprocess
import sys

import numba
import numpy as np
import torch

from rnd_bench.scenes.psnr import decibels
from rnd_bench.scenes.subject import Subject
from rnd_bench.stability.figures import Figure, Result, above, at_most, below, holds, result
from rnd_bench.stability.processes import environment, export, run_commands
from rnd_runtime.avatar.avatar import Avatar
from rnd_runtime.core.gaussians import Gaussians
from rnd_runtime.core.images import to_bytes
from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_runtime.motion.motion import Motion, save_motion
from rnd_trainer.evaluation.evaluator import to_gaussians
from rnd_trainer.model.checkpoint import load_checkpoint
from rnd_trainer.model.template import z_curve_order
from rnd_trainer.training.data import pose_input

PRECISIONS = {"f16": 1.0, "int8": 3.0}  # mm; limit of the positions' p99


def wild_motion(subject: Subject, frames: int) -> Motion:
    """Independent random poses: joint angles of 0.4 rad (σ) in the first half, of 1.5 rad in the second."""
    rng = np.random.default_rng(11)
    angles = rng.normal(size=(frames, len(subject.avatar.skeleton), 3))
    angles *= np.where(np.arange(frames) < frames // 2, 0.4, 1.5)[:, None, None]
    return subject.motion_of(axis_angle_to_matrix(angles))


@torch.no_grad()
def torch_against_onnx(subject: Subject) -> Result:
    """R1: weights, positions and images by torch and by onnxruntime."""
    checkpoint = load_checkpoint(subject.checkpoint)
    rows = z_curve_order(checkpoint.model.codes.double().numpy())
    count = subject.few(30, 200)
    motion = wild_motion(subject, count)
    weights, positions, worst, pair = 0.0, 0.0, np.inf, None
    for frame in range(count):
        time = frame / motion.fps
        pose = pose_input(motion, checkpoint.skeleton, time, checkpoint.config.model)
        posed = checkpoint.model(pose)
        played = subject.avatar.pose(motion, time)
        weights = max(weights, float(np.abs(subject.weights(motion, time) - posed.weights.numpy()[rows]).max()))
        positions = max(positions, float(np.abs(played.means - posed.means.numpy()[rows]).max()))
        if frame % (count // subject.few(6, 20)) == 0:
            ours, theirs = subject.image(played), subject.image(to_gaussians(posed, pose))
            agreement = float(np.nan_to_num(decibels(ours, theirs), nan=-np.inf))
            if agreement < worst:
                worst, pair = agreement, (to_bytes(ours), to_bytes(theirs))
    return result(
        below("skinning weights, largest difference", weights, 1e-4),
        below("positions, largest difference", 1e3 * positions, 0.1, "mm"),
        above("images, least PSNR", worst, 60, "dB"),
        images=pair,
    )


def stored_precisions(subject: Subject) -> Result:
    """R2: positions of f16 and int8 files over random poses, and over a still tail."""
    files = {name: subject.work / f"avatar_{name}.onnx" for name in PRECISIONS}
    runs = [export(subject.checkpoint, file, "--precision", name) for name, file in files.items()]
    figures: list[Figure] = []
    motion = wild_motion(subject, subject.few(12, 200))
    for (name, file), done in zip(files.items(), run_commands(subject.work, runs)):
        if done.code != 0:
            figures.append(holds(f"{name} export", [str(done)]))
            continue
        stored = Avatar.load(file)
        off = [
            np.linalg.norm(stored.pose(motion, t).means - subject.avatar.pose(motion, t).means, axis=1)
            for t in np.arange(motion.frame_count) / motion.fps
        ]
        figures.append(below(f"{name}: positions, p99", 1e3 * float(np.percentile(off, 99)), PRECISIONS[name], "mm"))
        figures.append(_still_tail(subject, stored, name))
    return result(*figures)


def _still_tail(subject: Subject, stored: Avatar, name: str) -> Figure:
    """Largest movement in a constant pose, after the window has passed."""
    walk = subject.walk(0.5)
    motion = subject.then_still(walk, subject.few(30, 300))
    first = len(walk.rotations) + int(np.ceil(subject.avatar.window_seconds * walk.fps)) + 1
    means = [stored.pose(motion, k / motion.fps).means for k in range(first, motion.frame_count)]
    moved = max(float(np.abs(m - means[0]).max()) for m in means)
    return at_most(f"{name}: movement over a still tail", 1e3 * moved, 0, "mm")


def threads(subject: Subject) -> Result:
    """R3: one thread and two; in the full run also a CPU without AVX-512."""
    walk, time = subject.walk(0.3), 0.2
    images: dict[int, tuple[Gaussians, np.ndarray]] = {}
    before = numba.get_num_threads()
    for count in (1, 2):
        numba.set_num_threads(min(count, numba.config.NUMBA_NUM_THREADS))
        avatar = Avatar.load(subject.avatar_file, threads=count)
        posed = avatar.pose(walk, time)
        images[count] = posed, subject.radiance(posed)[..., :3]
    numba.set_num_threads(before)
    (one, image_one), (two, image_two) = images[1], images[2]
    names = ("means", "covariances", "normals", "visibility")
    posing = max(float(np.abs(getattr(one, name) - getattr(two, name)).max()) for name in names)
    figures = [
        at_most("posing at one and two threads, largest difference", posing, 1e-5),
        at_most("image at one and two threads, largest difference", float(np.abs(image_one - image_two).max()), 1e-5),
    ]
    if not subject.small:
        figures.append(_plain_cpu(subject, walk, time, image_one))
    return result(*figures)


_PLAIN = """
import sys, numpy as np
from rnd_runtime.avatar.avatar import Avatar
from rnd_runtime.core.camera import Camera
from rnd_runtime.motion.motion import load_motion
from rnd_runtime.raster.cpu import rasterize
from rnd_runtime.shading.light import Light
from rnd_runtime.shading.shader import Shader
avatar, motion, given, made, time = sys.argv[1:]
given, avatar = np.load(given), Avatar.load(avatar)
camera = Camera(int(given["size"]), int(given["size"]), given["K"], given["w2c"])
posed = avatar.pose(load_motion(motion, avatar.skeleton), float(time))
radiance = Shader(Light(given["light"]), "table+sun").shade(posed, camera.position)
np.save(made, rasterize(posed.means, posed.covariances, posed.opacities, radiance, camera).image)
"""


def _plain_cpu(subject: Subject, walk: Motion, time: float, image: np.ndarray) -> Figure:
    """Posing, shading and rasterizing compiled for a CPU without AVX-512 (x86-64-v3), in a process of its own."""
    camera = subject.camera()
    given, made, motion = (subject.work / f"plain_{name}" for name in ("in.npz", "out.npy", "walk.npz"))
    save_motion(motion, walk)
    np.savez(given, size=camera.width, K=camera.K, w2c=camera.world_to_camera, light=subject.light.radiance)
    more = environment(
        NUMBA_CPU_NAME="haswell",
        NUMBA_CPU_FEATURES="+avx,+avx2,+fma,+sse4.2",
        NUMBA_CACHE_DIR=str(subject.work / "plain_cache"),
    )
    files = (str(file) for file in (subject.avatar_file, motion, given, made))
    subprocess.run([sys.executable, "-c", _PLAIN, *files, str(time)], env=more, check=True, timeout=600)
    return at_most("image without AVX-512, largest difference", float(np.abs(np.load(made) - image).max()), 1e-5)
