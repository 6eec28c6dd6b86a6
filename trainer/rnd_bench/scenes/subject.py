"""The avatar under test, its body and capture, and how the stability rows pose and render it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from rnd_runtime.avatar.avatar import Avatar
from rnd_runtime.capture.body import Body
from rnd_runtime.capture.capture import Capture
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

from .lights import sun_and_sky
from .poses import APART, ARMS_DOWN, FPS, Angles
from .psnr import Floats, srgb

Floats32 = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Subject:
    """What the rows are measured on.

    Attributes:
        avatar_file: avatar.onnx. avatar: the same, read. checkpoint: the avatar.ckpt it was exported from.
        capture: images of the same person.
        work: a folder for files; small: seconds matter, so fewer poses and frames are tried.
        size: side of the images, pixels.
    """

    avatar_file: Path
    checkpoint: Path
    capture: Capture
    work: Path
    small: bool
    size: int
    avatar: Avatar = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "avatar", Avatar.load(self.avatar_file))

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
        """A number of tries: the first for a test of seconds, the second for the table."""
        return small if self.small else full

    def motion(self, *frames: Angles, fps: float = FPS) -> Motion:
        """One frame for each set of joint angles, the root at the origin."""
        names = self.avatar.skeleton.names
        angles = np.zeros((len(frames), len(names), 3))
        for frame, pose in enumerate(frames):
            for name, vector in pose.items():
                angles[frame, names.index(name)] = vector
        return self.motion_of(axis_angle_to_matrix(angles), fps)

    def motion_of(self, rotations: Floats, fps: float = FPS) -> Motion:
        """Joint rotations [F, J, 3, 3] as a motion on the spot."""
        return Motion(rotations, np.zeros((len(rotations), 3)), fps, self.avatar.skeleton.names)

    def walk(self, seconds: float, fps: float = FPS) -> Motion:
        """A smooth dance of every joint but the root; the same function of time at any frame rate."""
        count = len(self.avatar.skeleton)
        rng = np.random.default_rng(5)
        amplitude = rng.uniform(0.1, 0.35, (count, 3))
        rate, phase = rng.uniform(0.5, 1.2, (count, 3)), rng.uniform(0, 2 * np.pi, (count, 3))
        time = np.arange(int(np.floor(seconds * fps + 1e-9)) + 1)[:, None, None] / fps
        angles = amplitude * np.sin(2 * np.pi * rate * time + phase)
        angles[:, 0] = 0
        return self.motion_of(axis_angle_to_matrix(angles), fps)

    @cached_property
    def still_file(self) -> Path:
        """A motion of two frames with the arms down, as a file."""
        save_motion(self.work / "still.npz", self.motion(ARMS_DOWN, ARMS_DOWN))
        return self.work / "still.npz"

    @cached_property
    def rest(self) -> Gaussians:
        """The avatar in its rest pose."""
        return self.avatar.pose(self.motion({}), 0.0)

    def weights(self, motion: Motion, time: float) -> Floats32:
        """Skinning weights [N, J] at a moment."""
        return self._of_graph("skinning_weights", motion, time)

    def _of_graph(self, output: str, motion: Motion, time: float) -> Floats32:
        window = motion_window(motion, time, poses=self.avatar.window_poses, seconds=self.avatar.window_seconds)
        return self.avatar.run((*window, self.bones(motion, time)), (output,))[0]

    def bones(self, motion: Motion, time: float) -> Floats32:
        """The transforms [J, 3, 4] that skin the avatar at a moment."""
        now = motion.at([time])
        return skinning_bones(self.avatar.skeleton, now.rotations[0], now.translations[0])

    @cached_property
    def template_weights(self) -> Floats32:
        """The template's skinning weights [N, J], which plain blend skinning uses in every pose."""
        logs = self._of_graph("log_template", self.motion({}), 0.0)
        weights = np.exp(logs - logs.max(axis=1, keepdims=True))
        return weights / weights.sum(axis=1, keepdims=True)

    def by_template(self, motion: Motion, time: float) -> Gaussians:
        """The baseline: the rest pose's Gaussians moved by the template's weights, normals by A_R n."""
        rest, now = self.rest, motion.at([time])
        bones = bone_transforms(self.avatar.skeleton, now.rotations[0], now.translations[0])
        blend = np.einsum("nj,jrc->nrc", self.template_weights, bones.astype(np.float64))
        linear = blend[:, :, :3]
        means = np.einsum("nrc,nc->nr", linear, rest.means) + blend[:, :, 3]
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
        """[N, 6] nearest Gaussians on the skin, found with the legs apart."""
        means = self.avatar.pose(self.motion(APART), 0.0).means
        return np.asarray(cKDTree(means).query(means, k=7)[1][:, 1:], np.int64)

    def camera(self, azimuth: float = 0.0, elevation: float = 0.1, size: int | None = None) -> Camera:
        """A view of the whole body from ``azimuth`` (radians from the front, towards +X) and ``elevation``."""
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
        """What the player shows on black, as sRGB in 0…1 before rounding: [H, W, 3]."""
        return srgb(self.radiance(gaussians, camera, shader)[..., :3])

    def image_at(self, motion: Motion, time: float, camera: Camera | None = None) -> Floats:
        """``image`` of the avatar at a moment."""
        return self.image(self.avatar.pose(motion, time), camera)
