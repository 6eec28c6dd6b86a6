"""Rows P1, P3, P4: out-of-distribution poses, angles through π, global rotations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from rnd_bench.scenes.poses import APART, ARMS_DOWN, EXTREMES, Angles
from rnd_bench.scenes.psnr import Bytes, Floats, decibels, srgb
from rnd_bench.scenes.subject import Subject, blend_skinned
from rnd_bench.stability.figures import Figure, Result, above, at_most, below, not_measured, reported, result
from rnd_runtime.avatar.file import POSED_OUTPUTS
from rnd_runtime.core.gaussians import Gaussians
from rnd_runtime.core.images import to_bytes
from rnd_runtime.core.rotations import axis_angle_to_matrix, rotation_6d
from rnd_runtime.motion.motion import Motion
from rnd_runtime.playback.frame import FrameRenderer
from rnd_runtime.posing.forearm import skinning_bones
from rnd_runtime.shading.light import Light, texel_directions
from rnd_runtime.shading.shader import Shader
from rnd_trainer.losses.metrics import mask_box

BYTE = 1 / 255
HOLE_MARGIN = 0.006  # of the image's side: erosion of silhouettes, whose edges are soft


def out_of_distribution(subject: Subject) -> Result:
    """P1: T-pose, squat, arms up, splits; then images of held-out poses."""
    motions = [subject.motion(pose) for pose in EXTREMES.values()]
    holes = [_holes(subject, subject.avatar.pose(motion, 0.0), motion) for motion in motions]
    held_out, worst = held_out_poses(subject)
    ours, plain = (_stretch(subject, pose) for pose in (subject.avatar.pose, subject.by_template))
    names = "edge stretch of the 6-NN graph, p99.9, worst pose", "the same, the edge that is stretched most"
    return result(
        below(names[0], ours[0], 3, "×", baseline=("template LBS", plain[0])),
        reported(names[1], ours[1], "×", baseline=("template LBS", plain[1])),
        below("alpha holes inside the template's silhouette", 100 * max(holes), 1, "%"),
        held_out,
        images=worst,
    )


def _stretch(subject: Subject, pose: Callable[[Motion, float], Gaussians]) -> tuple[float, float]:
    """Edge lengths in extreme poses over those with the legs apart: p99.9 and maximum, of the worst pose."""

    def lengths(angles: Angles) -> Floats:
        means = pose(subject.motion(angles), 0.0).means
        return np.linalg.norm(means[subject.neighbours] - means[:, None], axis=-1).astype(np.float64)

    apart = np.maximum(lengths(APART), 1e-4)
    ratios = [lengths(angles) / apart for angles in EXTREMES.values()]
    return max(float(np.percentile(ratio, 99.9)) for ratio in ratios), max(float(ratio.max()) for ratio in ratios)


def _holes(subject: Subject, posed: Gaussians, motion: Motion) -> float:
    """Share of the eroded silhouette where alpha is below one half."""
    camera, body = subject.camera(), subject.body
    vertices = blend_skinned(body.skinning_weights, subject.bones(motion, 0.0), body.vertices)[0]
    pixels, _ = camera.project(vertices)
    inside = np.zeros((camera.height, camera.width), np.uint8)
    for triangle in np.round(pixels[body.faces] * 16).astype(np.int32):
        cv2.fillConvexPoly(inside, triangle, 1, shift=4)
    width = 2 * max(1, round(HOLE_MARGIN * camera.width)) + 1
    inside = cv2.erode(inside, np.ones((width, width), np.uint8))
    return float((subject.radiance(posed, camera)[..., 3][inside > 0] < 0.5).mean())


def held_out_poses(subject: Subject) -> tuple[Figure, tuple[Bytes, Bytes] | None]:
    """PSNR gain over template LBS on held-out poses, inside the mask's box; our worst frame."""
    what, motion = "PSNR over template LBS on held-out poses, mean", subject.capture.motion
    shader = Shader(Light(subject.avatar.trained_light), "table+sun")
    ours: list[float] = []
    plain: list[float] = []
    worst = None
    for truth, camera, time in subject.observed(subject.capture.split("novel_pose"), subject.few(4, 12)):
        box = mask_box(torch.from_numpy(truth.mask))
        image = subject.image(subject.avatar.pose(motion, time), camera, shader)
        template = subject.image(subject.by_template(motion, time), camera, shader)
        ours.append(decibels(image[box], truth.image_srgb[box]))
        plain.append(decibels(template[box], truth.image_srgb[box]))
        if ours[-1] == min(ours):
            worst = to_bytes(image), to_bytes(truth.image_srgb)
    if not ours:
        return not_measured(what), None
    baseline = "template LBS, its PSNR", float(np.mean(plain))
    return above(what, float(np.mean(np.subtract(ours, plain))), -0.5, "dB", baseline=baseline), worst


def axis_angle_wrap(subject: Subject) -> Result:
    """P3: a joint through π ± 1e-3, and θ against θ + 2πk.

    The pose rotates by 2e-3 there, so the change by template LBS is reported too. At π skin with equal weights of two
    bones collapses and inverts: the limit is for the mean over the covered pixels.
    """
    step, axis = 1e-3, np.array([0.6, 0.64, 0.48])

    def pose(angle: float) -> Angles:
        return {**ARMS_DOWN, "left_elbow": tuple(angle * axis)}

    moving = subject.motion(*(pose(np.pi + k * step) for k in (-3, -1, 1)), fps=1000.0)
    pairs = [
        [subject.image_at(moving, t / 1000) for t in (1, 2)],
        [subject.image_at(subject.motion(pose(np.pi + s)), 0.0) for s in (-step, step)],
    ]
    plain = [subject.image(subject.by_template(moving, t / 1000)) for t in (1, 2)]
    wraps = [subject.image_at(subject.motion(pose(0.7 + 2 * np.pi * k)), 0.0) for k in (0, 1, -1, 3)]
    differences = [
        _by_axis_angle_difference(subject, pose(a), pose(b))
        for a, b in ((np.pi - 3 * step, np.pi - step), (np.pi - step, -np.pi + step))
    ]
    mean, worst = (max(change(*pair) for pair in pairs) / BYTE for change in (_mean, largest))
    base_mean, base_worst = (("axis-angle differences", change(*differences) / BYTE) for change in (_mean, largest))
    return result(
        below("image change through π ± 1e-3, mean over covered pixels", mean, 1, "/255", baseline=base_mean),
        reported("the same, worst pixel", worst, "/255", baseline=base_worst),
        reported("the same, plain blend skinning, worst pixel", largest(*plain) / BYTE, "/255"),
        below("image change by θ + 2πk, worst pixel", max(largest(wraps[0], t) for t in wraps[1:]) / BYTE, 1, "/255"),
    )


def _mean(a: Floats, b: Floats) -> float:
    """Mean difference over pixels covered in either image."""
    covered = (a > 0).any(-1) | (b > 0).any(-1)
    return float(np.abs(a - b)[covered].mean())


def largest(a: Floats, b: Floats) -> float:
    """Largest difference."""
    return float(np.abs(a - b).max())


def _by_axis_angle_difference(subject: Subject, before: Angles, now: Angles) -> Floats:
    """The image for joint velocities that are differences of axis-angles, as in the paper."""
    motion, avatar = subject.motion(before, now), subject.avatar
    names = avatar.skeleton.names
    velocity = np.zeros((len(names) - 1, 3))
    for name in now:
        velocity[names.index(name) - 1] = (np.array(now[name]) - np.array(before[name])) * 1000.0
    window = rotation_6d(np.repeat(motion.rotations[1:, 1:], avatar.window_poses, axis=0))
    bones = skinning_bones(avatar.skeleton, motion.rotations[1], np.zeros(3))
    return subject.image(posed_by(subject, window, velocity, bones))


def posed_by(subject: Subject, window: ArrayLike, velocity: ArrayLike, bones: NDArray[np.float32]) -> Gaussians:
    """Gaussians for given network inputs."""
    means, covariances, normals, visibility = subject.avatar.run((window, velocity, bones), POSED_OUTPUTS)
    root = np.ascontiguousarray(bones[0, :, :3], np.float32)
    moved = replace(subject.rest, means=means, covariances=covariances, normals=normals)
    return replace(moved, visibility=visibility, root_rotation=root)


def global_rotation(subject: Subject) -> Result:
    """P4: root, camera and light rotated together by random rotations."""
    rng = np.random.default_rng(3)
    walk = subject.walk(0.5)
    time, camera = 0.4, subject.camera()
    renderer = FrameRenderer(subject.avatar, _smooth_light(np.eye(3)), camera, shade="table")
    reference = srgb(renderer.render(walk, time).radiance)
    weights = subject.weights(walk, time)
    image, encoders = 0.0, 0.0
    for _ in range(subject.few(5, 20)):
        rotation = axis_angle_to_matrix(rng.normal(size=3) * 1.5)
        rotations = walk.rotations.copy()
        rotations[:, 0] = rotation @ rotations[:, 0]
        pivot = subject.avatar.skeleton.rest_joints[0]
        shift = np.tile(rotation @ pivot - pivot, (walk.frame_count, 1))
        rotated = replace(walk, rotations=rotations, translations=shift)
        back = np.eye(4)
        back[:3, :3] = rotation.T
        renderer.camera = camera.in_frame(back)
        renderer.relight(_smooth_light(rotation))
        image = max(image, largest(srgb(renderer.render(rotated, time).radiance), reference))
        encoders = max(encoders, float(np.abs(subject.weights(rotated, time) - weights).max()))
    return result(
        below("largest pixel difference", image / BYTE, 2, "/255"),
        at_most("skinning weights, largest difference", encoders, 1e-6),
    )


def _smooth_light(rotation: Floats) -> Light:
    """An analytic sky under ``rotation``, smooth at the scale of texels."""
    local = texel_directions(64, 128) @ rotation
    x, y, z = np.moveaxis(local, -1, 0)
    lobe = np.exp(4 * (local @ [0.64, 0.48, 0.6] - 1))
    sky = np.stack([0.3 + 2 * lobe + 0.1 * x, 0.4 + lobe + 0.2 * y, 0.6 + lobe + 0.2 * z], -1)
    return Light(sky.astype(np.float32))
