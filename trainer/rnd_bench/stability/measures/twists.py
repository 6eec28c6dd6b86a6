"""Row P2: a twisted forearm."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from rnd_bench.scenes.poses import Angles
from rnd_bench.scenes.psnr import Floats
from rnd_bench.scenes.subject import Subject
from rnd_bench.stability.figures import Result, above, below, reported, result
from rnd_runtime.core.gaussians import Gaussians

RING_M = 0.02  # m; least length of a slice of the limb
RING_COUNT = 8  # least Gaussians of a slice
NEIGHBOURS = 12  # that define the surface around a Gaussian
FEWER_OR_MORE = (9, 16)  # neighbours; their normals differ by the uncertainty of the surface's normals


def candy_wrapper(subject: Subject) -> Result:
    """P2: the forearm twisted at either end, 0 to 180° in steps of 10°."""
    ratios, plain_ratios, errors, plain_errors, uncertain, finite = [], [], [], [], [], True
    names, joints = subject.avatar.skeleton.names, subject.avatar.skeleton.rest_joints
    elbow = joints[names.index("left_elbow")]
    bone = joints[names.index("left_wrist")] - elbow
    length = float(np.linalg.norm(bone))
    axis = bone / length
    limb = _Limb(subject, elbow, axis, length)
    for joint in ("left_elbow", "left_wrist"):
        for degrees in range(0, 181, 10):
            angles: Angles = {joint: tuple(axis * np.radians(degrees))}
            motion = subject.motion(angles)
            posed = subject.avatar.pose(motion, 0.0)
            finite &= all(bool(np.isfinite(a).all()) for a in (posed.means, posed.covariances, posed.normals))
            if degrees == 150:
                ratios.append(limb.ratio(posed))
                plain_ratios.append(limb.ratio(subject.by_template(motion, 0.0)))
            if degrees == 120:
                plain = subject.by_template(motion, 0.0)
                errors.append(limb.normal_error(posed))
                plain_errors.append(limb.normal_error(plain))
                uncertain.append(limb.uncertainty(posed))
    worst, plain_worst, unsure = (max(e.max() for e in each) for each in (errors, plain_errors, uncertain))
    mean, plain_mean = (max(e.mean() for e in each) for each in (errors, plain_errors))
    lbs = "template LBS, A_R n"
    fewer, more = FEWER_OR_MORE
    thinnest = ("template LBS", min(plain_ratios))
    return result(
        above("cross-section ratio at 150°, thinnest slice", min(ratios), 0.5, baseline=thinnest),
        below("not finite by 180°", float(not finite), 1, "poses"),
        below("normal error at 120°, mean of the worst slice", worst, 15, "°", baseline=(lbs, plain_worst)),
        reported("the same, mean of all slices", mean, "°", baseline=(lbs, plain_mean)),
        reported(f"the surface's own normals, by {fewer} and by {more} neighbours, worst slice", unsure, "°"),
    )


class _Limb:
    """The Gaussians around a bone from ``origin`` [3] along ``axis`` [3]."""

    def __init__(self, subject: Subject, origin: Floats, axis: Floats, length: float) -> None:
        self.origin, self.axis, self.rest = origin, axis, subject.rest
        along, self.radii = self._radii(self.rest.means)
        self.around = (along > -0.5 * length) & (along < 1.5 * length) & (self.radii < 0.12)
        width = max(RING_M, RING_COUNT * 2.0 * length / max(1, int(self.around.sum())))
        ring = np.floor(along / width).astype(int)
        slices = [self.around & (ring == k) for k in np.unique(ring[self.around])]
        self.slices = [s for s in slices if s.sum() >= RING_COUNT]

    def _radii(self, means: NDArray[np.float32]) -> tuple[Floats, Floats]:
        offset = means.astype(np.float64) - self.origin
        along = offset @ self.axis
        return along, np.linalg.norm(offset - np.outer(along, self.axis), axis=1)

    def ratio(self, posed: Gaussians) -> float:
        """Radius over that at rest, least of all slices."""
        radii = self._radii(posed.means)[1]
        return min(float(radii[s].mean() / self.radii[s].mean()) for s in self.slices)

    def normal_error(self, posed: Gaussians) -> Floats:
        """Mean angle of each slice [S], degrees, between posed normals and those of the moved surface."""
        return self._angles(self._surface_normals(posed, NEIGHBOURS), posed.normals[self.around])

    def uncertainty(self, posed: Gaussians) -> Floats:
        """Mean angle of each slice [S], degrees, between the surface's normals by fewer and by more neighbours."""
        fewer, more = (self._surface_normals(posed, count) for count in FEWER_OR_MORE)
        return self._angles(fewer, more)

    def _angles(self, first: NDArray[np.floating], second: NDArray[np.floating]) -> Floats:
        """Mean angle of each slice [S], degrees, between normals [M, 3] around the bone."""
        lengths = np.linalg.norm(first, axis=1) * np.linalg.norm(second, axis=1)
        error = np.zeros(len(self.around))
        cosines = (first * second).sum(1) / np.maximum(lengths, 1e-12)
        error[self.around] = np.degrees(np.arccos(np.clip(cosines, -1, 1)))
        return np.array([error[s].mean() for s in self.slices])

    def _surface_normals(self, posed: Gaussians, neighbours: int) -> Floats:
        """Expected normals [M, 3] around the bone, from positions alone.

        Planes through the neighbours, at rest and posed, give a map F of tangents and normal; the expected normal is
        F⁻ᵀ n_rest.
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
            found[row] = np.linalg.inv(after @ np.linalg.inv(before)).T @ normal
        return found


def _frame(flat: Floats, offsets: Floats) -> Floats:
    """[3, 3] columns: what the two flat coordinates [K, 2] map to in ``offsets`` [K, 3], and the unit normal."""
    first, second = np.linalg.lstsq(flat, offsets, rcond=None)[0]
    normal = np.cross(first, second)
    return np.stack([first, second, normal / max(np.linalg.norm(normal), 1e-12)], axis=1)
