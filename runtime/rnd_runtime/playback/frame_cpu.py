"""Frames on the CPU: posed, shaded by tables, splatted and tone mapped in one compiled call.

The kernels are those that the stages have of their own, and so are the pictures, to the bit. What a call of its own
costs each of them, and what Python does in between with cold caches, is a tenth of a frame.
"""

from __future__ import annotations

from functools import lru_cache
from time import perf_counter
from typing import NamedTuple

import numpy as np
from numba import get_num_threads, njit
from numpy.typing import NDArray

from rnd_runtime.core.arrays import floats
from rnd_runtime.core.camera import Camera
from rnd_runtime.core.clock import now
from rnd_runtime.core.gaussians import Floats32, Raster
from rnd_runtime.posing.posing import Unposed, pose
from rnd_runtime.raster.in_view import look
from rnd_runtime.raster.passes import splat
from rnd_runtime.raster.project import pinhole
from rnd_runtime.raster.tone import tone_map_on_black, tone_tables
from rnd_runtime.shading.shader import SHADOW_RESOLUTION, Shader, disc_radii
from rnd_runtime.shading.shadow import cast_shadows
from rnd_runtime.shading.sunlight import SunArrays, add_suns
from rnd_runtime.shading.tables import SkyTables, TableArrays, shade_by_tables

_STAGES = ("posing", "shading", "projection", "sort", "raster", "tone map")


class _Material(NamedTuple):
    """What of N Gaussians no pose changes."""

    opacities: Floats32  # [N]
    albedo: Floats32  # [N, 3]
    roughness: Floats32  # [N]


class _Light(NamedTuple):
    """A light as ``Shader`` has it, in the frame of the bones."""

    to_frame: NDArray[np.float64]  # [3, 3]
    tables: TableArrays
    suns: SunArrays


def draws(shader: Shader) -> bool:
    """Whether ``draw`` knows the ``shader``'s mode: tables, with suns or without."""
    return isinstance(shader.sky, SkyTables)


def draw(body: Unposed, shader: Shader, camera: Camera, *, cull: float | None = None, coded: bool = True) -> Raster:
    """The picture's linear radiance [H, W, 3], outlines sharpened, without depth, and its 8-bit codes.

    What ``avatar.avatar.Avatar.posed``, ``playback.frame.draw`` and ``raster.tone.tone_map``
    make one after the other, with ``seconds`` of "tone map" too. "posing" has what is between the stages.

    Args:
        cull: as of ``playback.frame.FrameRenderer``; what is culled casts shadows all the same.
        coded: make ``srgb`` too.
    """
    started = perf_counter()
    assert isinstance(shader.sky, SkyTables)
    rest = body.rest
    image, alpha, codes, seconds = _draw(
        rest.arrays,
        rest.nodes(body.logits, body.offsets, body.visibility),
        floats(body.bones),
        rest.limits,
        _Material(floats(body.opacities), floats(body.albedo), floats(body.roughness)),
        pinhole(camera),
        np.array(camera.position, np.float32),
        np.float32(-1 if cull is None else cull),
        _Light(shader.light_to_world, shader.sky.arrays, shader.sun_arrays()),
        tone_tables(),
        coded,
        get_num_threads(),
    )
    stages = dict(zip(_STAGES, seconds))
    if not coded:
        del stages["tone map"]
    stages["posing"] += perf_counter() - started - sum(seconds)
    return Raster(image, alpha, _no_depth(alpha.shape), stages, codes if coded else None)


@lru_cache(maxsize=4)
def _no_depth(shape: tuple[int, int]) -> Floats32:
    return np.broadcast_to(np.float32(0), shape)


@njit(error_model="numpy", nogil=True, cache=True)
def _draw(rest, nodes, bones, limits, material, view, eye, least, light, codes, coded, threads):  # type: ignore[no-untyped-def]
    started = now()
    count = len(material.opacities)
    means, covariances, normals, visibility = pose(rest, nodes, bones, limits, count)
    posed = now()
    seen = look(means, covariances, material.opacities, normals, eye, least, view)
    surfaces = means, normals, material.albedo, material.roughness, visibility
    root = bones[0, :, :3].astype(np.float64)
    radiance = shade_by_tables(surfaces, eye, light.to_frame, root, light.tables, seen)
    if len(light.suns.directions) > 0:
        radii = disc_radii(covariances, material.opacities)
        shadows = cast_shadows((means, normals, radii, seen), light.suns.directions, SHADOW_RESOLUTION, threads)
        add_suns(surfaces, shadows, eye, light.suns, seen, radiance)
    shaded = now()
    arrays = means, covariances, material.opacities, radiance
    _, image, alpha, (projection, sort) = splat(arrays, seen, view, threads, False, False, True)
    splatted = now()
    picture = tone_map_on_black(image, alpha, codes) if coded else np.empty((0, 0, 3), np.uint8)
    seconds = (
        posed - started,
        shaded - posed,
        projection,
        sort,
        splatted - shaded - projection - sort,
        now() - splatted,
    )
    return image, alpha, picture, seconds
