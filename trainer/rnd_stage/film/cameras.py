"""The stage's cameras: three rings around the person."""

from __future__ import annotations

import numpy as np

from rnd_runtime.core.camera import Camera
from rnd_runtime.core.errors import InputError

DISTANCE = 4.4  # m
TARGET = (0.0, 0.92, 0.0)
VISIBLE_HEIGHT = 2.25  # m at the target: a person of 1.75 m with raised arms
RINGS = ((4.0, 0.5), (32.0, 0.3), (-12.0, 0.2))  # elevation in degrees, share of the cameras


def ring_cameras(count: int, size: int) -> dict[str, Camera]:
    """``count`` square cameras "cam00" …: the middle ring, the upper, the lower.

    ``cam00`` looks from the front, slightly down. The rings are rotated against each other to avoid equal azimuths.
    """
    if count < 1:
        raise InputError("--cameras", expected="at least 1", got=count)
    if size < 8:
        raise InputError("--size", expected="at least 8 pixels", got=size)
    numbers = [round(share * count) for _, share in RINGS[1:]]
    numbers.insert(0, count - sum(numbers))
    target, fov = np.array(TARGET), 2 * np.arctan(0.5 * VISIBLE_HEIGHT / DISTANCE)
    cameras: dict[str, Camera] = {}
    for ring, ((elevation, _), number) in enumerate(zip(RINGS, numbers)):
        for k in range(number):
            azimuth = 2 * np.pi * (k + ring / len(RINGS)) / number
            e = np.radians(elevation)
            eye = target + DISTANCE * np.array([np.sin(azimuth) * np.cos(e), np.sin(e), np.cos(azimuth) * np.cos(e)])
            cameras[f"cam{len(cameras):02d}"] = Camera.look_at(eye, target, width=size, height=size, fov_y=float(fov))
    return cameras
