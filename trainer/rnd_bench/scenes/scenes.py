"""Scenes of the grid: a walk under a sky; a camera in the neck looking down, a squat, a sun of 10⁶."""

from __future__ import annotations

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
    """Input files, and the view of ``bench_camera``."""

    motion: Path
    hdr: Path
    view: str


def bench_scene(name: str, body: Path, motion: Path, hdr: Path, folder: Path, key: str) -> BenchScene:
    """The scene ``name`` of a ``motion`` of ``body`` and a light; new files are stored in ``folder`` by ``key``."""
    if name == SQUAT and not (squat := folder / f"squat_{key}.npz").exists():
        _squat(squat, body, motion)
    if name == SUN and not (sun := folder / f"sun_{key}.exr").exists():
        write_image(sun, sun_and_sky(128, radiance=SUN_RADIANCE).radiance)
    motion, hdr = squat if name == SQUAT else motion, sun if name == SUN else hdr
    return BenchScene(motion, hdr, INSIDE if name == INSIDE else USUAL)


def bench_camera(size: int, view: str = USUAL) -> Camera:
    """A square view, 20° to the side, of a person 1.75 m tall who fills 70 % of the height; or of the inside."""
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
