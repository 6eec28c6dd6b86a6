"""From Gaussians to pictures in one compiled pass: projection and culling, sorting, blending (numba)."""

from __future__ import annotations

from numba import njit

from rnd_runtime.core.clock import now

from .blend import blend
from .project import project
from .tiles import Splats, sort_into_tiles


@njit(error_model="numpy", nogil=True, cache=True)
def splat(arrays, seen, view, threads, with_depth, with_slots, outlines):  # type: ignore[no-untyped-def]
    """Project, cull, sort and blend N Gaussians.

    Args:
        arrays: means [N, 3], covariances [N, 6], opacities [N] and features [N, C], float32 and contiguous.
        seen: [N] those to be drawn; all where it is empty.
        view: a ``._raster_project.Pinhole``.
        threads: how many of numba's share the work; changes no bit.
        with_depth: depths are blended after the features.
        with_slots: the ``Splats`` can be differentiated.
        outlines: the pictures' outlines are sharp, see ``.outline``.

    Returns:
        splats: the ``Splats``.
        image: [H, W, K] features, then the depth where it is asked for.
        coverage: [H, W] alpha.
        seconds: of projection and of sorting; the rest was blending.
    """
    means, covariances, opacities, features = arrays
    started = now()
    centers, shapes, boxes, attributes, depths, slot_starts = project(
        means, covariances, opacities, features, seen, view, with_depth
    )
    projected = now()
    tile_starts, pair_gaussians, pair_slots = sort_into_tiles(
        boxes, depths, slot_starts, (view.width, view.height), threads, with_slots
    )
    ordered = now()
    splats = Splats(centers, shapes, attributes, slot_starts, tile_starts, pair_gaussians, pair_slots)
    image, coverage = blend(splats, view.width, view.height, threads, outlines)
    return splats, image, coverage, (projected - started, ordered - projected)
