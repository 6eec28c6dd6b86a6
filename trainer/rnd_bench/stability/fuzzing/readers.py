"""The readers, each with a small valid file and the way in which it is damaged."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from .damage import Mutation, damaged_json, damaged_json_lines, damaged_text
from .formats import (
    damaged_below_compression,
    damaged_exr,
    damaged_glb,
    damaged_npy,
    damaged_npz,
    damaged_onnx,
    damaged_pickle,
    damaged_png,
    damaged_safetensors,
    damaged_torch,
)

Read = Callable[[Path], object]


class Reader(NamedTuple):
    """``file`` in the folder of valid files, what reads it (made in the process that does), and its damage."""

    file: str
    prepare: Callable[[Path], Read]
    mutation: Mutation | None = None


def _motion(folder: Path) -> Read:
    from rnd_runtime.capture.body import Body
    from rnd_runtime.motion.motion import load_motion

    skeleton = Body.load(folder / "body.npz").skeleton
    return lambda path: load_motion(path, skeleton)


def _motion_of_skeleton_file(folder: Path) -> Read:
    read = _motion(folder)
    return lambda path: read(path.with_name("02_01.amc"))


def _motion_of_folder(folder: Path) -> Read:
    read = _motion(folder)
    return lambda path: read(path.parent)


def _capture(folder: Path) -> Read:
    from rnd_runtime.capture.capture import load_capture

    return load_capture


def _camera(folder: Path) -> Read:
    from rnd_viewer.inputs.cameras import file_path

    return lambda path: file_path(str(path), (64, None), range(1))


def _foreign_camera(folder: Path) -> Read:
    from rnd_viewer.convert.cameras import read_cameras

    return lambda path: read_cameras(path, None, (64, 48), 30.0)


def _request(folder: Path) -> Read:
    from rnd_viewer.view.state import parse_request

    return lambda path: parse_request(path.read_bytes())


def _joint_map(folder: Path) -> Read:
    from rnd_runtime.motion.joint_names import load_joint_map

    return load_joint_map


def _losses(folder: Path) -> Read:
    from rnd_viewer.report.run_files import read_losses

    return lambda path: read_losses(path.parent)


def _body(folder: Path) -> Read:
    from rnd_runtime.capture.body import Body

    return Body.load


def _body_model(folder: Path) -> Read:
    from rnd_trainer.importing.body_models import load_body_model

    return load_body_model


def _poses(folder: Path) -> Read:
    from rnd_trainer.importing.pose_files import read_poses

    return read_poses


def _calibration(folder: Path) -> Read:
    from rnd_trainer.importing.opencv_yaml import Calibration

    def read(path: Path) -> object:
        found = Calibration(path)
        return [(found.matrix(f"K_{name}"), found.optional_matrix(f"dist_{name}")) for name in found.strings("names")]

    return read


def _colmap(folder: Path) -> Read:
    from rnd_trainer.importing.layouts.colmap import read_text_model

    return lambda path: read_text_model(path.parent)


def _light(folder: Path) -> Read:
    from rnd_runtime.shading.files.load import load_light

    return load_light


def _image(folder: Path) -> Read:
    from rnd_runtime.core.images import read_image

    return read_image


def _video(folder: Path) -> Read:
    from rnd_trainer.importing.videos.video_file import VideoFile

    return lambda path: VideoFile(path).frame(0)


def _checkpoint(folder: Path) -> Read:
    from rnd_trainer.model.checkpoint import load_checkpoint

    return load_checkpoint


def _network(folder: Path) -> Read:
    from rnd_trainer.importing.surfaces.networks import ImageNetwork

    image = np.zeros((16, 16, 3), np.uint8)
    return lambda path: ImageNetwork(path, outputs=(1,))(image)


def _avatar(folder: Path) -> Read:
    """An avatar and its rest pose: some faults of a graph show only in its evaluation."""
    from rnd_runtime.avatar.avatar import Avatar
    from rnd_runtime.motion.motion import Motion

    def read(path: Path) -> object:
        avatar = Avatar.load(path)
        names = avatar.skeleton.names
        rest = Motion(np.eye(3)[None, None].repeat(len(names), 1), np.zeros((1, 3)), 30.0, names, "the rest pose")
        return avatar.pose(rest, 0.0)

    return read


READERS: dict[str, Reader] = {
    "request": Reader("request.json", _request, damaged_json),
    "camera": Reader("camera.json", _camera, damaged_json),
    "transforms": Reader("transforms.json", _foreign_camera, damaged_json),
    "gltf camera": Reader("camera.glb", _foreign_camera, damaged_glb),
    "joint map": Reader("joints.json", _joint_map, damaged_json),
    "metrics": Reader("run/metrics.jsonl", _losses, damaged_json_lines),
    "colmap": Reader("colmap/images.txt", _colmap, damaged_text),
    "calibration": Reader("intri.yml", _calibration, damaged_text),
    "pickle": Reader("wham.pkl", _motion, damaged_pickle),
    "compressed pickle": Reader("wham.pkl.gz", _poses, damaged_below_compression),
    "torch": Reader("gvhmr.pt", _poses, damaged_torch),
    "body model": Reader("smpl.pkl", _body_model, damaged_pickle),
    "easymocap": Reader("easymocap/000001.json", _motion_of_folder, damaged_json),
    "bvh": Reader("walk.bvh", _motion, damaged_text),
    "amc": Reader("mocap/02_01.amc", _motion, damaged_text),
    "asf": Reader("mocap/02.asf", _motion_of_skeleton_file, damaged_text),
    "kimodo": Reader("kimodo.npz", _motion, damaged_npz),
    "sam3d": Reader("sam3d.pkl", _motion, damaged_pickle),
    "humanml": Reader("humanml.npy", _motion, damaged_npy),
    "glb": Reader("walk.glb", _motion, damaged_glb),
    "png": Reader("image.png", _image, damaged_png),
    "exr": Reader("light.exr", _light, damaged_exr),
    "hdr": Reader("light.hdr", _light),
    "motion": Reader("motion.npz", _motion, damaged_npz),
    "body": Reader("body.npz", _body, damaged_npz),
    "checkpoint": Reader("avatar.ckpt", _checkpoint, damaged_safetensors),
    "capture": Reader("capture/capture.json", _capture, damaged_json),
    "network": Reader("network.onnx", _network, damaged_onnx),
    "video": Reader("video.mp4", _video),
    "avatar": Reader("avatar.onnx", _avatar, damaged_onnx),
}
"""cheap ones first"""
