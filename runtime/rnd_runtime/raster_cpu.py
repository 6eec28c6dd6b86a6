"""The CPU rasteriser: numba, float32 with float64 projection, forward and backward, any number of channels.

The rule is :class:`rnd_runtime.gaussians.Rasterizer`'s. Besides, a Gaussian with a number that is not finite,
a covariance of trace zero or a projection that is not positive definite is not drawn and gets zero gradients.

The result does not depend on the number of threads, to the bit. Kernels compile on first use (seconds) and
are cached beside the package.
"""

from __future__ import annotations

from dataclasses import dataclass
from time import perf_counter

import numpy as np
from numba import get_num_threads
from numpy.typing import ArrayLike, NDArray

from ._raster_blend import blend, blend_backward
from ._raster_input import check_shape, checked, floats
from ._raster_project import Pinhole, pinhole, project, project_backward
from ._raster_tiles import Splats, sort_into_tiles
from .camera import Camera
from .gaussians import Floats32, Raster
from .outline import sharpened


@dataclass(frozen=True, eq=False)
class State:
    """What :func:`backward` needs of a forward pass; hold it, do not look into it."""

    means: Floats32
    covariances: Floats32
    opacities: Floats32
    view: Pinhole
    splats: Splats
    image: Floats32  # [H, W, K] features, then depth
    coverage: Floats32  # [H, W]
    channels: int


class Projected:
    """N Gaussians as a camera sees them, before anyone knows their features: which of them have to be shaded.

    Arguments as of :func:`rasterize`.

    Attributes:
        drawn: [N] the Gaussians that reach a tile of the picture; the others add nothing to it.
    """

    def __init__(
        self, means: ArrayLike, covariances: ArrayLike, opacities: ArrayLike, camera: Camera
    ) -> None:
        nothing = np.empty((len(np.asarray(means)), 0), np.float32)
        means, covariances, opacities, nothing = checked(means, covariances, opacities, nothing)
        self._arrays = means, covariances, opacities, camera
        self._centers, self._shapes, self._boxes, _, self._depths, self._slot_starts = project(
            means, covariances, opacities, nothing, pinhole(camera), False
        )
        self.drawn: NDArray[np.bool_] = np.diff(self._slot_starts) > 0

    def draw(self, features: Floats32, *, outlines: bool = False) -> Raster:
        """The picture of ``features`` [N, C], of which only rows of ``drawn`` Gaussians matter; no depth.

        With ``outlines`` they are sharp, see :mod:`.outline`.
        """
        features = floats(features)
        means, covariances, opacities, camera = self._arrays
        check_shape("features", features, (len(means), features.shape[-1]))
        if not np.isfinite(features).all():  # then who is drawn depends on it
            raster = rasterize(means, covariances, opacities, features, camera, depth=False)
            return sharpened(raster) if outlines else raster
        started = perf_counter()
        size, threads = (camera.width, camera.height), get_num_threads()
        pairs = sort_into_tiles(self._boxes, self._depths, self._slot_starts, size, threads, False)
        splats = Splats(self._centers, self._shapes, features, self._slot_starts, *pairs)
        sorted_at = perf_counter()
        image, coverage = blend(splats, camera.width, camera.height, threads, outlines)
        seconds = {"sort": sorted_at - started, "raster": perf_counter() - sorted_at}
        return Raster(image, coverage, np.zeros_like(coverage), seconds)


def rasterize(
    means: Floats32,
    covariances: Floats32,
    opacities: Floats32,
    features: Floats32,
    camera: Camera,
    *,
    depth: bool = True,
) -> Raster:
    """Splat N Gaussians.

    Args:
        means: [N, 3] m, world.
        covariances: [N, 6] m², world, upper triangle (xx, xy, xz, yy, yz, zz).
        opacities: [N].
        features: [N, C], any C.
        camera: the view.
        depth: False leaves the depth picture all zero and saves its time.

    Raises:
        InputError: an array has the wrong shape.
    """
    return forward(means, covariances, opacities, features, camera, depth=depth)[0]


def forward(
    means: Floats32,
    covariances: Floats32,
    opacities: Floats32,
    features: Floats32,
    camera: Camera,
    *,
    depth: bool = True,
) -> tuple[Raster, State]:
    """:func:`rasterize` that also returns what :func:`backward` needs.

    Without ``depth`` the depth picture is all zero and costs nothing.
    """
    means, covariances, opacities, features = checked(means, covariances, opacities, features)
    started = perf_counter()
    view = pinhole(camera)
    centers, shapes, boxes, attributes, depths, slot_starts = project(
        means, covariances, opacities, features, view, depth
    )
    size, threads = (camera.width, camera.height), get_num_threads()
    pairs = sort_into_tiles(boxes, depths, slot_starts, size, threads, True)
    splats = Splats(centers, shapes, attributes, slot_starts, *pairs)
    sorted_at = perf_counter()
    image, coverage = blend(splats, camera.width, camera.height, threads, False)
    seconds = {"projection+sort": sorted_at - started, "raster": perf_counter() - sorted_at}
    channels = features.shape[1]
    far = image[..., channels] if depth else np.zeros((camera.height, camera.width), np.float32)
    raster = Raster(image[..., :channels], coverage, far, seconds)
    return raster, State(means, covariances, opacities, view, splats, image, coverage, channels)


def backward(
    state: State, grad_image: ArrayLike, grad_alpha: ArrayLike, grad_depth: ArrayLike | None = None
) -> tuple[Floats32, Floats32, Floats32, Floats32]:
    """Gradients of means [N, 3], covariances [N, 6], opacities [N] and features [N, C].

    Args:
        state: of :func:`forward`.
        grad_image, grad_alpha, grad_depth: ∂L/∂ of the raster's pictures, [H, W, C], [H, W] and [H, W]; the
            last is ignored where the forward pass was run without depth.

    Zero where α is clamped at 0.99 and for what was not drawn.
    """
    wanted, wanted_alpha = floats(grad_image), floats(grad_alpha)
    check_shape("gradient of the picture", wanted, (*state.coverage.shape, state.channels))
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
