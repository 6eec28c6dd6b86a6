"""Rows P7–P11, successive frames: contact, noise, constant poses, cold starts, frame rates."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from rnd_bench.scenes.poses import ARMS_DOWN, Angles
from rnd_bench.scenes.psnr import Floats, decibels
from rnd_bench.scenes.subject import Subject
from rnd_bench.stability.figures import Result, above, at_most, below, reported, result
from rnd_runtime.core.rotations import axis_angle_to_matrix, matrix_to_axis_angle
from rnd_runtime.motion.motion import Motion
from rnd_runtime.posing.window import motion_window

from .poses import BYTE, largest, posed_by


def self_contact(subject: Subject) -> Result:
    """P7: an arm along the torso and the palms together, in steps of 0.1°."""
    steps = np.radians(0.1) * np.arange(subject.few(12, 60))
    worst = np.inf
    along_torso = [{"left_shoulder": (0, 0, -1.25 - s), "right_shoulder": (0, 0, 1.2)} for s in steps]
    elbows: Angles = {"left_elbow": (0, -0.4, 0), "right_elbow": (0, 0.4, 0)}
    palms = [{"left_shoulder": (0, -1.35 - s, -0.5), "right_shoulder": (0, 1.35 + s, 0.5), **elbows} for s in steps]
    for sweep in (along_torso, palms):
        motion = subject.motion(*sweep)
        frames = [subject.image_at(motion, k / motion.fps) for k in range(motion.frame_count)]
        worst = float(np.min([worst, *(decibels(a, b) for a, b in pairwise(frames))]))  # keeps NaN
    return result(above("consecutive frames, least PSNR", worst, 40, "dB"))


def noisy_poses(subject: Subject) -> Result:
    """P8: N(0, σ) on every joint, σ = 0.5, 1, 2, 5°: image jitter over that of template LBS."""
    rng = np.random.default_rng(7)
    count = len(subject.avatar.skeleton)
    frames = subject.few(8, 24)
    ratios = []
    for sigma in (0.5, 1, 2, 5):
        angles = np.radians(sigma) * rng.normal(size=(frames, count, 3))
        angles[:, 0] = 0
        for name, vector in ARMS_DOWN.items():
            angles[:, subject.avatar.skeleton.names.index(name)] += vector
        motion = subject.motion_of(axis_angle_to_matrix(angles))
        ours = np.stack([subject.image_at(motion, k / motion.fps) for k in range(frames)])
        plain = np.stack([subject.image(subject.by_template(motion, k / motion.fps)) for k in range(frames)])
        ratios.append(float(np.abs(np.diff(ours, axis=0)).mean() / np.abs(np.diff(plain, axis=0)).mean()))
    return result(at_most("jitter over that of template LBS, worst σ", max(ratios), 1.3, "×"))


def weight_flicker(subject: Subject) -> Result:
    """P9: a constant pose after motion; slow motion."""
    walk = subject.walk(1.0)
    motion = subject.then_still(walk, subject.few(24, 40))
    settled = walk.duration + subject.avatar.window_seconds * (1 + 1 / (subject.avatar.window_poses - 1)) + 1e-6
    frames = [subject.image_at(motion, k / motion.fps) for k in range(motion.frame_count) if k / motion.fps > settled]
    still = max((largest(a, b) for a, b in pairwise(frames)), default=np.nan)
    slow = Motion(walk.rotations, walk.translations, walk.fps / 4, walk.joint_names)
    times = np.arange(subject.few(10, 60)) / 30.0 + 0.5
    weights = [subject.weights(slow, t) for t in times]
    variation = [0.5 * np.abs(a - b).sum(1) for a, b in pairwise(weights)]
    p99, most = max(float(np.percentile(v, 99)) for v in variation), max(float(np.max(v)) for v in variation)
    return result(
        at_most("frame difference after the window has passed", still / BYTE, 0, "/255"),
        below("total variation of W a frame in slow motion, p99 of the Gaussians", p99, 0.02),
        reported("the same, of the Gaussian that changes most", most),
    )


def cold_start(subject: Subject) -> Result:
    """P10: the same frames with and without the preceding ones."""
    walk = subject.walk(1.5)
    cut = 20
    late = Motion(walk.rotations[cut:], walk.translations[cut:], walk.fps, walk.joint_names)
    first = int(np.ceil(subject.avatar.window_seconds * walk.fps - 1e-6))
    change = max(
        largest(subject.image_at(walk, (cut + k) / walk.fps), subject.image_at(late, k / walk.fps))
        for k in range(first, late.frame_count, subject.few(6, 2))
    )
    return result(below("cold against warm from frame d on, largest difference", change / BYTE, 1e-2, "/255"))


def frame_rates(subject: Subject) -> Result:
    """P11: one motion at 24 to 120 fps against 30 fps, at common times."""
    times = (0.5, 1.0, 1.5, 2.0)
    references = [subject.image_at(subject.walk(2.0), t) for t in times]
    worst, by_frames = np.inf, np.inf
    for fps in (24.0, 25.0, 29.97, 50.0, 60.0, 120.0):
        motion = subject.walk(2.0 + 1 / fps, fps)
        worst = float(np.min([worst, *(decibels(subject.image_at(motion, t), r) for t, r in zip(times, references))]))
        by_frames = min(by_frames, *(decibels(_in_frames(subject, motion, t), r) for t, r in zip(times, references)))
    baseline = "a window of d frames", by_frames
    return result(above("PSNR to 30 fps at common times, worst", worst, 45, "dB", baseline=baseline))


def _in_frames(subject: Subject, motion: Motion, time: float) -> Floats:
    """The image for a window of the file's last d frames and velocities per frame, as in the paper."""
    d = subject.avatar.window_poses
    window, _ = motion_window(motion, time, poses=d, seconds=(d - 1) / motion.fps)
    now, before = (motion.at([time - back / motion.fps]).rotations[0, 1:] for back in (0, 1))
    velocity = matrix_to_axis_angle(np.swapaxes(before, -1, -2) @ now) * 30.0  # per frame, as if at 30 fps
    return subject.image(posed_by(subject, window, velocity, subject.bones(motion, time)))
