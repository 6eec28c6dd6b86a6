"""What the points of the grid film: a walk under a sky, or what is hardest for speed and accuracy.

The hardest are the worst camera, in the neck and looking down into the body, the worst pose, a squat, and the worst
light, a sun of 10⁶.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Literal, NamedTuple, get_args

import numpy as np

from rnd_runtime.capture.body import Body
from rnd_runtime.core.camera import Camera
from rnd_runtime.core.images import write_image
from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_runtime.motion.motion import load_motion, save_motion

SceneName = Literal["usual", "inside the body", "squat", "sun of 1e6"]
USUAL, INSIDE, SQUAT, SUN = get_args(SceneName)
HARDEST = (INSIDE, SQUAT, SUN)
SUN_RADIANCE = 1e6
NECK, FEET = (0.0, 1.5, 0.0), (0.0, 0.3, 0.1)
"""m, of the body that stands at the origin; across it all would lie before the near plane"""


class Scene(NamedTuple):
    """The files that frames are made from, and what ``bench_camera`` is to view."""

    motion: Path
    hdr: Path
    view: str


def scene(name: str, body: Path, motion: Path, hdr: Path, folder: Path, key: str) -> Scene:
    """The scene ``name`` made of a ``motion`` of ``body`` and a light; new files are kept in ``folder`` by ``key``."""
    if name == SQUAT:
        motion = _kept(folder / f"squat_{key}.npz", lambda out: _squat(out, body, motion))
    if name == SUN:
        hdr = _kept(folder / f"sun_{key}.exr", _sun)
    return Scene(motion, hdr, INSIDE if name == INSIDE else USUAL)


def bench_camera(size: int, view: str = USUAL) -> Camera:
    """A square view of a standing person, 1.75 m filling 70 % of the height, 20° to the side; or of the inside."""
    distance, angle = 3.4, np.radians(20)
    fov = 2 * np.arctan(0.5 * 1.75 / 0.7 / distance)
    if view == INSIDE:
        return Camera.look_at(list(NECK), list(FEET), width=size, height=size, fov_y=fov)
    eye = [distance * np.sin(angle), 0.9, distance * np.cos(angle)]
    return Camera.look_at(eye, [0, 0.875, 0], width=size, height=size, fov_y=fov)


def _kept(file: Path, make: Callable[[Path], None]) -> Path:
    if not file.exists():
        make(file)
    return file


def _squat(out: Path, body: Path, motion: Path) -> None:
    """``motion`` with the joints of the stability suite's squat held, the others as they were."""
    from .subject import EXTREMES

    walking = load_motion(motion, Body.load(body).skeleton)
    rotations = walking.rotations.copy()
    for joint, angles in EXTREMES["squat"].items():
        if joint in walking.joint_names:
            rotations[:, walking.joint_names.index(joint)] = axis_angle_to_matrix(np.array(angles))
    save_motion(out, replace(walking, rotations=rotations))


def _sun(out: Path) -> None:
    from .lights import sun_and_sky

    write_image(out, sun_and_sky(128, radiance=SUN_RADIANCE).radiance)
