"""A synthetic capture of a template body, rendered by the runtime and lit from one side."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from rnd_runtime.capture.body import Body
from rnd_runtime.capture.capture import Capture, CaptureLight, Frame, load_capture, save_capture
from rnd_runtime.core.camera import Camera
from rnd_runtime.core.gaussians import Gaussians
from rnd_runtime.core.images import linear_to_srgb, to_bytes, write_image
from rnd_runtime.motion.skeleton import bone_transforms
from rnd_runtime.raster.cpu import rasterize
from rnd_runtime.shading.sh import SH_COUNT
from rnd_runtime.shading.shader import Shader
from rnd_trainer.model.template import sample_template

from .lights import sun_and_sky
from .poses import ARMS_DOWN, CROSSED, EXTREMES, motion_of_poses
from .subject import blend_skinned

POINTS = 6000
HELD_OUT = (*EXTREMES.values(), CROSSED)  # poses of the split novel_pose
STRIPES = 25.0  # rad/m; equal stripes would hide albedo error outside lit areas (L12)


def write_studio(folder: Path, body: Body, *, size: int, frames: int) -> Capture:
    """Render ``body``: an A-pose spin in sunlight to train on, extreme poses, a side view and another light."""
    lights = {"sun": sun_and_sky(64), "evening": sun_and_sky(64, sun=(-0.9, 0.3, 0.2), radiance=500.0)}
    for name, light in lights.items():
        write_image(folder / "lights" / f"{name}.exr", light.radiance)
    names = body.skeleton.names
    spin = [{**ARMS_DOWN, names[0]: (0.0, 2 * np.pi * k / frames, 0.0)} for k in range(frames)]
    motion = motion_of_poses([*spin, *HELD_OUT], names)
    view: dict[str, Any] = {"width": size, "height": size, "fov_y": 0.7}
    front, side = (Camera.look_at(eye, [0, 0.95, 0], **view) for eye in ([0, 1.0, 3.3], [3.2, 1.2, 0.4]))
    cameras = {"front": front, "side": side}
    shaders = {name: Shader(light, "table+sun") for name, light in lights.items()}
    painted = _Painted(body)

    def shoot(frame: int, camera: str, light: str, split: Any) -> Frame:
        name = f"{light}_{camera}_{frame:03d}.png"
        for kind, pixels in painted.images(motion.rotations[frame], cameras[camera], shaders[light]).items():
            write_image(folder / kind / name, to_bytes(pixels))
        files = {"image": f"images/{name}", "mask": f"masks/{name}", "normal": f"normals/{name}"}
        return Frame(**files, albedo=f"albedo/{name}", camera=camera, frame=frame, split=split, light=light)

    few = range(0, frames, max(1, frames // 2))
    records = [shoot(k, "front", "sun", "train") for k in range(frames)]
    records += [shoot(k, "side", "sun", "novel_view") for k in few]
    records += [shoot(frames + k, "front", "sun", "novel_pose") for k in range(len(HELD_OUT))]
    records += [shoot(k, "front", "evening", "relight") for k in few]
    entries = {name: CaptureLight(f"lights/{name}.exr") for name in lights}
    save_capture(Capture(folder, cameras, entries, body, motion, tuple(records)))
    return load_capture(folder)


class _Painted:
    """A striped body of Gaussians."""

    def __init__(self, body: Body) -> None:
        self.skeleton = body.skeleton
        self.template = template = sample_template(body, POINTS, 64, seed=3)
        stripes = 0.45 + 0.25 * np.sign(np.sin(STRIPES * template.points[:, 1:2]))
        albedo = np.concatenate([stripes, 0.4 + 0 * stripes, 0.6 * stripes], axis=1)
        visibility = np.zeros((POINTS, SH_COUNT))
        visibility[:, 0] = np.sqrt(4 * np.pi)
        covariances = np.tile(np.array([1, 0, 0, 1, 0, 1]) * (0.55 * template.spacing) ** 2, (POINTS, 1))
        opacity, roughness = np.full(POINTS, 0.99), np.full(POINTS, 0.9)
        arrays = (template.points, covariances, opacity, template.normals, albedo, roughness, visibility, np.eye(3))
        self.rest = Gaussians(*(array.astype(np.float32) for array in arrays))

    def images(self, rotations: np.ndarray, camera: Camera, shader: Shader) -> dict[str, np.ndarray]:
        """Image, mask, normals and albedo of a pose of joint rotations [J, 3, 3], values in 0…1."""
        bones = bone_transforms(self.skeleton, rotations, np.zeros(3))
        means, linear = blend_skinned(self.template.weights, bones, self.template.points)
        normals = np.einsum("nrc,nc->nr", np.linalg.pinv(linear).transpose(0, 2, 1), self.template.normals)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
        moved = {"means": means, "normals": normals, "root_rotation": bones[0, :, :3]}
        posed = replace(self.rest, **{name: np.ascontiguousarray(a, np.float32) for name, a in moved.items()})
        in_camera = normals @ camera.world_to_camera[:3, :3].T
        features = np.concatenate([shader.shade(posed, camera.position), posed.albedo, in_camera], axis=1)
        raster = rasterize(posed.means, posed.covariances, posed.opacities, features.astype(np.float32), camera)
        blended = raster.image[..., 6:]
        unit = blended / np.maximum(np.linalg.norm(blended, axis=-1, keepdims=True), 1e-6)
        return {
            "images": linear_to_srgb(raster.image[..., :3]),
            "masks": raster.alpha,
            "normals": np.where(raster.alpha[..., None] > 0.05, (unit + 1) / 2, 0),
            "albedo": linear_to_srgb(raster.image[..., 3:6]),
        }
