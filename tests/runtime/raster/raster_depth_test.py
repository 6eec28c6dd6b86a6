"""Every rasteriser can leave the depth out, and nothing else changes."""

from __future__ import annotations

from contextlib import nullcontext

import numpy as np
import pytest

from rnd_runtime.playback.rasterizer import make_rasterizer
from rnd_runtime.raster import cpu as raster_cpu
from rnd_runtime.raster import oracle as raster_oracle
from support.raster_scenes import off_centre_camera, random_scene


def _rasterizer(kind: str):
    if kind == "oracle":
        return nullcontext(raster_oracle.rasterize)
    if kind == "kernel":
        return nullcontext(raster_cpu.rasterize)
    return make_rasterizer(f"gl-{kind}")


@pytest.mark.parametrize("kind", ["oracle", "kernel", "egl", "osmesa"])
@pytest.mark.parametrize("channels", [0, 1, 3, 4])
def test_leaving_out_the_depth_changes_nothing_else(kind: str, channels: int) -> None:
    scene, camera = random_scene(3, channels=channels), off_centre_camera(40, 30)
    with _rasterizer(kind) as rasterize:
        with_depth, without = rasterize(*scene, camera), rasterize(*scene, camera, depth=False)
    assert np.array_equal(with_depth.image, without.image)
    assert np.array_equal(with_depth.alpha, without.alpha)
    assert with_depth.depth.max() > 0.5
    assert without.depth.shape == (30, 40) and not without.depth.any()
