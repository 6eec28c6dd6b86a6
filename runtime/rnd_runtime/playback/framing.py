"""Cameras that show a motion completely, from the front or from an orbit.

A camera path ``(frame, time_s) -> Camera`` depends on its arguments alone, so any part of a run gives the same pixels.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.camera import Camera

if TYPE_CHECKING:  # a command's options must not import kernels
    from rnd_runtime.motion.motion import Motion
    from rnd_runtime.motion.skeleton import Skeleton

Floats = NDArray[np.float64]
CameraPath = Callable[[int, float], Camera]

ELEVATION, FIELD_OF_VIEW = 5.0, 35.0  # degrees
PADDING = 0.14
"""reach of body and clothes beyond the joints, as a share of the skeleton's height: 0.23 m for SMPL"""
_ORBIT_SAMPLES = 72  # azimuths that determine an orbit's distance


@dataclass(frozen=True, eq=False)
class Framing:
    """Extent of a motion for an automatic camera.

    Attributes:
        joints: [P, 3] m, world: every joint in every frame.
        centre: [3] m, centre of their bounding box.
        padding: m, reach of the body beyond its joints.
        facing: rad, azimuth ``atan2(x, z)`` that the body faces in the first frame.
    """

    joints: Floats
    centre: Floats
    padding: float
    facing: float

    @property
    def radius(self) -> float:
        """Radius in m of a sphere about ``centre`` that contains the body at all times."""
        return float(np.linalg.norm(self.joints - self.centre, axis=1).max()) + self.padding


@dataclass(frozen=True)
class CameraOptions:
    """Options of an automatic camera.

    Attributes:
        width, height: pixels.
        fov_y: vertical field of view, rad.
        elevation: rad above the horizon.
        distance: m from the framing's centre; by default the smallest that shows all of the motion.
    """

    width: int
    height: int
    fov_y: float = math.radians(FIELD_OF_VIEW)
    elevation: float = math.radians(ELEVATION)
    distance: float | None = None


def frame_motion(skeleton: Skeleton, motion: Motion) -> Framing:
    """The ``Framing`` of ``motion`` on ``skeleton``."""
    joints = skeleton.joint_transforms(motion.rotations, motion.translations)[:, :, :3, 3].reshape(-1, 3)
    height = float(np.ptp(skeleton.rest_joints, axis=0).max())
    forward = motion.rotations[0, 0] @ np.array([0.0, 0.0, 1.0])  # a body at rest faces +Z
    facing = float(np.arctan2(forward[0], forward[2])) if np.hypot(forward[0], forward[2]) > 1e-3 else 0.0
    return Framing(joints, (joints.min(axis=0) + joints.max(axis=0)) / 2, PADDING * height, facing)


def front_path(framing: Framing, view: CameraOptions) -> CameraPath:
    """A fixed camera in front of the body as it faces in the first frame."""
    distance = view.distance or _fitting_distance(framing, view, np.array([framing.facing]))
    camera = _camera_around(framing.centre, view, framing.facing, distance)
    return lambda frame, time_s: camera


def orbit_path(framing: Framing, view: CameraOptions, seconds: float) -> CameraPath:
    """A camera that starts in front and circles once in ``seconds``, towards the body's left."""
    azimuths = np.linspace(0, 2 * np.pi, _ORBIT_SAMPLES, endpoint=False)
    distance = view.distance or _fitting_distance(framing, view, azimuths)
    return lambda frame, time_s: _camera_around(
        framing.centre, view, framing.facing + 2 * np.pi * time_s / seconds, distance
    )


def _camera_around(centre: Floats, view: CameraOptions, azimuth: float, distance: float) -> Camera:
    horizontal = np.cos(view.elevation)
    direction = np.array([horizontal * np.sin(azimuth), np.sin(view.elevation), horizontal * np.cos(azimuth)])
    return Camera.look_at(centre + distance * direction, centre, width=view.width, height=view.height, fov_y=view.fov_y)


def _fitting_distance(framing: Framing, view: CameraOptions, azimuths: Floats) -> float:
    """The smallest distance in m at which every padded joint is in the image at all ``azimuths``.

    A sphere of radius r at (x, y, z) from the centre, in camera axes, is inside the plane with half-angle a
    when d ≥ (|x| cos a + r) / sin a − z.
    """
    half_y = view.fov_y / 2
    half_x = np.arctan(np.tan(half_y) * view.width / view.height)
    distance = 0.0
    for azimuth in azimuths:
        rotation = _camera_around(framing.centre, view, azimuth, 1.0).world_to_camera[:3, :3]
        x, y, z = rotation @ (framing.joints - framing.centre).T
        for offset, half in ((x, half_x), (y, half_y)):
            needed = (np.abs(offset) * np.cos(half) + framing.padding) / np.sin(half) - z
            distance = max(distance, float(needed.max()))
    return distance
