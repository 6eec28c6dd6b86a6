"""A tiny capture made from the embedded body by the oracle rasteriser: seconds to make, true in every number."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rnd_runtime.capture.body import Body
from rnd_runtime.capture.capture import Capture, CaptureLight, Frame, load_capture, save_capture
from rnd_runtime.core.camera import Camera
from rnd_runtime.core.images import linear_to_srgb, to_bytes, write_image
from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_runtime.motion.motion import Motion
from rnd_runtime.motion.skeleton import bone_transforms
from rnd_runtime.raster.cpu import rasterize
from support.paths import ASSETS

FRAMES = 6


def body() -> Body:
    """The embedded template."""
    return Body.load(ASSETS / "body.npz")


def motion(body: Body, frames: int = FRAMES, turn: float = 2 * np.pi) -> Motion:
    """A turn on the spot with the arms swinging, 30 fps."""
    angles = np.zeros((frames, len(body.skeleton), 3))
    phase = np.arange(frames) / frames
    angles[:, 0, 1] = turn * phase
    names = body.skeleton.names
    angles[:, names.index("left_shoulder"), 2] = -1.0 + 0.4 * np.sin(2 * np.pi * phase)
    angles[:, names.index("right_shoulder"), 2] = 1.0 + 0.4 * np.sin(2 * np.pi * phase)
    return Motion(axis_angle_to_matrix(angles), np.zeros((frames, 3)), 30.0, names)


def write_capture(folder: Path, *, size: int = 64, frames: int = FRAMES) -> Capture:
    """Write and load a capture whose person is the template, striped, flatly lit."""
    template = body()
    moves = motion(template, frames)
    camera = Camera.look_at([0, 1.0, 3.2], [0, 0.95, 0], width=size, height=size, fov_y=0.7)
    side = Camera.look_at([3.2, 1.0, 0.1], [0, 0.95, 0], width=size, height=size, fov_y=0.7)
    records = [_write_frame(folder, template, moves, camera, "front", k, "train") for k in range(frames)]
    records += [_write_frame(folder, template, moves, side, "side", k, "novel_view") for k in (0, frames // 2)]
    write_image(folder / "lights" / "white.exr", np.ones((16, 32, 3), np.float32))
    lights = {"white": CaptureLight("lights/white.exr")}
    capture = Capture(folder, {"front": camera, "side": side}, lights, template, moves, tuple(records))
    save_capture(capture)
    return load_capture(folder)


def _write_frame(folder: Path, body: Body, moves: Motion, camera: Camera, name: str, k: int, split: str) -> Frame:
    bones = bone_transforms(body.skeleton, moves.rotations[k], moves.translations[k]).astype(np.float64)
    blend = np.einsum("vj,jrc->vrc", body.skinning_weights, bones)
    posed = np.einsum("vrc,vc->vr", blend[:, :, :3], body.vertices) + blend[:, :, 3]
    corners = posed[body.faces]
    crosses = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(posed)
    for corner in range(3):
        np.add.at(normals, body.faces[:, corner], crosses)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    stripes = 0.5 + 0.4 * np.sign(np.sin(25 * body.vertices[:, 1:2]))
    albedo = np.concatenate([stripes, 0.4 * np.ones_like(stripes), 1 - stripes], axis=1)
    radius = 0.012
    covariances = np.tile(np.array([1, 0, 0, 1, 0, 1]) * (0.5 * radius) ** 2, (len(posed), 1))
    features = np.concatenate([albedo, normals @ camera.world_to_camera[:3, :3].T], axis=1)
    raster = rasterize(
        posed.astype(np.float32),
        covariances.astype(np.float32),
        np.full(len(posed), 0.99, np.float32),
        features.astype(np.float32),
        camera,
    )
    file = f"{name}_{k:03d}.png"
    write_image(folder / "images" / file, to_bytes(linear_to_srgb(raster.image[..., :3])))
    write_image(folder / "masks" / file, to_bytes(raster.alpha))
    write_image(folder / "normals" / file, to_bytes((raster.image[..., 3:] + 1) / 2))
    return Frame(
        image=f"images/{file}",
        mask=f"masks/{file}",
        camera=name,
        frame=k,
        split=split,
        normal=f"normals/{file}",
        light="white",
    )
