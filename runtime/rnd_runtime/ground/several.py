"""What the shadows of several bodies leave of the ground's light.

Bodies hide different parts of the sky, as if by chance, and the same directional light: what they leave of the sky
multiplies, of a directional light the least counts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rnd_runtime.core.arrays import Floats32, floats
from rnd_runtime.core.camera import Camera

from .lookup import add_lights, block_sun
from .shadow import GroundLight, Shadow, compose, image_to_plane


def remaining_of_several(shadows: Sequence[Shadow], light: GroundLight, camera: Camera) -> Floats32:
    """Share [H, W, 3] of the ground's irradiance at every pixel, of ``shadows`` in one plane under ``light``."""
    shape, total = (camera.height, camera.width), np.maximum(light.irradiance, 1e-30)
    of_sky = floats(light.sky.sum(axis=0) / total)
    left, blocked = np.ones((*shape, 3), np.float32), np.zeros((len(light.suns), *shape), np.float32)
    scale = floats([*(1 / np.maximum(of_sky, 1e-30)).tolist(), 0.0])
    for shadow in shadows:
        region = rows, columns = shadow.region(camera)
        if rows.start == rows.stop or columns.start == columns.stop:
            continue
        view, sky = camera.cropped(rows, columns), shadow.sky._replace(values=shadow.sky.values * scale)
        alone = replace(shadow, sky=sky, suns=())
        left[region] *= alone.remaining(view, np.empty((view.height, view.width, 3), np.float32))
        to_plane = image_to_plane(view, shadow.plane)
        for sun, (cast, _) in zip(blocked, shadow.suns):
            block_sun(compose(cast.to_cells, to_plane), cast.values, sun[region])
    shares = floats([irradiance / total for _, irradiance, _ in light.suns]).reshape(-1, 3)
    add_lights(left, of_sky, blocked, shares)
    return left
