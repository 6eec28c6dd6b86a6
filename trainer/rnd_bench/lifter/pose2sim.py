"""Pose2Sim's four calibrated cameras: truth by triangulation of the landmark network's points.

Source: Hartley and Zisserman 2004, Multiple View Geometry, 12.2 (linear triangulation).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
from numpy.typing import NDArray

from rnd_trainer.estimating.lifted import JOINTS, PARENTS, REST_OFFSETS, Lifted
from rnd_trainer.estimating.lifter import lift
from rnd_trainer.estimating.observations import BLAZEPOSE, Observations

from .captured import observed
from .figures import BODY, LIMBS, angles, placed, procrustes, root_relative

Floats = NDArray[np.float64]

SCORED = ("cam01", "cam03")
EVERY = 2
"""frames of the videos per frame looked at"""
_REST_WIDTHS = {"hip": 2 * 0.086, "shoulder": 2 * (0.076 + 0.114)}  # m, of REST_OFFSETS
_REST_TRUNK = 0.457  # m, from the middle of the hips to that of the shoulders
_UNIT = 64.0  # of the file's intrinsics, a pixel
_SURE = 0.5
"""confidence from which a point is triangulated"""


@dataclass(frozen=True, eq=False)
class Calibrated:
    """A camera: ``rotation`` [3, 3] and ``translation`` [3] m into OpenCV's camera axes, intrinsics, distortion [4]."""

    rotation: Floats
    translation: Floats
    intrinsics: Floats
    distortion: Floats

    def undistorted(self, pixels: Floats) -> Floats:
        """Rays [..., 2] x/z and y/z of pixels [..., 2]."""
        rays = cv2.undistortPoints(pixels.reshape(-1, 1, 2).astype(np.float64), self.intrinsics, self.distortion)
        return np.asarray(rays, np.float64).reshape(pixels.shape)


def load_cameras(file: Path) -> dict[str, Calibrated]:
    """Cameras of a Qualisys calibration, whose own axes are x right, y up, z towards the camera."""
    cameras = {}
    for node in ElementTree.parse(file).getroot().iter("camera"):
        pose, inner = node.find("transform"), node.find("intrinsic")
        assert pose is not None and inner is not None
        axes = np.array([[float(pose.attrib[f"r{i}{j}"]) for j in (1, 2, 3)] for i in (1, 2, 3)])
        centre = np.array([float(pose.attrib[axis]) for axis in "xyz"]) / 1e3
        number = {name: float(value) for name, value in inner.attrib.items()}
        k = np.array(
            [
                [number["focalLengthU"] / _UNIT, 0, number["centerPointU"] / _UNIT],
                [0, number["focalLengthV"] / _UNIT, number["centerPointV"] / _UNIT],
                [0, 0, 1],
            ]
        )
        names = ("radialDistortion1", "radialDistortion2", "tangentalDistortion1", "tangentalDistortion2")
        rotation = np.diag([1.0, -1.0, -1.0]) @ axes
        distortion = np.array([number[name] for name in names])
        cameras[node.attrib["serial"]] = Calibrated(rotation, -rotation @ centre, k, distortion)
    return cameras


def triangulated(cameras: list[Calibrated], rays: Floats, confidence: Floats) -> Floats:
    """World points [T, P, 3] of rays [C, T, P, 2]; NaN where fewer than two cameras are sure."""
    count, points = rays.shape[1:3]
    matrices = np.stack([np.hstack([c.rotation, c.translation[:, None]]) for c in cameras])
    found = np.full((count, points, 3), np.nan)
    for t in range(count):
        for p in range(points):
            sure = np.flatnonzero(confidence[:, t, p] >= _SURE)
            if len(sure) < 2:
                continue
            rows = [rays[c, t, p, axis] * matrices[c, 2] - matrices[c, axis] for c in sure for axis in (0, 1)]
            solution = np.linalg.svd(np.array(rows))[2][-1]
            found[t, p] = solution[:3] / solution[3]
    return found


def watched(
    folder: Path, out: Path, points: Sequence[str]
) -> tuple[dict[str, Calibrated], dict[str, Observations], dict[str, NDArray[np.int64]], Floats]:
    """Cameras, their observations of every ``EVERY``-th frame, and what all saw at once, by triangulation.

    Args:
        folder: Pose2Sim's Demo_SinglePerson.
        out: folder in which observations are kept.
        points: P names of BlazePose's points.

    Returns:
        By camera: calibration, observations, and rows [T] of the frames that all share; the points [T, P, 3] m in the
        file's world, NaN where they are unknown.
    """
    cameras = load_cameras(folder / "calibration" / "Calib.qca.txt")
    names = sorted(cameras)
    seen = {name: observed(folder / "videos" / f"{name}.mp4", out / f"{name}.npz", EVERY) for name in names}
    shared = sorted(set.intersection(*(set(one.frames.tolist()) for one in seen.values())))
    rows = {name: np.searchsorted(seen[name].frames, shared) for name in names}
    chosen = [BLAZEPOSE.index(point) for point in points]
    rays = np.stack([cameras[n].undistorted(seen[n].keypoints_px[rows[n]][:, chosen].astype(float)) for n in names])
    confidence = np.stack([seen[n].confidence[rows[n]][:, chosen] for n in names]).astype(np.float64)
    return cameras, seen, rows, triangulated([cameras[n] for n in names], rays, confidence)


def figures_of_cameras(folder: Path, network: Path, out: Path) -> list[dict[str, object]]:
    """Rows of the scored cameras: the lifter and the landmark network against the triangulated points.

    Args:
        folder: Pose2Sim's Demo_SinglePerson.
        out: folder in which observations of every second frame are kept.
    """
    cameras = load_cameras(folder / "calibration" / "Calib.qca.txt")
    names = sorted(cameras)
    seen: dict[str, Observations] = {
        name: observed(folder / "videos" / f"{name}.mp4", out / f"{name}.npz", EVERY) for name in names
    }
    rays = np.stack([cameras[n].undistorted(seen[n].keypoints_px.astype(np.float64)) for n in names])
    points = triangulated([cameras[n] for n in names], rays, np.stack([seen[n].confidence for n in names]))
    errors = []
    for k, name in enumerate(names):
        camera = cameras[name]
        local = points @ camera.rotation.T + camera.translation
        apart = np.linalg.norm(local[..., :2] / local[..., 2:] - rays[k], axis=-1) * camera.intrinsics[0, 0]
        errors.append(apart[np.isfinite(apart) & (seen[name].confidence >= _SURE)])
    residual = float(np.median(np.concatenate(errors)))
    rows = []
    for name in SCORED:
        camera, own = cameras[name], seen[name]
        pixels = camera.undistorted(own.keypoints_px.astype(np.float64)) * camera.intrinsics[0, 0]
        plain = replace(own, keypoints_px=pixels.astype(np.float32))
        lifted = lift(plain, camera.intrinsics[0, 0], (0.0, 0.0), network)
        local = points @ camera.rotation.T + camera.translation
        rows.append({"set": f"Pose2Sim {name}", "residual_px": residual, **_row(lifted, own.keypoints_m, local)})
    return rows


def _row(lifted: Lifted, hint_m: NDArray[np.float32], truth: Floats) -> dict[str, object]:
    """Figures of one camera; the lifter's bones get the lengths of the triangulated body."""
    known = np.isfinite(truth[:, [BLAZEPOSE.index(n) for n in BODY]]).all((1, 2))
    truth, hint_m = truth[known], hint_m[known]
    bones = {
        n: truth[:, BLAZEPOSE.index(n)] - truth[:, BLAZEPOSE.index(JOINTS[PARENTS[JOINTS.index(n)]])] for n in LIMBS
    }
    ours = {n: angles(lifted.directions[known, JOINTS.index(n) - 1], _unit(bones[n])) for n in LIMBS}
    theirs = {n: angles(_unit(_bone(hint_m, n)), _unit(bones[n])) for n in LIMBS}
    lengths = np.tile(np.linalg.norm(REST_OFFSETS[1:], axis=1), (known.sum(), 1))
    for part in ("hip", "shoulder"):
        ends = [f"left_{part}", f"right_{part}"]
        a, b = (BLAZEPOSE.index(n) for n in ends)
        share = np.median(np.linalg.norm(truth[:, a] - truth[:, b], axis=1)) / _REST_WIDTHS[part]
        for end in ends:
            chain = [end] if part == "hip" else [end, end.replace("shoulder", "collar")]
            lengths[:, [JOINTS.index(n) - 1 for n in chain]] *= share
    middles = [
        truth[:, [BLAZEPOSE.index(f"{side}_{part}") for side in ("left", "right")]].mean(1) for part in _REST_WIDTHS
    ]
    share = np.median(np.linalg.norm(middles[1] - middles[0], axis=1)) / _REST_TRUNK
    lengths[:, [JOINTS.index(n) - 1 for n in ("spine1", "spine2", "spine3")]] *= share
    for n in LIMBS:
        lengths[:, JOINTS.index(n) - 1] = np.median(np.linalg.norm(bones[n], axis=1))
    body = placed(np.concatenate([lifted.directions, lifted.roll], 1)[known], lengths)[
        :, [JOINTS.index(n) for n in BODY]
    ]
    chosen = [BLAZEPOSE.index(n) for n in BODY]
    return {
        "frames": int(known.sum()),
        "limbs_deg": float(np.mean([a.mean() for a in ours.values()])),
        "limbs_deg_landmarks": float(np.mean([a.mean() for a in theirs.values()])),
        "root_relative_mm": 1e3 * root_relative(body, truth[:, chosen]),
        "root_relative_mm_landmarks": 1e3
        * root_relative(hint_m[:, chosen].astype(np.float64), truth[:, chosen], scaled=True),
        "pa_mm": 1e3 * float(procrustes(body, truth[:, chosen]).mean()),
        "pa_mm_landmarks": 1e3 * float(procrustes(hint_m[:, chosen].astype(np.float64), truth[:, chosen]).mean()),
        "bones_deg": {n: float(a.mean()) for n, a in ours.items()},
        "bones_deg_landmarks": {n: float(a.mean()) for n, a in theirs.items()},
    }


def _bone(points: NDArray[np.float32], name: str) -> NDArray[np.float32]:
    start, end = (BLAZEPOSE.index(n) for n in (JOINTS[PARENTS[JOINTS.index(name)]], name))
    return points[:, end] - points[:, start]


def _unit(vectors: NDArray[np.floating]) -> NDArray[np.floating]:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-9)
