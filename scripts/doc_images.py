"""Renders README's first image and those of docs/method.md: python scripts/doc_images.py"""

from __future__ import annotations

import colorsys
import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from rnd_runtime.avatar.avatar import Avatar
from rnd_runtime.core.camera import Camera
from rnd_runtime.core.images import write_image
from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_runtime.motion.motion import Motion, load_motion
from rnd_runtime.motion.skeleton import bone_transforms
from rnd_runtime.playback.aov import aov_image
from rnd_runtime.playback.frame import FrameRenderer, PosedAvatar
from rnd_runtime.playback.framing import CameraOptions, frame_motion, front_path, orbit_path
from rnd_runtime.raster.cpu import rasterize
from rnd_runtime.shading.files.load import load_light
from rnd_runtime.shading.light import Light
from rnd_viewer.inputs.background import Backdrop, Background

ROOT = Path(__file__).parent.parent
SIDE, TIME_S = 400, 0.55
CYCLE_S = 1.1  # of the walk
AOVS = ("albedo", "normal", "roughness", "visibility")


def main() -> None:
    """Write assets/bench/demo.png and docs/images/*.png."""
    avatar = Avatar.load(ROOT / "assets/avatar.onnx")
    walk = load_motion(ROOT / "assets/walk.npz", avatar.skeleton)
    sky = load_light(ROOT / "assets/sky.exr")
    _strip(avatar, walk, sky)
    moment = walk.at([TIME_S])
    camera = front_path(frame_motion(avatar.skeleton, moment), CameraOptions(SIDE, SIDE))(0, 0.0)

    frame = FrameRenderer(avatar, sky).render(walk, TIME_S, camera, aovs=AOVS)
    tiles = [frame.srgb]
    for name in AOVS:
        tile = aov_image(name, frame.aovs[name], frame.alpha)
        tiles.append(np.broadcast_to(tile, (SIDE, SIDE, 3)))
    _write("materials.png", tiles)

    learned = Light(avatar.trained_light)
    lights = [learned, *(replace(sky, yaw=math.radians(yaw)) for yaw in (0, 120, 240))]
    _write("relight.png", [FrameRenderer(avatar, x).render(walk, TIME_S, camera).srgb for x in lights])

    rest = Motion(np.tile(np.eye(3), (1, len(avatar.skeleton), 1, 1)), np.zeros((1, 3)), 30, avatar.skeleton.names)
    tiles = []
    for motion, time_s in ((rest, 0.0), (walk, TIME_S)):
        view = front_path(frame_motion(avatar.skeleton, motion.at([time_s])), CameraOptions(SIDE, SIDE))
        tiles.append(_weights(avatar, motion, time_s, view(0, 0.0)))
    _write("weights.png", tiles)
    _forearm(avatar, rest, sky)


def _strip(avatar: Avatar, walk: Motion, sky: Light) -> None:
    """Six moments of one step cycle, each seen from another side and under the sun of another hour."""
    orbit = orbit_path(frame_motion(avatar.skeleton, walk), CameraOptions(240, 384), seconds=1.0)
    tiles = []
    for k in range(6):
        light = replace(sky, yaw=math.radians(50 * k - 20))
        camera = orbit(0, (k - 2) / 6)
        frame = FrameRenderer(avatar, light, camera).render(walk, TIME_S + CYCLE_S * k / 6)
        tiles.append(Backdrop(Background("hdr")).behind(frame, camera, light).srgb)
    write_image(ROOT / "assets/bench/demo.png", np.ascontiguousarray(np.concatenate(tiles, axis=1)))


def _weights(avatar: Avatar, motion: Motion, time_s: float, camera) -> np.ndarray:
    """Skinning weights as colours: each joint has its own, a Gaussian the mixture of its joints'."""
    from rnd_runtime.posing.forearm import skinning_bones
    from rnd_runtime.posing.window import motion_window

    gaussians = avatar.pose(motion, time_s)
    now = motion.at([time_s])
    bones = skinning_bones(avatar.skeleton, now.rotations[0], now.translations[0])
    window = motion_window(motion, time_s, poses=avatar.window_poses, seconds=avatar.window_seconds)
    (weights,) = avatar.run((*window, bones), ["skinning_weights"])
    joints = weights.shape[1]
    palette = np.array([colorsys.hsv_to_rgb(0.381966 * k % 1, 0.75, 0.95) for k in range(joints)])
    light = 0.35 + 0.65 * np.maximum(gaussians.normals @ np.array([0.3, 0.5, 0.81], np.float32), 0)
    colours = np.ascontiguousarray(weights @ palette * light[:, None], np.float32)
    raster = rasterize(gaussians.means, gaussians.covariances, gaussians.opacities, colours, camera)
    return (255 * raster.image.clip(0, 1)).astype(np.uint8)


def _forearm(avatar: Avatar, rest: Motion, sky: Light) -> None:
    """A hand at rest, turned by 120° with all of it at the wrist, and with the forearm taking half."""
    elbow, wrist = (avatar.skeleton.names.index(f"left_{end}") for end in ("elbow", "wrist"))
    ends = avatar.skeleton.rest_joints[[elbow, wrist]]
    axis, middle = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0]), ends.mean(0)
    turned = rest.rotations.copy()
    turned[:, wrist] = axis_angle_to_matrix(math.radians(120) * axis)
    seen = middle + 0.06 * axis
    eye = seen + np.array([0, 0.15, 1])
    camera = Camera.look_at(eye, seen, width=SIDE, height=SIDE // 2, fov_y=0.26)
    shared = avatar.encode(replace(rest, rotations=turned), 0.0)
    alone = shared._replace(bones=bone_transforms(avatar.skeleton, turned[0], np.zeros(3)))
    tiles = []
    for encoded in (avatar.encode(rest, 0.0), alone, shared):
        posed = PosedAvatar(avatar.posed(encoded), np.eye(4), avatar.joints(encoded))
        tiles.append(FrameRenderer(avatar, sky, camera, cull=-1).draw(posed).srgb)
    _write("forearm.png", tiles)


def _write(name: str, tiles: list[np.ndarray]) -> None:
    """The tiles side by side, cropped to what is not black in any of them."""
    stack = np.stack(tiles)
    columns = np.flatnonzero(stack.max(axis=(0, 1, 3)) > 8)
    rows = np.flatnonzero(stack.max(axis=(0, 2, 3)) > 8)
    cut = stack[:, rows[0] : rows[-1] + 1, max(columns[0] - 12, 0) : columns[-1] + 13]
    write_image(ROOT / "docs/images" / name, np.ascontiguousarray(np.concatenate(list(cut), axis=1)))


if __name__ == "__main__":
    main()
