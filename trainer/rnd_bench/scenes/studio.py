"""A synthetic capture of a template body by our own runtime: exact, made in seconds, lit from one side."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from rnd_runtime.capture.body import Body
from rnd_runtime.capture.capture import Capture, CaptureLight, Frame, load_capture, save_capture
from rnd_runtime.core.camera import Camera
from rnd_runtime.core.gaussians import Gaussians
from rnd_runtime.core.images import linear_to_srgb, to_bytes, write_image
from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_runtime.core.sh import SH_COUNT
from rnd_runtime.motion.motion import Motion
from rnd_runtime.motion.skeleton import bone_transforms
from rnd_runtime.raster.cpu import rasterize
from rnd_runtime.shading.shader import Shader
from rnd_trainer.model.template import sample_template

from .lights import sun_and_sky
from .poses import ARMS_DOWN, CROSSED, EXTREMES, FPS, Angles

POINTS = 6000
HELD_OUT = (*EXTREMES.values(), CROSSED)  # poses of the split novel_pose
STRIPES = 25.0
"""rad/m of the painted stripes, light and dark: with equal ones, albedo error is only where light falls (L12)"""


def write_studio(folder: Path, body: Body, *, size: int, frames: int) -> Capture:
    """Render ``body``: an A-pose spin in sunlight to train on, the extreme poses, a side view and another light."""
    lights = {"sun": sun_and_sky(64), "evening": sun_and_sky(64, sun=(-0.9, 0.3, 0.2), radiance=500.0)}
    for name, light in lights.items():
        write_image(folder / "lights" / f"{name}.exr", light.radiance)
    spin = [{**ARMS_DOWN, body.skeleton.names[0]: (0.0, 2 * np.pi * k / frames, 0.0)} for k in range(frames)]
    motion = _motion(body, [*spin, *HELD_OUT])
    front = Camera.look_at([0, 1.0, 3.3], [0, 0.95, 0], width=size, height=size, fov_y=0.7)
    side = Camera.look_at([3.2, 1.2, 0.4], [0, 0.95, 0], width=size, height=size, fov_y=0.7)
    shaders = {name: Shader(light, "table+sun") for name, light in lights.items()}
    film = _Film(folder, body, motion, {"front": front, "side": side}, shaders)
    records = [film.shoot(k, "front", "sun", "train") for k in range(frames)]
    records += [film.shoot(k, "side", "sun", "novel_view") for k in range(0, frames, max(1, frames // 2))]
    records += [film.shoot(frames + k, "front", "sun", "novel_pose") for k in range(len(HELD_OUT))]
    records += [film.shoot(k, "front", "evening", "relight") for k in range(0, frames, max(1, frames // 2))]
    entries = {name: CaptureLight(f"lights/{name}.exr") for name in lights}
    save_capture(Capture(folder, film.cameras, entries, body, motion, tuple(records)))
    return load_capture(folder)


def _motion(body: Body, poses: list[Angles]) -> Motion:
    angles = np.zeros((len(poses), len(body.skeleton), 3))
    for frame, pose in enumerate(poses):
        for name, vector in pose.items():
            angles[frame, body.skeleton.names.index(name)] = vector
    return Motion(axis_angle_to_matrix(angles), np.zeros((len(poses), 3)), FPS, body.skeleton.names)


class _Film:
    """The painted body, its cameras and lights."""

    def __init__(
        self, folder: Path, body: Body, motion: Motion, cameras: dict[str, Camera], shaders: dict[str, Shader]
    ) -> None:
        self.folder, self.body, self.motion, self.cameras, self.shaders = (folder, body, motion, cameras, shaders)
        template = sample_template(body, POINTS, 64, seed=3)
        self.points, self.normals, self.weights = template.points, template.normals, template.weights
        stripes = 0.45 + 0.25 * np.sign(np.sin(STRIPES * self.points[:, 1:2]))
        self.albedo = np.concatenate([stripes, 0.4 + 0 * stripes, 0.6 * stripes], axis=1).astype(np.float32)
        visibility = np.zeros((POINTS, SH_COUNT), np.float32)
        visibility[:, 0] = np.sqrt(4 * np.pi)
        covariances = np.tile(np.array([1, 0, 0, 1, 0, 1]) * (0.55 * template.spacing) ** 2, (POINTS, 1))
        self.still = Gaussians(
            self.points.astype(np.float32),
            covariances.astype(np.float32),
            np.full(POINTS, 0.99, np.float32),
            self.normals.astype(np.float32),
            self.albedo,
            np.full(POINTS, 0.9, np.float32),
            visibility,
            np.eye(3, dtype=np.float32),
        )

    def shoot(self, frame: int, camera_name: str, light: str, split: str) -> Frame:
        """Write the images of one frame."""
        camera = self.cameras[camera_name]
        bones = bone_transforms(self.body.skeleton, self.motion.rotations[frame], np.zeros(3)).astype(np.float64)
        blend = np.einsum("nj,jrc->nrc", self.weights, bones)
        means = np.einsum("nrc,nc->nr", blend[:, :, :3], self.points) + blend[:, :, 3]
        normals = np.einsum("nrc,nc->nr", np.linalg.pinv(blend[:, :, :3]).transpose(0, 2, 1), self.normals)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
        posed = replace(
            self.still,
            means=means.astype(np.float32),
            normals=normals.astype(np.float32),
            root_rotation=np.ascontiguousarray(bones[0, :, :3], np.float32),
        )
        radiance = self.shaders[light].shade(posed, camera.position)
        seen = normals @ camera.world_to_camera[:3, :3].T
        features = np.concatenate([radiance, self.albedo, seen], axis=1).astype(np.float32)
        raster = rasterize(posed.means, posed.covariances, posed.opacities, features, camera)
        name = f"{light}_{camera_name}_{frame:03d}.png"
        unit = _seen_normals(raster.image[..., 6:], raster.alpha)
        images = {
            "images": to_bytes(linear_to_srgb(raster.image[..., :3])),
            "masks": to_bytes(raster.alpha),
            "normals": to_bytes(unit),
            "albedo": to_bytes(linear_to_srgb(raster.image[..., 3:6])),
        }
        for kind, pixels in images.items():
            write_image(self.folder / kind / name, pixels)
        return Frame(
            image=f"images/{name}",
            mask=f"masks/{name}",
            normal=f"normals/{name}",
            albedo=f"albedo/{name}",
            camera=camera_name,
            frame=frame,
            split=split,  # type: ignore[arg-type]
            light=light,
        )


def _seen_normals(blended: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Blended normals [H, W, 3] as (n + 1)/2, black where nothing is seen."""
    length = np.linalg.norm(blended, axis=-1, keepdims=True)
    unit = blended / np.maximum(length, 1e-6)
    return np.where(alpha[..., None] > 0.05, (unit + 1) / 2, 0)
