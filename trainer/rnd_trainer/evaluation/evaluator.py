"""Rendering of a model by the runtime's shading and rasteriser, as in playback."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rnd_runtime.core.camera import Camera, Floats
from rnd_runtime.core.gaussians import Gaussians
from rnd_runtime.motion.skeleton import taken_along
from rnd_runtime.raster.cpu import rasterize
from rnd_runtime.raster.in_view import in_view
from rnd_runtime.raster.outline import sharpened
from rnd_runtime.shading.shader import Shader
from rnd_trainer.model.encoders import SH_DC_OF_ONE
from rnd_trainer.model.model import AvatarModel, PosedGaussians, PoseInput
from rnd_trainer.render.shading import view_visibility


@torch.no_grad()
def to_gaussians(posed: PosedGaussians, pose: PoseInput) -> Gaussians:
    """Posed Gaussians as the runtime's arrays."""
    static = posed.attributes
    tensors = (
        posed.means,
        posed.covariances,
        static.opacity,
        posed.normals,
        static.albedo,
        static.roughness,
        posed.visibility,
        pose.bones[0, :, :3],
    )
    return Gaussians(*(np.ascontiguousarray(t.cpu().numpy(), np.float32) for t in tensors))


@dataclass
class Rendered:
    """Rendered image as in playback, without background; premultiplied by ``alpha``."""

    image: Tensor  # [H, W, 3] linear radiance
    normals: Tensor  # [H, W, 3] camera axes
    albedo: Tensor  # [H, W, 3] linear
    alpha: Tensor  # [H, W]


@torch.no_grad()
def render_runtime(
    model: AvatarModel,
    pose: PoseInput,
    camera: Camera,
    shader: Shader | None,
    albedo_scale: Tensor | None = None,
    cull: float | None = None,
) -> Rendered:
    """Pose, shade and splat ``model``.

    Args:
        shader: with the light; None: plain colours.
        albedo_scale: [3] factor on the albedo.
        cull: as of ``rnd_runtime.playback.frame.FrameRenderer``.
    """
    pose, root = _in_root_frame(pose)
    camera = camera.in_frame(root)
    posed = model(pose)
    gaussians = to_gaussians(posed, pose)
    if albedo_scale is not None:
        gaussians = replace(gaussians, albedo=gaussians.albedo * albedo_scale.numpy())
    radiance = posed.attributes.colour.cpu().numpy()
    if shader is not None:
        radiance = _shade(model, gaussians, posed, pose, camera, shader.in_frame(root[:3, :3]))
    normals = gaussians.normals @ camera.world_to_camera[:3, :3].T.astype(np.float32)
    features = np.ascontiguousarray(np.concatenate([radiance, normals, gaussians.albedo], axis=1), np.float32)
    splats = gaussians.means, gaussians.covariances, gaussians.opacities
    visible = None if cull is None else in_view(*splats, camera, normals=gaussians.normals, cull=cull)
    raster = sharpened(rasterize(*splats, features, camera, visible=visible))
    image, normals_image, albedo = (torch.from_numpy(x) for x in np.split(raster.image, [3, 6], axis=2))
    return Rendered(image, normals_image, albedo, torch.from_numpy(raster.alpha))


def _in_root_frame(pose: PoseInput) -> tuple[PoseInput, Floats]:
    """``pose`` in the root's frame, as in playback, and the transform [4, 4] from that frame to the world."""
    bones = pose.bones.detach().cpu().numpy()
    root = np.vstack([bones[0].astype(np.float64), [0, 0, 0, 1]])
    local = taken_along(bones, np.linalg.inv(root))
    return replace(pose, bones=torch.from_numpy(local).to(pose.bones)), root


def _shade(
    model: AvatarModel, gaussians: Gaussians, posed: PosedGaussians, pose: PoseInput, camera: Camera, shader: Shader
) -> NDArray[np.float32]:
    """Radiance [N, 3]; with ``visibility="none"`` without shadows, with ``"paper"`` times the view's visibility."""
    kind = model.config.visibility
    if kind == "pose":
        return shader.shade(gaussians, camera.position)
    unoccluded = np.zeros_like(gaussians.visibility)
    unoccluded[:, 0] = SH_DC_OF_ONE
    sunlit = np.ones((len(unoccluded), len(shader.directional)), np.float32)
    radiance = shader.shade(replace(gaussians, visibility=unoccluded), camera.position, sunlit=sunlit)
    if kind == "paper":
        eye = torch.as_tensor(camera.position, dtype=torch.float32, device=posed.means.device)
        view = torch.nn.functional.normalize(eye - posed.means, dim=-1)
        radiance = radiance * view_visibility(posed.visibility, view, pose.bones[0, :, :3]).cpu().numpy()
    return radiance
