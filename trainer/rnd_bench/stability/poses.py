"""Rows P1–P4: poses nobody filmed, twists, wraps, turns."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from rnd_bench.scenes.figures import (
    Figure,
    Floats,
    Result,
    above,
    at_most,
    below,
    coded,
    decibels,
    not_measured,
    stated,
)
from rnd_bench.scenes.subject import APART, ARMS_DOWN, EXTREMES, Angles, Subject, bytes_of
from rnd_runtime.avatar.file import POSED_OUTPUTS
from rnd_runtime.core.gaussians import Gaussians
from rnd_runtime.core.rotations import axis_angle_to_matrix, rotation_6d
from rnd_runtime.motion.motion import Motion
from rnd_runtime.playback.frame import FrameRenderer
from rnd_runtime.posing.forearm import skinning_bones
from rnd_runtime.shading.light import Light, texel_directions
from rnd_runtime.shading.shader import Shader
from rnd_trainer.losses.metrics import mask_box
from rnd_trainer.training.data import usable

BYTE = 1 / 255
RING_M = 0.02
"""length of a slice of a limb whose radius is measured"""
RING_COUNT = 8
"""Gaussians that a slice needs to have a radius"""
NEIGHBOURS = 12
"""that tell how the surface around a Gaussian lies and moves"""
FEWER_OR_MORE = (9, 16)
"""neighbours: how well a twisted surface's normals are known at all"""
HOLE_MARGIN = 0.006
"""of the picture's side: silhouettes are eroded by it, since an edge is soft"""


def out_of_distribution(subject: Subject) -> Result:
    """P1: T-pose, squat, arms up, splits; then the pictures of poses that were held out."""
    extremes = [subject.motion(pose) for pose in EXTREMES.values()]
    posed = [subject.avatar.pose(motion, 0.0) for motion in extremes]
    holes = [_holes(subject, gaussians, motion) for gaussians, motion in zip(posed, extremes)]
    held_out, worst = _held_out(subject)
    (stretch, longest), (plain_stretch, plain_longest) = (
        _stretch(subject, pose) for pose in (subject.avatar.pose, subject.by_template)
    )
    figures = (
        below(
            "edge stretch of the 6-NN graph, p99.9, worst pose",
            stretch,
            3,
            "×",
            baseline=("template LBS", plain_stretch),
        ),
        stated("the same, the edge that is stretched most", longest, "×", baseline=("template LBS", plain_longest)),
        below("alpha holes inside the template's silhouette", 100 * max(holes), 1, "%"),
        held_out,
    )
    return Result(figures, worst)


def _stretch(subject: Subject, pose: Callable[[Motion, float], Gaussians]) -> tuple[float, float]:
    """Of the extreme poses' edges over their lengths with the legs apart, both as ``pose`` has them: p99.9 and the
    largest, each of the worst pose."""

    def lengths(angles: Angles) -> Floats:
        means = pose(subject.motion(angles), 0.0).means
        return np.linalg.norm(means[subject.neighbours] - means[:, None], axis=-1).astype(np.float64)

    apart = np.maximum(lengths(APART), 1e-4)
    ratios = [lengths(angles) / apart for angles in EXTREMES.values()]
    stretch = max(float(np.percentile(ratio, 99.9)) for ratio in ratios)
    return stretch, max(float(ratio.max()) for ratio in ratios)


def _holes(subject: Subject, posed: Gaussians, motion: Motion) -> float:
    """Share of the silhouette's inside in which less than half is covered."""
    camera, body = subject.camera(), subject.body
    bones = subject.bones(motion, 0.0).astype(np.float64)
    blend = np.einsum("vj,jrc->vrc", body.skinning_weights, bones)
    vertices = np.einsum("vrc,vc->vr", blend[:, :, :3], body.vertices) + blend[:, :, 3]
    points = vertices @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    pixels = points[:, :2] / points[:, 2:] * camera.K[[0, 1], [0, 1]] + camera.K[:2, 2]
    inside = np.zeros((camera.height, camera.width), np.uint8)
    for triangle in np.round(pixels[body.faces] * 16).astype(np.int32):
        cv2.fillConvexPoly(inside, triangle, 1, shift=4)
    width = 2 * max(1, round(HOLE_MARGIN * camera.width)) + 1
    inside = cv2.erode(inside, np.ones((width, width), np.uint8))
    alpha = subject.linear(posed, camera)[..., 3]
    return float((alpha[inside > 0] < 0.5).mean())


def _held_out(subject: Subject) -> tuple[Figure, tuple[NDArray[np.uint8], NDArray[np.uint8]] | None]:
    """PSNR of ours over that of template LBS on held-out poses, inside the mask's box; the worst frame of ours."""
    what, capture = "PSNR over template LBS on held-out poses, mean", subject.capture
    frames = capture.split("novel_pose")
    frames = frames[:: max(1, len(frames) // subject.few(4, 12))]
    shader = Shader(Light(subject.avatar.trained_light), "table+sun")
    ours: list[float] = []
    plain: list[float] = []
    worst = None
    for frame in frames:
        truth = capture.load_frame(frame)
        if not usable(truth.mask):
            continue
        box = mask_box(torch.from_numpy(truth.mask))
        camera, time = capture.cameras[frame.camera], frame.frame / capture.motion.fps
        picture = subject.picture(subject.avatar.pose(capture.motion, time), camera, shader)
        template = subject.picture(subject.by_template(capture.motion, time), camera, shader)
        ours.append(decibels(picture[box], truth.image_srgb[box]))
        plain.append(decibels(template[box], truth.image_srgb[box]))
        if ours[-1] == min(ours):
            worst = bytes_of(picture), bytes_of(truth.image_srgb)
    if not ours:
        return not_measured(what), None
    baseline = "template LBS, its PSNR", float(np.mean(plain))
    return above(what, float(np.mean(np.subtract(ours, plain))), -0.5, "dB", baseline=baseline), worst


def candy_wrapper(subject: Subject) -> Result:
    """P2: the forearm twisted at either end, 0 to 180° by 10°."""
    ratios, by_template, errors, plain_errors, spread, finite = [], [], [], [], [], True
    for joint, end in (("left_elbow", "left_wrist"), ("left_wrist", "left_wrist")):
        names, joints = subject.avatar.skeleton.names, subject.avatar.skeleton.rest_joints
        elbow = joints[names.index("left_elbow")]
        bone = joints[names.index(end)] - elbow
        axis = bone / np.linalg.norm(bone)
        limb = _Limb(subject, elbow, axis, float(np.linalg.norm(bone)))
        for degrees in range(0, 181, 10):
            angles: Angles = {joint: tuple(axis * np.radians(degrees))}
            motion = subject.motion(angles)
            posed = subject.avatar.pose(motion, 0.0)
            finite &= all(bool(np.isfinite(a).all()) for a in (posed.means, posed.covariances, posed.normals))
            if degrees == 150:
                ratios.append(limb.ratio(posed))
                by_template.append(limb.ratio(subject.by_template(motion, 0.0)))
            if degrees == 120:
                errors.append(limb.normal_error(posed, posed.normals))
                spread.append(limb.surface_spread(posed))
                plain = subject.by_template(motion, 0.0)
                plain_errors.append(limb.normal_error(plain, plain.normals))
    figures = (
        above(
            "cross-section ratio at 150°, thinnest slice", min(ratios), 0.5, baseline=("template LBS", min(by_template))
        ),
        below("not finite by 180°", float(not finite), 1, "poses"),
        below(
            "normal error at 120°, mean of the slice that errs most",
            max(e.max() for e in errors),
            15,
            "°",
            baseline=("template LBS, A_R n", max(e.max() for e in plain_errors)),
        ),
        stated(
            "the same, mean of all slices",
            max(e.mean() for e in errors),
            "°",
            baseline=("template LBS, A_R n", max(e.mean() for e in plain_errors)),
        ),
        stated(
            f"the surface's own normals, by {FEWER_OR_MORE[0]} and by {FEWER_OR_MORE[1]} neighbours, worst slice",
            max(e.max() for e in spread),
            "°",
        ),
    )
    return Result(figures)


class _Limb:
    """The Gaussians around a bone from ``origin`` [3] along ``axis`` [3]."""

    def __init__(self, subject: Subject, origin: Floats, axis: Floats, length: float) -> None:
        self.origin, self.axis, self.rest = origin, axis, subject.rest
        along, self.radii = self._radii(self.rest.means)
        self.around = (along > -0.5 * length) & (along < 1.5 * length) & (self.radii < 0.12)
        width = max(RING_M, RING_COUNT * 2.0 * length / max(1, int(self.around.sum())))
        self.slice = np.floor(along / width).astype(int)

    def _radii(self, means: NDArray[np.float32]) -> tuple[Floats, Floats]:
        offset = means.astype(np.float64) - self.origin
        along = offset @ self.axis
        return along, np.linalg.norm(offset - np.outer(along, self.axis), axis=1)

    def ratio(self, posed: Gaussians) -> float:
        """Radius over that at rest, of the slice that lost most."""
        radii = self._radii(posed.means)[1]
        return min(float(radii[s].mean() / self.radii[s].mean()) for s in self._slices())

    def _slices(self) -> list[NDArray[np.bool_]]:
        """The limb's rings [N] along its bone, but those of few Gaussians."""
        slices = [self.around & (self.slice == k) for k in np.unique(self.slice[self.around])]
        return [s for s in slices if s.sum() >= RING_COUNT]

    def normal_error(self, posed: Gaussians, normals: NDArray[np.floating]) -> Floats:
        """Mean angle of each slice [S], degrees, to the rest normals as the surface around them moved."""
        return self._angles(self._surface_normals(posed, NEIGHBOURS), normals[self.around])

    def surface_spread(self, posed: Gaussians) -> Floats:
        """How far the normals of that surface are apart, [S] degrees, if told by fewer or by more neighbours."""
        fewer, more = (self._surface_normals(posed, count) for count in FEWER_OR_MORE)
        return self._angles(fewer, more)

    def _angles(self, first: NDArray[np.floating], second: NDArray[np.floating]) -> Floats:
        """Mean angle of each slice [S], degrees, between normals [M, 3] around the bone."""
        cosines = (first * second).sum(1) / np.maximum(
            np.linalg.norm(first, axis=1) * np.linalg.norm(second, axis=1), 1e-12
        )
        error = np.zeros(len(self.around))
        error[self.around] = np.degrees(np.arccos(np.clip(cosines, -1, 1)))
        return np.array([error[s].mean() for s in self._slices()])

    def _surface_normals(self, posed: Gaussians, neighbours: int) -> Floats:
        """The rest normals [M, 3] of the Gaussians around the bone as the surface moved, known from places alone.

        Planes through that many neighbours, at rest and posed, give a map F of tangents and normal; the normal to be
        is F's inverse transpose times the one at rest.
        """
        found = np.zeros((int(self.around.sum()), 3))
        nearest = cKDTree(self.rest.means).query(self.rest.means[self.around], k=neighbours)[1]
        for row, (index, near) in enumerate(zip(np.flatnonzero(self.around), nearest)):
            normal = self.rest.normals[index].astype(np.float64)
            first = np.cross(normal, [0.0, 0.0, 1.0] if abs(normal[2]) < 0.9 else [1.0, 0.0, 0.0])
            first /= np.linalg.norm(first)
            offsets = (self.rest.means[near] - self.rest.means[index]).astype(np.float64)
            flat = offsets @ np.stack([first, np.cross(normal, first)], axis=1)
            before = _frame(flat, offsets)
            after = _frame(flat, (posed.means[near] - posed.means[index]).astype(np.float64))
            true = after @ np.linalg.inv(before)  # columns: two tangents and the unit normal
            found[row] = np.linalg.inv(true).T @ normal
        return found


def _frame(flat: Floats, offsets: Floats) -> Floats:
    """[3, 3] columns: what the two flat coordinates [K, 2] map to in ``offsets`` [K, 3], and the unit normal."""
    first, second = np.linalg.lstsq(flat, offsets, rcond=None)[0]
    normal = np.cross(first, second)
    return np.stack([first, second, normal / max(np.linalg.norm(normal), 1e-12)], axis=1)


def axis_angle_wrap(subject: Subject) -> Result:
    """P3: a joint through π ± 1e-3, and θ against θ + 2πk.

    The pose does turn by 2e-3 there, so that no picture stays as it is: beside the change stands that of plain blend
    skinning, which knows no angles. At π itself a ring of skin that two bones share half and half has collapsed and
    turns over, so the line is for the mean over the covered pixels; the worst one is told.
    """
    step = 1e-3
    axis = np.array([0.6, 0.64, 0.48])

    def pose(angle: float) -> Angles:
        return {**ARMS_DOWN, "left_elbow": tuple(angle * axis)}

    moving = subject.motion(*(pose(np.pi + k * step) for k in (-3, -1, 1)), fps=1000.0)
    pairs = [
        [subject.shown(moving, t / 1000) for t in (1, 2)],
        [subject.shown(subject.motion(pose(np.pi + s)), 0.0) for s in (-step, step)],
    ]
    plain = [subject.picture(subject.by_template(moving, t / 1000)) for t in (1, 2)]
    turns = [subject.shown(subject.motion(pose(0.7 + 2 * np.pi * k)), 0.0) for k in (0, 1, -1, 3)]
    by_difference = [
        _by_axis_angle_difference(subject, pose(a), pose(b))
        for a, b in ((np.pi - 3 * step, np.pi - step), (np.pi - step, -np.pi + step))
    ]
    figures = (
        below(
            "image change through π ± 1e-3, mean over covered pixels",
            max(_mean(*pair) for pair in pairs) / BYTE,
            1,
            "/255",
            baseline=("axis-angle differences", _mean(*by_difference) / BYTE),
        ),
        stated(
            "the same, worst pixel",
            max(largest(*pair) for pair in pairs) / BYTE,
            "/255",
            baseline=("axis-angle differences", largest(*by_difference) / BYTE),
        ),
        stated("the same, plain blend skinning, worst pixel", largest(*plain) / BYTE, "/255"),
        below("image change by θ + 2πk, worst pixel", max(largest(turns[0], t) for t in turns[1:]) / BYTE, 1, "/255"),
    )
    return Result(figures)


def _mean(a: Floats, b: Floats) -> float:
    """Mean difference over the pixels that either picture covers."""
    covered = (a > 0).any(-1) | (b > 0).any(-1)
    return float(np.abs(a - b)[covered].mean())


def _by_axis_angle_difference(subject: Subject, before: Angles, now: Angles) -> Floats:
    """The picture when joint velocities are differences of axis-angles, as the paper has them."""
    motion, avatar = subject.motion(before, now), subject.avatar
    names = avatar.skeleton.names
    velocity = np.zeros((len(names) - 1, 3))
    for name in now:
        velocity[names.index(name) - 1] = (np.array(now[name]) - np.array(before[name])) * 1000.0
    window = rotation_6d(np.repeat(motion.rotations[1:, 1:], avatar.window_poses, axis=0))
    bones = skinning_bones(avatar.skeleton, motion.rotations[1], np.zeros(3))
    return subject.picture(posed_by(subject, window, velocity, bones))


def posed_by(subject: Subject, window: ArrayLike, velocity: ArrayLike, bones: NDArray[np.float32]) -> Gaussians:
    """Gaussians for given network inputs."""
    from dataclasses import replace

    means, covariances, normals, visibility = subject.avatar.run((window, velocity, bones), POSED_OUTPUTS)
    return replace(
        subject.rest,
        means=means,
        covariances=covariances,
        normals=normals,
        visibility=visibility,
        root_rotation=np.ascontiguousarray(bones[0, :, :3], np.float32),
    )


def largest(a: Floats, b: Floats) -> float:
    """The largest difference of two pictures."""
    return float(np.abs(a - b).max())


def global_rotation(subject: Subject) -> Result:
    """P4: root, camera and light turned together by random rotations."""
    rng = np.random.default_rng(3)
    walk = subject.walk(0.5)
    time, camera = 0.4, subject.camera()
    renderer = FrameRenderer(subject.avatar, _smooth_light(np.eye(3)), camera, shade="table")
    reference = coded(renderer.render(walk, time).radiance)
    weights = subject.weights(walk, time)
    image, encoders = 0.0, 0.0
    for _ in range(subject.few(5, 20)):
        turn = axis_angle_to_matrix(rng.normal(size=3) * 1.5)
        rotations = walk.rotations.copy()
        rotations[:, 0] = turn @ rotations[:, 0]
        pivot = subject.avatar.skeleton.rest_joints[0]
        turned = Motion(rotations, np.tile(turn @ pivot - pivot, (walk.frame_count, 1)), walk.fps, walk.joint_names)
        back = np.eye(4)
        back[:3, :3] = turn.T
        renderer.camera = camera.in_frame(back)
        renderer.relight(_smooth_light(turn))
        image = max(image, largest(coded(renderer.render(turned, time).radiance), reference))
        encoders = max(encoders, float(np.abs(subject.weights(turned, time) - weights).max()))
    figures = (
        below("largest pixel difference", image / BYTE, 2, "/255"),
        at_most("skinning weights, largest difference", encoders, 1e-6),
    )
    return Result(figures)


def _smooth_light(turn: Floats) -> Light:
    """An analytic sky turned by ``turn``; smooth, so that texels do not matter."""
    local = texel_directions(64, 128) @ turn
    x, y, z = np.moveaxis(local, -1, 0)
    lobe = np.exp(4 * (local @ [0.64, 0.48, 0.6] - 1))
    return Light(
        np.stack([0.3 + 2 * lobe + 0.1 * x, 0.4 + lobe + 0.2 * y, 0.6 + lobe + 0.2 * z], -1).astype(np.float32)
    )
