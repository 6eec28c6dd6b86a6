"""Differentiable rasteriser: the numba kernel on the CPU, gsplat on CUDA."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from rnd_runtime.cli.extras import install_hint
from rnd_runtime.core.camera import Camera
from rnd_runtime.core.errors import InputError
from rnd_runtime.raster import cpu as raster_cpu
from rnd_runtime.raster.oracle import DILATION, NEAR


def rasterize(
    means: Tensor,  # [N, 3] m, world
    covariances: Tensor,  # [N, 6] m², world, upper triangle (xx, xy, xz, yy, yz, zz)
    opacities: Tensor,  # [N]
    features: Tensor,  # [N, C]
    camera: Camera,
    *,
    depth: bool = False,
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Splat N Gaussians: image [H, W, C], alpha [H, W] and optionally depth [H, W] m, premultiplied float32.

    Differentiable in the four tensors. The rule is that of ``rnd_runtime.core.gaussians.Rasterizer``. On CUDA gsplat
    clamps α at 0.999, renders a covariance of zero as a dot, and sorts depths as float32.

    Raises:
        InputError: a wrong shape, or tensors on CUDA without gsplat.
    """
    if means.is_cuda:
        return _rasterize_cuda(means, covariances, opacities, features, camera, depth)
    image, alpha, depths = _CpuRasterizer.apply(means, covariances, opacities, features, camera, depth)
    return image, alpha, depths if depth else None


class _CpuRasterizer(torch.autograd.Function):
    """``rnd_runtime.raster.cpu`` for autograd."""

    @staticmethod
    def forward(
        ctx: Any, means: Tensor, covariances: Tensor, opacities: Tensor, features: Tensor, camera: Camera, depth: bool
    ) -> tuple[Tensor, Tensor, Tensor]:
        tensors = means, covariances, opacities, features
        m, c, o, f = (tensor.detach().numpy() for tensor in tensors)
        raster, ctx.state = raster_cpu.forward(m, c, o, f, camera, depth=depth)
        ctx.dtypes = [tensor.dtype for tensor in tensors]
        image, alpha, depths = (torch.from_numpy(a) for a in (raster.image, raster.alpha, raster.depth))
        if not depth:
            ctx.mark_non_differentiable(depths)
        return image, alpha, depths

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *incoming: Tensor) -> tuple[Tensor | None, ...]:
        grads = raster_cpu.backward(ctx.state, *(grad.numpy() for grad in incoming))
        return *(torch.from_numpy(grad).to(dtype) for grad, dtype in zip(grads, ctx.dtypes)), None, None


def gsplat_rasterization() -> Any:
    """gsplat's ``rasterization``; raises ``InputError`` if it cannot be imported."""
    try:
        from gsplat import rasterization
    except ImportError as error:
        raise InputError("gsplat cannot be imported", got=error, hint=install_hint("cuda")) from error
    return rasterization


def _rasterize_cuda(
    means: Tensor, covariances: Tensor, opacities: Tensor, features: Tensor, camera: Camera, depth: bool
) -> tuple[Tensor, Tensor, Tensor | None]:
    rendered, alpha, _ = gsplat_rasterization()(
        means,
        None,
        None,
        opacities,
        features,
        viewmats=torch.as_tensor(camera.world_to_camera, dtype=means.dtype, device=means.device)[None],
        Ks=torch.as_tensor(camera.K, dtype=means.dtype, device=means.device)[None],
        width=camera.width,
        height=camera.height,
        near_plane=NEAR,
        eps2d=DILATION,
        render_mode="RGB+D" if depth else "RGB",
        packed=False,
        covars=covariances[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3),
    )
    image = rendered[0, ..., : features.shape[1]]
    return image, alpha[0, ..., 0], rendered[0, ..., -1] if depth else None
