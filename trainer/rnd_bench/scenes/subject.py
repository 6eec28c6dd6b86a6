"""The avatar under test, its body and capture, and how rows pose and picture it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from rnd_runtime.avatar.avatar import Avatar
from rnd_runtime.capture.body import Body
from rnd_runtime.capture.capture import Capture
from rnd_runtime.core.camera import Camera
from rnd_runtime.core.gaussians import Gaussians
from rnd_runtime.core.images import to_bytes
from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_runtime.motion.motion import Motion, save_motion
from rnd_runtime.motion.skeleton import bone_transforms
from rnd_runtime.posing.forearm import skinning_bones
from rnd_runtime.posing.window import motion_window
from rnd_runtime.raster.cpu import rasterize
from rnd_runtime.raster.oracle import symmetric
from rnd_runtime.shading.light import Light
from rnd_runtime.shading.shader import Shader

from .figures import Bytes, Floats, coded
from .lights import sun_and_sky

Floats32 = NDArray[np.float32]
Angles = dict[str, tuple[float, float, float]]

FPS = 30.0
APART: Angles = {"left_hip": (0, 0, 0.35), "right_hip": (0, 0, -0.35)}
"""the rest pose with the legs apart: neighbours in it are neighbours on the skin"""
ARMS_DOWN: Angles = {"left_shoulder": (0, 0, -1.0), "right_shoulder": (0, 0, 1.0)}
EXTREMES: dict[str, Angles] = {
    "T-pose": {},
    "squat": {
        "left_hip": (-1.9, 0, 0.2),
        "right_hip": (-1.9, 0, -0.2),
        "left_knee": (2.2, 0, 0),
        "right_knee": (2.2, 0, 0),
        "spine1": (0.5, 0, 0),
        **ARMS_DOWN,
    },
    "arms up": {"left_shoulder": (0, 0, 1.2), "right_shoulder": (0, 0, -1.2)},
    "splits": {"left_hip": (0, 0, 1.2), "right_hip": (0, 0, -1.2)},
}
"""poses that an A-pose spin does not show (axis-angle, radians)"""


CROSSED: Angles = {
    "left_shoulder": (0.0, -0.9, -0.8),
    "right_shoulder": (0.0, 0.9, 0.8),
    "left_elbow": (0.0, -1.7, 0.0),
    "right_elbow": (0.0, 1.7, 0.0),
}


@dataclass(frozen=True, eq=False)
class Subject:
    """What the rows are measured on.

    Attributes:
        avatar_file: avatar.onnx. avatar: the same, read. checkpoint: the avatar.ckpt it was exported from.
        capture: pictures of the same person.
        work: a folder for files; small: seconds matter, so fewer poses and frames are tried.
        size: side of the pictures, pixels.
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
        """A sky and a sun from one side, made here: the same for everybody."""
        return sun_and_sky()

    @cached_property
    def shader(self) -> Shader:
        return Shader(self.light, "table+sun")

    def few(self, small: int, full: int) -> int:
        """A number of tries: the first for a test of seconds, the second for the table."""
        return small if self.small else full

    # -- poses ---------------------------------------------------------------------------------------------

    def motion(self, *frames: Angles, fps: float = FPS) -> Motion:
        """One frame for each set of joint angles, the root at the origin."""
        names = self.avatar.skeleton.names
        angles = np.zeros((len(frames), len(names), 3))
        for frame, pose in enumerate(frames):
            for name, vector in pose.items():
                angles[frame, names.index(name)] = vector
        return self.moving(angles, fps)

    def moving(self, angles: ArrayLike, fps: float = FPS) -> Motion:
        """Joint angles [F, J, 3] as a motion on the spot."""
        rotations = axis_angle_to_matrix(angles)
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
        return self.moving(angles, fps)

    def save_motion(self, path: Path) -> None:
        """A motion of two frames with the arms down, as a file."""
        save_motion(path, self.motion(ARMS_DOWN, ARMS_DOWN))

    @cached_property
    def rest(self) -> Gaussians:
        """The avatar in its rest pose."""
        return self.avatar.pose(self.motion({}), 0.0)

    @cached_property
    def template_weights(self) -> Floats32:
        """The template's skinning weights [N, J]: plain blend skinning uses them in every pose."""
        logs = self._of_graph("log_template", self.motion({}), 0.0)
        weights = np.exp(logs - logs.max(axis=1, keepdims=True))
        return weights / weights.sum(axis=1, keepdims=True)

    def weights(self, motion: Motion, time: float) -> Floats32:
        """Skinning weights [N, J] at a moment."""
        return self._of_graph("skinning_weights", motion, time)

    def _of_graph(self, output: str, motion: Motion, time: float) -> Floats32:
        window = motion_window(motion, time, poses=self.avatar.window_poses, seconds=self.avatar.window_seconds)
        return self.avatar.run((*window, self.bones(motion, time)), (output,))[0]

    def bones(self, motion: Motion, time: float) -> Floats32:
        """What the avatar is skinned by at a moment [J, 3, 4]."""
        now = motion.at([time])
        return skinning_bones(self.avatar.skeleton, now.rotations[0], now.translations[0])

    def by_template(self, motion: Motion, time: float) -> Gaussians:
        """The baseline: the rest pose's Gaussians moved by the template's weights, normals by A_R n."""
        rest, now = self.rest, motion.at([time])
        bones = bone_transforms(self.avatar.skeleton, now.rotations[0], now.translations[0])
        blend = np.einsum("nj,jrc->nrc", self.template_weights, bones.astype(np.float64))
        linear = blend[:, :, :3]
        means = np.einsum("nrc,nc->nr", linear, rest.means) + blend[:, :, 3]
        full = symmetric(rest.covariances)
        moved = (linear @ full @ linear.transpose(0, 2, 1)).reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]]
        normals = np.einsum("nrc,nc->nr", linear, rest.normals)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
        arrays = (np.asarray(a, np.float32) for a in (means, moved, normals, bones[0, :, :3]))
        means32, covariances, normals32, root32 = arrays
        return replace(
            rest, means=means32, covariances=covariances, normals=normals32, root_rotation=np.ascontiguousarray(root32)
        )

    @cached_property
    def neighbours(self) -> NDArray[np.int64]:
        """[N, 6] nearest Gaussians on the skin, found with the legs apart."""
        means = self.avatar.pose(self.motion({**APART}), 0.0).means
        return np.asarray(cKDTree(means).query(means, k=7)[1][:, 1:], np.int64)

    # -- pictures ------------------------------------------------------------------------------------------

    def camera(self, azimuth: float = 0.0, elevation: float = 0.1, size: int | None = None) -> Camera:
        """A view of the whole body from ``azimuth`` (radians from the front, towards +X) and ``elevation``."""
        middle = np.array([0.0, float(np.mean(self.rest.means[:, 1])), 0.0])
        height = float(np.ptp(self.rest.means[:, 1]))
        way = np.array([np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth) * np.cos(elevation)])
        side = size or self.size
        return Camera.look_at(middle + 2.2 * height * way, middle, width=side, height=side, fov_y=0.6)

    def picture(self, gaussians: Gaussians, camera: Camera | None = None, shader: Shader | None = None) -> Floats:
        """What the player shows on black, as sRGB in 0…1 before rounding: [H, W, 3]."""
        return coded(self.linear(gaussians, camera, shader)[..., :3])

    def linear(self, gaussians: Gaussians, camera: Camera | None = None, shader: Shader | None = None) -> Floats32:
        """Premultiplied linear radiance and alpha [H, W, 4]."""
        camera = camera or self.camera()
        radiance = (shader or self.shader).shade(gaussians, camera.position)
        raster = rasterize(gaussians.means, gaussians.covariances, gaussians.opacities, radiance, camera, depth=False)
        return np.dstack([raster.image, raster.alpha])

    def shown(self, motion: Motion, time: float, camera: Camera | None = None) -> Floats:
        """``picture`` of the avatar at a moment."""
        return self.picture(self.avatar.pose(motion, time), camera)


def bytes_of(picture: ArrayLike) -> Bytes:
    """An sRGB picture in 0…1 as 8 bits."""
    return to_bytes(picture)
