"""What it costs that a player projects, sorts and blends in three calls, with shading between, and not in one."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numba import get_num_threads, njit
from torch import Tensor

from rnd_runtime._raster_blend import blend
from rnd_runtime._raster_project import pinhole, project
from rnd_runtime._raster_tiles import Splats, sort_into_tiles
from rnd_runtime.camera import Camera
from rnd_runtime.raster_cpu import backward, forward

HIDDEN = 0.01
"""of one pixel; of trained Gaussians 3 % add nothing at all, 28 % less than this"""


@njit(nogil=True, cache=True, error_model="numpy")
def _splat(means, covariances, opacities, features, view, threads):
    centers, shapes, boxes, attributes, depths, starts = project(
        means, covariances, opacities, features, view, False
    )
    tile_starts, gaussians, slots = sort_into_tiles(
        boxes, depths, starts, (view.width, view.height), threads, False
    )
    splats = Splats(centers, shapes, attributes, starts, tile_starts, gaussians, slots)
    return blend(splats, view.width, view.height, threads, False)


def three_calls(*arguments: Any) -> tuple[Tensor, Tensor, None]:
    """As a player draws: each kernel called from Python. Arguments of :func:`rnd_trainer.raster.rasterize`."""
    arrays, camera = _arrays(arguments)
    view, threads = pinhole(camera), get_num_threads()
    centers, shapes, boxes, attributes, depths, starts = project(*arrays, view, False)
    pairs = sort_into_tiles(boxes, depths, starts, (camera.width, camera.height), threads, False)
    splats = Splats(centers, shapes, attributes, starts, *pairs)
    return _pictures(blend(splats, camera.width, camera.height, threads, False))


def one_call(*arguments: Any) -> tuple[Tensor, Tensor, None]:
    """The same three kernels within one compiled function."""
    arrays, camera = _arrays(arguments)
    return _pictures(_splat(*arrays, pinhole(camera), get_num_threads()))


def showing(means: Any, covariances: Any, opacities: Any, features: Any, camera: Camera) -> Any:
    """[N] the Gaussians that add more than HIDDEN to the picture: those that others hide do not.

    Arguments of :func:`rnd_runtime.raster_cpu.rasterize`. What a Gaussian adds is what the picture's sum gains by its
    feature.
    """
    raster, state = forward(means, covariances, opacities, features, camera, depth=False)
    weights = backward(state, np.ones_like(raster.image), np.zeros_like(raster.alpha))[3]
    return weights[:, 0] > HIDDEN


def _arrays(arguments: tuple[Any, ...]) -> tuple[list[Any], Camera]:
    *tensors, camera = arguments
    return [tensor.numpy() for tensor in tensors], camera


def _pictures(pair: tuple[Any, Any]) -> tuple[Tensor, Tensor, None]:
    image, alpha = pair
    return torch.from_numpy(image), torch.from_numpy(alpha), None
