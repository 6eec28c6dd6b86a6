"""Units, cameras, up axis and frame rate of a capture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from rnd_runtime.capture.capture import Capture

BODY_SIZE = (0.4, 2.6)  # m
DISTANCE = (0.3, 300.0)
"""range of the distance to the person, m; PHALP's lens gives a hundred metres"""
FIELD_OF_VIEW = (2.0, 150.0)  # degrees; PHALP's is 2.9
MAX_JOINT_SPEED = 20.0
"""m/s; a boxer's fist reaches 12"""


@dataclass(frozen=True)
class Finding:
    """One sentence about one subject."""

    level: Literal["ok", "note", "wrong"]
    subject: str
    sentence: str


def wrong(subject: str, sentence: str) -> list[Finding]:
    """One finding that something is wrong."""
    return [Finding("wrong", subject, sentence)]


def check_geometry(capture: Capture) -> list[Finding]:
    """Findings about the template's size, the cameras, the up axis and the frame rate."""
    return [*_units(capture), *_cameras(capture), *_speed(capture)]


def _units(capture: Capture) -> list[Finding]:
    size = float(np.ptp(capture.body.vertices, axis=0).max())
    low, high = BODY_SIZE
    if low <= size <= high:
        return [Finding("ok", "units", f"the template is {size:.2f} m across")]
    for unit, factor in (("millimetres", 1e-3), ("centimetres", 1e-2), ("inches", 0.0254)):
        if low <= size * factor <= high:
            return wrong("units", f"the template is {size:.4g} m across: these look like {unit}")
    return wrong("units", f"the template is {size:.4g} m across; a person is {low:g} to {high:g}")


def _cameras(capture: Capture) -> list[Finding]:
    findings = []
    roots = capture.motion.translations + capture.body.skeleton.rest_joints[0]
    used: dict[str, list[int]] = {}
    for frame in capture.frames:
        used.setdefault(frame.camera, []).append(frame.frame)
    far, behind, odd = [], [], []
    for name, frames in used.items():
        camera = capture.cameras[name]
        local = roots[frames] @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
        distance = float(np.median(np.linalg.norm(local, axis=1)))
        if not DISTANCE[0] <= distance <= DISTANCE[1]:
            far.append((name, distance))
        if float((local[:, 2] > 0).mean()) < 0.5:
            behind.append(name)
        angle = 2 * np.degrees(np.arctan(0.5 * max(camera.width, camera.height) / camera.K[0, 0]))
        x, y = camera.K[0, 2] / camera.width, camera.K[1, 2] / camera.height
        if not FIELD_OF_VIEW[0] <= angle <= FIELD_OF_VIEW[1] or not (-0.5 < x < 1.5 and -0.5 < y < 1.5):
            odd.append(f"{name} sees {angle:.3g}° around {x:.2g}, {y:.2g} of its image")
    if far:
        name, distance = far[0]
        too_far, too_near = ": millimetres for metres?", ": metres taken for millimetres?"
        unit = too_far if distance > DISTANCE[1] else too_near if distance < 0.02 else ""
        findings += wrong("cameras", f"{name} is {distance:.4g} m from the person{unit}")
    if behind:
        sentence = f"the person is behind {len(behind)} of {len(used)} cameras ({behind[0]}): inverted or OpenGL axes?"
        findings += wrong("cameras", sentence)
    if odd:
        findings += wrong("cameras", f"{odd[0]}: K does not belong to these images")
    up = capture.motion.rotations[:, 0, :, 1].mean(0)  # mean direction of the pelvis's own up axis
    if abs(up[1]) < 0.5 < np.abs(up).max():
        findings += wrong("world", f"the person stands along {'xyz'[int(np.abs(up).argmax())]}, not along Y")
    elif up[1] < -0.5:
        findings += wrong("world", "the person stands on the head: Y points down")
    return findings or [Finding("ok", "cameras", f"{len(used)} in use, the person in front of them, Y up")]


def _speed(capture: Capture) -> list[Finding]:
    motion, skeleton = capture.motion, capture.body.skeleton
    if motion.frame_count < 3:
        return []
    joints = skeleton.joint_transforms(motion.rotations, motion.translations)[..., :3, 3]
    speed = np.linalg.norm(np.diff(joints, axis=0), axis=-1).max(1) * motion.fps
    fast = float(np.percentile(speed, 95))
    if fast > MAX_JOINT_SPEED:
        return wrong(
            "frame rate", f"joints move at {fast:.0f} m/s: frame rate {motion.fps:g} is too high, or the poses jump"
        )
    return [Finding("ok", "frame rate", f"{motion.fps:g} per second; the fastest joint moves at {fast:.1f} m/s")]
