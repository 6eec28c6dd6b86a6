"""What the points of the grid render: a walk under a sky, or one of the hardest scenes.

The hardest are the worst camera, in the neck and looking down into the body, the worst pose, a squat, and the worst
light, a sun of 10⁶.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple, get_args

import numpy as np

from rnd_bench.options import SceneName
from rnd_runtime.capture.body import Body
from rnd_runtime.core.camera import Camera
from rnd_runtime.core.images import write_image
from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_runtime.motion.motion import load_motion, save_motion

from .lights import sun_and_sky
from .poses import EXTREMES

USUAL, INSIDE, SQUAT, SUN = get_args(SceneName)
HARDEST = (INSIDE, SQUAT, SUN)
SUN_RADIANCE = 1e6
NECK, FEET = (0.0, 1.5, 0.0), (0.0, 0.3, 0.1)  # m, of the body that stands at the origin


class BenchScene(NamedTuple):
    """The files that frames are made from, and the view of ``bench_camera``."""

    motion: Path
    hdr: Path
    view: str


def bench_scene(name: str, body: Path, motion: Path, hdr: Path, folder: Path, key: str) -> BenchScene:
    """The scene ``name`` of a ``motion`` of ``body`` and a light; new files are stored in ``folder`` by ``key``."""

    def made(file: Path, make: Callable[[Path], None]) -> Path:
        if not file.exists():
            make(file)
        return file

    if name == SQUAT:
        motion = made(folder / f"squat_{key}.npz", lambda out, walk=motion: _squat(out, body, walk))  # type: ignore[misc]
    if name == SUN:
        sky = sun_and_sky(128, radiance=SUN_RADIANCE)
        hdr = made(folder / f"sun_{key}.exr", lambda out: write_image(out, sky.radiance))
    return BenchScene(motion, hdr, INSIDE if name == INSIDE else USUAL)


def bench_camera(size: int, view: str = USUAL) -> Camera:
    """A square view of a standing person, 1.75 m filling 70 % of the height, 20° to the side; or of the inside."""
    distance, angle = 3.4, np.radians(20)
    fov = 2 * np.arctan(0.5 * 1.75 / 0.7 / distance)
    if view == INSIDE:
        return Camera.look_at(list(NECK), list(FEET), width=size, height=size, fov_y=fov)
    eye = [distance * np.sin(angle), 0.9, distance * np.cos(angle)]
    return Camera.look_at(eye, [0, 0.875, 0], width=size, height=size, fov_y=fov)


def _squat(out: Path, body: Path, motion: Path) -> None:
    """``motion`` with the joints of the stability suite's squat fixed."""
    walking = load_motion(motion, Body.load(body).skeleton)
    rotations = walking.rotations.copy()
    for joint, angles in EXTREMES["squat"].items():
        if joint in walking.joint_names:
            rotations[:, walking.joint_names.index(joint)] = axis_angle_to_matrix(np.array(angles))
    save_motion(out, replace(walking, rotations=rotations))
