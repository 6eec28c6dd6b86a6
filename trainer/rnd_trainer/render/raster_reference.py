"""Reference rasteriser in torch: 16-pixel tiles, gradients by autograd, any dtype and device.

The gradient oracle of the numba kernel, and a baseline of the benchmark. The rule is that of
``rnd_runtime.core.gaussians.Rasterizer``; comments name functions of ``rnd_runtime.raster.oracle``.
"""

from __future__ import annotations

import torch
from torch import Tensor

from rnd_runtime.core.camera import Camera
from rnd_runtime.raster import oracle

TILE = 16  # pixels


def rasterize(
    means: Tensor,  # [N, 3] m, world
    covariances: Tensor,  # [N, 6] m², world
    opacities: Tensor,  # [N]
    features: Tensor,  # [N, C]
    camera: Camera,
) -> tuple[Tensor, Tensor, Tensor]:
    """Image [H, W, C], alpha [H, W] and depth [H, W], premultiplied.

    Gradients are zero where α is clamped at 0.99 and for culled Gaussians; a clamped x/z or y/z is constant.
    """
    m, c, o, f = (tensor.detach().cpu().numpy() for tensor in (means, covariances, opacities, features))
    visible = torch.from_numpy(oracle.drawn(m, c, o, f, camera)).to(means.device)
    points, pixels, shapes = project(means[visible], covariances[visible], camera)
    order = torch.argsort(points[:, 2], stable=True)
    opacities = opacities[visible][order]
    points, pixels, shapes = points[order], pixels[order], shapes[order]
    attributes = torch.cat([features[visible][order], torch.ones_like(points[:, :1]), points[:, 2:]], dim=1)
    with torch.no_grad():  # bounding box of the ellipse α = 1/255
        variances = torch.diagonal(shapes, dim1=1, dim2=2)
        half = torch.sqrt(2 * torch.log(opacities / oracle.ALPHA_MIN)[:, None] * variances) + 1
        low, high = pixels - half, pixels + half
    inverse = torch.linalg.inv(shapes)

    rows = []
    for y in range(0, camera.height, TILE):
        band = ((high[:, 1] > y) & (low[:, 1] < y + TILE)).nonzero()[:, 0]
        tiles = []
        for x in range(0, camera.width, TILE):
            chosen = band[(high[band, 0] > x) & (low[band, 0] < x + TILE)]
            size = min(TILE, camera.height - y), min(TILE, camera.width - x)
            tile = blend_tile((x, y), size, pixels[chosen], inverse[chosen], opacities[chosen], attributes[chosen])
            tiles.append(tile)
        rows.append(torch.cat(tiles, dim=1))
    rendered = torch.cat(rows, dim=0)
    return rendered[..., :-2], rendered[..., -2], rendered[..., -1]


def project(means: Tensor, covariances: Tensor, camera: Camera) -> tuple[Tensor, Tensor, Tensor]:
    """Camera coordinates [N, 3] m, pixels [N, 2] and dilated image covariances [N, 2, 2] px²."""

    def constant(values: object) -> Tensor:
        return torch.as_tensor(values, dtype=means.dtype, device=means.device)

    world_to_camera = constant(camera.world_to_camera)
    focal, centre = constant(camera.K[[0, 1], [0, 1]]), constant(camera.K[:2, 2])
    size = constant([camera.width, camera.height])
    rotation = world_to_camera[:3, :3]

    points = means @ rotation.T + world_to_camera[:3, 3]  # camera_points
    slopes = points[:, :2] / points[:, 2:]
    pixels = slopes * focal + centre  # image_points
    margin = oracle.FIELD_OF_VIEW_MARGIN * 0.5 * size / focal  # clamped_slopes
    slopes = torch.clamp(slopes, -centre / focal - margin, (size - centre) / focal + margin)
    scale = focal / points[:, 2:]  # projection_jacobians
    jacobians = torch.cat([torch.diag_embed(scale), (-slopes * scale)[..., None]], dim=2)
    to_image = jacobians @ rotation
    symmetric = covariances[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
    shapes = to_image @ symmetric @ to_image.mT  # image_covariances
    return points, pixels, shapes + oracle.DILATION * torch.eye(2, dtype=means.dtype, device=means.device)


def blend_tile(
    corner: tuple[int, int],
    size: tuple[int, int],
    pixels: Tensor,  # [n, 2], front to back
    inverse: Tensor,  # [n, 2, 2]
    opacities: Tensor,  # [n]
    attributes: Tensor,  # [n, K]
) -> Tensor:
    """Tile [h, w, K] with top left corner ``corner`` (x, y)."""
    rows = torch.arange(size[0], device=pixels.device) + corner[1] + 0.5
    columns = torch.arange(size[1], device=pixels.device) + corner[0] + 0.5
    grid = torch.stack(torch.meshgrid(columns, rows, indexing="xy"), dim=-1).to(pixels.dtype)
    offsets = grid[:, :, None] - pixels  # [h, w, n, 2]
    dx, dy = offsets.unbind(-1)
    distance = inverse[:, 0, 0] * dx * dx + 2 * inverse[:, 0, 1] * dx * dy + inverse[:, 1, 1] * dy * dy
    alpha = opacities * torch.exp(-0.5 * distance)  # alphas
    alpha = torch.where(alpha >= oracle.ALPHA_MIN, alpha.clamp(max=oracle.ALPHA_MAX), 0)
    transmittance = torch.cumprod(1 - alpha, dim=-1)  # blend: behind each Gaussian
    before = torch.cat([torch.ones_like(transmittance[..., :1]), transmittance[..., :-1]], dim=-1)
    weights = torch.where(transmittance >= oracle.TRANSMITTANCE_MIN, before * alpha, 0)
    return weights @ attributes
