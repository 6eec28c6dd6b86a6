"""The reference rasteriser: float64 numpy, no tiles, one Gaussian after the other.

All rasterisers are tested against it. Each line of the rule (``core.gaussians.Rasterizer``) is a public function.

Source: Kerbl et al., "3D Gaussian Splatting" (2023); Zwicker et al., "EWA Splatting" (2002).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rnd_runtime.core.arrays import Floats32
from rnd_runtime.core.camera import Camera
from rnd_runtime.core.gaussians import Raster

Floats = NDArray[np.float64]

# m, nearest depth rendered. At 1 cm a Gaussian of 8 mm fills the image; at 5 cm one of a sparse avatar covers half of
# it (stability suite, G3). 3DGS has 0.2.
NEAR = 0.1
# px² added to both variances against aliasing. 3DGS has 0.3, Mip-Splatting (Yu et al. 2024) 0.1, a pixel's box 1/12.
# It widens an opaque body, more so in small images: docs/tried.md
DILATION = 0.05
ALPHA_MIN = 1.0 / 255.0
ALPHA_MAX = 0.99
# Below 1e-4, as two Gaussians clamped at 0.99 leave exactly 1e-4
TRANSMITTANCE_MIN = 0.9999e-4
FIELD_OF_VIEW_MARGIN = 0.3  # of half the field of view beyond each border, as in gsplat


def symmetric(triangles: ArrayLike) -> Floats:
    """[N, 6] upper triangles (xx, xy, xz, yy, yz, zz) → [N, 3, 3]."""
    return np.asarray(triangles, np.float64)[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)


def camera_points(means: ArrayLike, camera: Camera) -> Floats:
    """World points [N, 3] m → camera coordinates [N, 3] m: R p + t."""
    rotation, translation = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    return np.asarray(means, np.float64) @ rotation.T + translation


def image_points(points: Floats, camera: Camera) -> Floats:
    """Camera coordinates [N, 3] → pixels [N, 2]; the centre of the top left pixel is (0.5, 0.5)."""
    focal, centre = camera.K[[0, 1], [0, 1]], camera.K[:2, 2]
    return points[:, :2] / points[:, 2:] * focal + centre


def clamped_slopes(points: Floats, camera: Camera) -> Floats:
    """x/z and y/z [N, 2], clamped to the image widened by 0.3 half fields of view on each side.

    Far outside the image the affine approximation of the projection diverges; 3DGS and gsplat clamp it too.
    """
    size, focal = np.array([camera.width, camera.height]), camera.K[[0, 1], [0, 1]]
    centre, margin = camera.K[:2, 2], FIELD_OF_VIEW_MARGIN * 0.5 * size / focal
    return np.clip(points[:, :2] / points[:, 2:], -centre / focal - margin, (size - centre) / focal + margin)


def projection_jacobians(points: Floats, camera: Camera) -> Floats:
    """∂(pixel)/∂(camera coordinates) [N, 2, 3] at the clamped direction (EWA, eq. 29 of Zwicker et al.)."""
    (fx, fy), z = camera.K[[0, 1], [0, 1]], points[:, 2]
    slopes, zero = clamped_slopes(points, camera), np.zeros(len(points))
    rows = [[fx / z, zero, -fx * slopes[:, 0] / z], [zero, fy / z, -fy * slopes[:, 1] / z]]
    return np.moveaxis(np.array(rows), 2, 0)


def image_covariances(means: ArrayLike, covariances: ArrayLike, camera: Camera) -> Floats:
    """Σ' = J W Σ Wᵀ Jᵀ + 0.05·I, [N, 2, 2] px² (eq. 5 of Kerbl et al., with another dilation)."""
    to_image = projection_jacobians(camera_points(means, camera), camera) @ camera.world_to_camera[:3, :3]
    return to_image @ symmetric(covariances) @ to_image.transpose(0, 2, 1) + DILATION * np.eye(2)


def alphas(offsets: Floats, covariance: Floats, opacity: float) -> Floats:
    """min(0.99, o·exp(−½ dᵀ Σ'⁻¹ d)) at pixel offsets d [..., 2] from the mean; 0 below 1/255."""
    distance = np.einsum("...i,ij,...j", offsets, np.linalg.inv(covariance), offsets)
    alpha = np.minimum(ALPHA_MAX, opacity * np.exp(-0.5 * distance))
    indices: Floats = np.where(alpha >= ALPHA_MIN, alpha, 0.0)
    return indices


def reach(covariance: Floats, opacity: float) -> Floats:
    """Half the width and height [2] px of the box around the ellipse α = 1/255."""
    half: Floats = np.sqrt(2.0 * np.log(opacity / ALPHA_MIN) * np.diagonal(covariance))
    return half


def drawn(
    means: ArrayLike, covariances: ArrayLike, opacities: ArrayLike, features: ArrayLike, camera: Camera
) -> NDArray[np.bool_]:
    """Mask [N] of rendered Gaussians.

    All numbers finite, depth at least NEAR, opacity at least 1/255, and a non-zero covariance with a positive definite
    projection.
    """
    rows = [np.asarray(array, np.float64) for array in (means, covariances, features)]
    opacities = np.asarray(opacities, np.float64)
    finite = np.logical_and.reduce([np.isfinite(array).all(axis=1) for array in rows]) & np.isfinite(opacities)
    finite &= (np.trace(symmetric(covariances), axis1=1, axis2=2) > 0) & (opacities >= ALPHA_MIN)
    with np.errstate(all="ignore"):  # of rows that are not finite
        in_front = camera_points(means, camera)[:, 2] >= NEAR
        flat = image_covariances(means, covariances, camera)
        definite = (flat[:, 0, 0] > 0) & (flat[:, 1, 1] > 0) & (np.linalg.det(flat) > 0)
    indices: NDArray[np.bool_] = finite & in_front & definite
    return indices


def front_to_back(depths: Floats) -> NDArray[np.intp]:
    """Indices by depth, equal depths by index."""
    return np.argsort(depths, kind="stable")


def blend(transmittance: Floats, alpha: Floats) -> tuple[Floats, Floats]:
    """One blending step: weights T·α and the remaining transmittance T·(1 − α).

    A pixel is finished (negative transmittance) before the Gaussian that would take it below 1e-4.
    """
    left = transmittance * (1.0 - alpha)
    finished = (transmittance < 0) | (left < TRANSMITTANCE_MIN)
    return np.where(finished, 0.0, transmittance * alpha), np.where(finished, -1.0, left)


def rasterize(
    means: Floats32,
    covariances: Floats32,
    opacities: Floats32,
    features: Floats32,
    camera: Camera,
    *,
    depth: bool = True,
) -> Raster:
    """Splat N Gaussians; shapes as ``core.gaussians.Rasterizer``, results in float64.

    Each Gaussian is evaluated at every pixel of the box outside of which its α is below 1/255.
    """
    indices = drawn(means, covariances, opacities, features, camera)
    points = camera_points(means[indices], camera)
    pixels, shapes = image_points(points, camera), image_covariances(means[indices], covariances[indices], camera)
    peaks = opacities[indices].astype(np.float64)
    attributes = np.concatenate([features[indices], np.ones((len(points), 1)), points[:, 2:]], axis=1)
    size = np.array([camera.width, camera.height])
    image = np.zeros((camera.height, camera.width, attributes.shape[1]))
    transmittance = np.ones((camera.height, camera.width))
    for i in front_to_back(points[:, 2]):
        half = reach(shapes[i], peaks[i])
        x0, y0 = np.clip(np.floor(pixels[i] - half - 1), 0, size).astype(int)
        x1, y1 = np.clip(np.ceil(pixels[i] + half + 1), 0, size).astype(int)
        if x0 == x1 or y0 == y1:
            continue
        box = np.s_[y0:y1, x0:x1]
        centres = np.stack(np.meshgrid(np.arange(x0, x1) + 0.5, np.arange(y0, y1) + 0.5), axis=-1)
        alpha = alphas(centres - pixels[i], shapes[i], peaks[i])
        weights, transmittance[box] = blend(transmittance[box], alpha)
        image[box] += weights[..., None] * attributes[i]
    far = image[..., -1] if depth else np.zeros_like(image[..., -1])
    return Raster(image[..., :-2], image[..., -2], far)  # type: ignore[arg-type]
