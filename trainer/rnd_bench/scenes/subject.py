"""The avatar under test, its body and capture, posed and rendered for the stability rows."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from rnd_runtime.avatar.avatar import Avatar
from rnd_runtime.capture.body import Body
from rnd_runtime.capture.capture import Capture, Frame, FrameImages
from rnd_runtime.core.camera import Camera
from rnd_runtime.core.gaussians import Gaussians
from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_runtime.motion.motion import Motion, save_motion
from rnd_runtime.motion.skeleton import bone_transforms
from rnd_runtime.posing.forearm import skinning_bones
from rnd_runtime.posing.window import motion_window
from rnd_runtime.raster.cpu import rasterize
from rnd_runtime.raster.oracle import symmetric
from rnd_runtime.shading.light import Light
from rnd_runtime.shading.shader import Shader
from rnd_trainer.training.data import usable

from .lights import sun_and_sky
from .poses import APART, ARMS_DOWN, FPS, Angles, motion_of_poses
from .psnr import Floats, srgb

Floats32 = NDArray[np.float32]
Numbers = NDArray[np.floating]


@dataclass(frozen=True, eq=False)
class Subject:
    """What the rows are measured on: an avatar, its checkpoint, and a capture of the same person.

    Attributes:
        small: use fewer poses and frames, so that a row takes seconds.
        size: side of the images, pixels.
    """

    avatar_file: Path
    checkpoint: Path
    capture: Capture
    work: Path
    small: bool
    size: int

    @cached_property
    def avatar(self) -> Avatar:
        return Avatar.load(self.avatar_file)

    @property
    def body(self) -> Body:
        return self.capture.body

    @cached_property
    def light(self) -> Light:
        """A sky and a sun from one side."""
        return sun_and_sky()

    @cached_property
    def shader(self) -> Shader:
        return Shader(self.light, "table+sun")

    def few(self, small: int, full: int) -> int:
        return small if self.small else full

    def motion(self, *frames: Angles, fps: float = FPS) -> Motion:
        """One frame for each pose, the root at the origin."""
        return motion_of_poses(frames, self.avatar.skeleton.names, fps)

    def motion_of(self, rotations: Floats, fps: float = FPS) -> Motion:
        """Joint rotations [F, J, 3, 3] as a motion without translation."""
        return Motion(rotations, np.zeros((len(rotations), 3)), fps, self.avatar.skeleton.names)

    def walk(self, seconds: float, fps: float = FPS) -> Motion:
        """A smooth motion of every joint but the root; the same function of time at any frame rate."""
        count = len(self.avatar.skeleton)
        rng = np.random.default_rng(5)
        amplitude = rng.uniform(0.1, 0.35, (count, 3))
        rate, phase = rng.uniform(0.5, 1.2, (count, 3)), rng.uniform(0, 2 * np.pi, (count, 3))
        time = np.arange(int(np.floor(seconds * fps + 1e-9)) + 1)[:, None, None] / fps
        angles = amplitude * np.sin(2 * np.pi * rate * time + phase)
        angles[:, 0] = 0
        return self.motion_of(axis_angle_to_matrix(angles), fps)

    def then_still(self, motion: Motion, frames: int) -> Motion:
        """``motion`` on the spot, its last pose repeated for ``frames``."""
        hold = np.repeat(motion.rotations[-1:], frames, axis=0)
        return self.motion_of(np.concatenate([motion.rotations, hold]), motion.fps)

    @cached_property
    def still_file(self) -> Path:
        """A motion of two frames with the arms down, as a file."""
        save_motion(self.work / "still.npz", self.motion(ARMS_DOWN, ARMS_DOWN))
        return self.work / "still.npz"

    @cached_property
    def rest(self) -> Gaussians:
        return self.avatar.pose(self.motion({}), 0.0)

    def weights(self, motion: Motion, time: float) -> Floats32:
        """Skinning weights [N, J] at ``time`` seconds."""
        return self._of_graph("skinning_weights", motion, time)

    def _of_graph(self, output: str, motion: Motion, time: float) -> Floats32:
        window = motion_window(motion, time, poses=self.avatar.window_poses, seconds=self.avatar.window_seconds)
        return self.avatar.run((*window, self.bones(motion, time)), (output,))[0]

    def bones(self, motion: Motion, time: float) -> Floats32:
        """Skinning transforms [J, 3, 4] at ``time`` seconds."""
        now = motion.at([time])
        return skinning_bones(self.avatar.skeleton, now.rotations[0], now.translations[0])

    @cached_property
    def template_weights(self) -> Floats32:
        """The template's skinning weights [N, J]."""
        logs = self._of_graph("log_template", self.motion({}), 0.0)
        weights = np.exp(logs - logs.max(axis=1, keepdims=True))
        return weights / weights.sum(axis=1, keepdims=True)

    def by_template(self, motion: Motion, time: float) -> Gaussians:
        """The baseline: Gaussians of the rest pose skinned by the template's weights, normals by A_R n."""
        rest, now = self.rest, motion.at([time])
        bones = bone_transforms(self.avatar.skeleton, now.rotations[0], now.translations[0])
        means, linear = blend_skinned(self.template_weights, bones, rest.means)
        moved = linear @ symmetric(rest.covariances) @ linear.transpose(0, 2, 1)
        normals = np.einsum("nrc,nc->nr", linear, rest.normals)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
        return replace(
            rest,
            means=means.astype(np.float32),
            covariances=moved.reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]].astype(np.float32),
            normals=normals.astype(np.float32),
            root_rotation=np.ascontiguousarray(bones[0, :, :3], np.float32),
        )

    @cached_property
    def neighbours(self) -> NDArray[np.int64]:
        """The six nearest Gaussians on the skin [N, 6], found with the legs apart."""
        means = self.avatar.pose(self.motion(APART), 0.0).means
        return np.asarray(cKDTree(means).query(means, k=7)[1][:, 1:], np.int64)

    def camera(self, azimuth: float = 0.0, elevation: float = 0.1, size: int | None = None) -> Camera:
        """A view of the whole body; ``azimuth`` in radians from the front towards +X, ``elevation`` in radians."""
        middle = np.array([0.0, float(np.mean(self.rest.means[:, 1])), 0.0])
        height = float(np.ptp(self.rest.means[:, 1]))
        way = np.array([np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth) * np.cos(elevation)])
        side = size or self.size
        return Camera.look_at(middle + 2.2 * height * way, middle, width=side, height=side, fov_y=0.6)

    def radiance(self, gaussians: Gaussians, camera: Camera | None = None, shader: Shader | None = None) -> Floats32:
        """Premultiplied linear radiance and alpha [H, W, 4]."""
        camera = camera or self.camera()
        radiance = (shader or self.shader).shade(gaussians, camera.position)
        raster = rasterize(gaussians.means, gaussians.covariances, gaussians.opacities, radiance, camera, depth=False)
        return np.dstack([raster.image, raster.alpha])

    def image(self, gaussians: Gaussians, camera: Camera | None = None, shader: Shader | None = None) -> Floats:
        """The image on black [H, W, 3], sRGB in 0…1 before rounding."""
        return srgb(self.radiance(gaussians, camera, shader)[..., :3])

    def image_at(self, motion: Motion, time: float) -> Floats:
        """``image`` of the avatar at ``time`` seconds."""
        return self.image(self.avatar.pose(motion, time))

    def observed(self, frames: Sequence[Frame], count: int) -> Iterator[tuple[FrameImages, Camera, float]]:
        """Images, camera and time in seconds of about ``count`` evenly chosen ``frames``, those with usable masks."""
        for frame in frames[:: max(1, len(frames) // count)]:
            images = self.capture.load_frame(frame)
            if usable(images.mask):
                yield images, self.capture.cameras[frame.camera], frame.frame / self.capture.motion.fps


def blend_skinned(weights: Numbers, bones: Numbers, points: Numbers) -> tuple[Floats, Floats]:
    """Points [N, 3] after linear blend skinning, and the blended 3×3 matrices [N, 3, 3], in float64."""
    blend = np.einsum("nj,jrc->nrc", weights, np.asarray(bones, np.float64))
    return np.einsum("nrc,nc->nr", blend[:, :, :3], points) + blend[:, :, 3], blend[:, :, :3]
