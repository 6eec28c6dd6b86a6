"""The CPU rasteriser: numba, float32 with float64 projection, forward and backward, any number of channels.

The rule is ``core.gaussians.Rasterizer``'s. Gaussians with non-finite numbers, a covariance of trace zero or a
projection that is not positive definite are skipped and get zero gradients. The result does not depend on the number of
threads, to the bit.
"""

from __future__ import annotations

from dataclasses import dataclass
from time import perf_counter

import numpy as np
from numba import get_num_threads
from numpy.typing import ArrayLike, NDArray

from rnd_runtime.core.arrays import Floats32, check_shape, checked, floats, mask
from rnd_runtime.core.camera import Camera
from rnd_runtime.core.gaussians import Raster

from .blend import blend, blend_backward
from .project import Pinhole, pinhole, project, project_backward
from .tiles import Splats, sort_into_tiles

_EVERYTHING = np.empty(0, np.bool_)


@dataclass(frozen=True, eq=False)
class State:
    """Opaque result of ``forward`` for ``backward``."""

    means: Floats32
    covariances: Floats32
    opacities: Floats32
    view: Pinhole
    splats: Splats
    image: Floats32  # [H, W, K] features, then depth
    coverage: Floats32  # [H, W]
    channels: int


def rasterize(
    means: Floats32,
    covariances: Floats32,
    opacities: Floats32,
    features: Floats32,
    camera: Camera,
    *,
    depth: bool = True,
    outlines: bool = False,
    visible: ArrayLike | None = None,
) -> Raster:
    """Splat N Gaussians.

    Args:
        means: [N, 3] m, world.
        covariances: [N, 6] m², world, upper triangle (xx, xy, xz, yy, yz, zz).
        opacities: [N].
        features: [N, C].
        camera: the view.
        depth: False leaves the depth image zero.
        outlines: sharpen them (``.outline``).
        visible: [N] Gaussians to render, from ``raster.in_view.in_view``; all by default.

    Raises:
        InputError: an array has the wrong shape.
    """
    arrays = checked(means, covariances, opacities, features)
    chosen = _EVERYTHING if visible is None else mask(visible, len(arrays[0]))
    return _splat(arrays, chosen, pinhole(camera), depth, False, outlines)[0]


def forward(
    means: Floats32,
    covariances: Floats32,
    opacities: Floats32,
    features: Floats32,
    camera: Camera,
    *,
    depth: bool = True,
) -> tuple[Raster, State]:
    """``rasterize`` that also returns the input of ``backward``."""
    arrays = checked(means, covariances, opacities, features)
    view = pinhole(camera)
    raster, splats, image = _splat(arrays, _EVERYTHING, view, depth, True, False)
    return raster, State(*arrays[:3], view, splats, image, raster.alpha, arrays[3].shape[1])


def _splat(
    arrays: tuple[Floats32, Floats32, Floats32, Floats32],
    visible: NDArray[np.bool_],
    view: Pinhole,
    depth: bool,
    differentiable: bool,
    outlines: bool,
) -> tuple[Raster, Splats, Floats32]:
    """The raster, the splats, and features and depth in one image [H, W, K]."""
    started = perf_counter()
    threads, channels = get_num_threads(), arrays[3].shape[1]
    centers, shapes, boxes, attributes, depths, slot_starts = project(*arrays, visible, view, depth)
    projected = perf_counter()
    size = view.width, view.height
    tile_starts, *pairs = sort_into_tiles(boxes, depths, slot_starts, size, threads, differentiable)
    sorted_ = perf_counter()
    splats = Splats(centers, shapes, attributes, slot_starts, tile_starts, *pairs)
    image, coverage = blend(splats, view.width, view.height, threads, outlines)
    far = image[..., channels] if depth else np.zeros_like(coverage)
    seconds = {"projection": projected - started, "sort": sorted_ - projected, "raster": perf_counter() - sorted_}
    return Raster(image[..., :channels], coverage, far, seconds), splats, image


def backward(
    state: State, grad_image: ArrayLike, grad_alpha: ArrayLike, grad_depth: ArrayLike | None = None
) -> tuple[Floats32, Floats32, Floats32, Floats32]:
    """Gradients of means [N, 3], covariances [N, 6], opacities [N] and features [N, C].

    Zero where α is clamped at 0.99 and for skipped Gaussians.

    Args:
        state: from ``forward``.
        grad_image, grad_alpha, grad_depth: ∂L/∂ of the raster's images, [H, W, C], [H, W] and [H, W]; the last is
            ignored without depth in the forward pass.
    """
    wanted, wanted_alpha = floats(grad_image), floats(grad_alpha)
    check_shape("gradient of the image", wanted, (*state.coverage.shape, state.channels))
    check_shape("gradient of alpha", wanted_alpha, state.coverage.shape)
    if state.image.shape[2] > state.channels:
        height, width = state.coverage.shape
        depth = np.zeros((height, width), np.float32) if grad_depth is None else floats(grad_depth)
        check_shape("gradient of the depth", depth, (height, width))
        wanted = np.concatenate([wanted, depth[..., None]], axis=2)
    splats = state.splats
    slots = blend_backward(splats, state.image, state.coverage, wanted, wanted_alpha, get_num_threads())
    arrays = state.means, state.covariances, state.opacities
    grads: tuple[Floats32, Floats32, Floats32, Floats32] = project_backward(
        *arrays, state.channels, state.view, splats.slot_starts, slots
    )
    return grads
