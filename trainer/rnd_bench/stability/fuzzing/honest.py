"""Small valid files of every kind."""

from __future__ import annotations

import gzip
import json
import pickle  # noqa: TID251  # writes what others' programs write
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from rnd_bench.scenes.poses import ARMS_DOWN, motion_of_poses
from rnd_runtime.capture.body import Body
from rnd_runtime.core.images import write_image
from rnd_runtime.motion.motion import save_motion
from rnd_runtime.motion.skeleton import Skeleton

from .honest_rigs import write_rigs

FRAMES = 3
COMPLETE = "complete"
"""a file that is written when all others are"""


def write_files(folder: Path, avatar: Path, checkpoint: Path, capture: Path) -> None:
    """Write them into ``folder``; ``avatar``, ``checkpoint`` and ``capture``, of SMPL's 24 joints, are copied."""
    skeleton = Body.load(capture / "body.npz").skeleton
    for name in ("run", "colmap", "easymocap", "mocap"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    shutil.copyfile(avatar, folder / "avatar.onnx")
    shutil.copyfile(checkpoint, folder / "avatar.ckpt")
    shutil.copytree(capture, folder / "capture", dirs_exist_ok=True)
    body = _small_body(skeleton)
    for name in ("body.npz", "capture/body.npz"):
        body.save(folder / name)
    save_motion(folder / "motion.npz", motion_of_poses([ARMS_DOWN] * FRAMES, skeleton.names))
    _write_json(folder, skeleton)
    _write_calibrations(folder)
    _write_pickles(folder, body)
    _write_bvh(folder / "walk.bvh", skeleton)
    _write_acclaim(folder / "mocap", skeleton)
    write_rigs(folder, skeleton)
    _write_images(folder)
    _write_network(folder / "network.onnx")
    (folder / COMPLETE).touch()


def _small_body(skeleton: Skeleton) -> Body:
    """Four vertices around each joint."""
    count = len(skeleton)
    corners = 0.05 * np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [-1, -1, -1]])
    faces = np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])
    return Body(
        (skeleton.rest_joints[:, None] + corners).reshape(-1, 3),
        (4 * np.arange(count)[:, None, None] + faces).reshape(-1, 3).astype(np.int32),
        np.repeat(np.eye(count, dtype=np.float32), 4, axis=0),
        skeleton,
    )


def _write_json(folder: Path, skeleton: Skeleton) -> None:
    view = {"azimuth": 0.1, "elevation": 0.2, "distance": 3.0, "target": [0, 1, 0], "fov": 0.5}
    state = {"time": 0.0, "width": 64, "height": 64, **view, "yaw": 0.3, "output": "lit", "background": "none"}
    camera = {"width": 64, "height": 48, "K": [[60, 0, 32], [0, 60, 24], [0, 0, 1]]}
    camera["world_to_camera"] = [[1, 0, 0, 0], [0, -1, 0, 1], [0, 0, -1, 3], [0, 0, 0, 1]]
    fit = {"id": 0, "Rh": [[0.1, 0, 0]], "Th": [[0, 1, 2]], "poses": [[0.0] * 72], "shapes": [[0.0] * 10]}
    files: dict[str, Any] = {
        "request.json": {"ask": "render", "number": 1, "state": state},
        "camera.json": {"cameras": {"front": camera}},
        "joints.json": {name: [name, f"their {name}"] for name in skeleton.names},
        **{f"easymocap/{k:06d}.json": [fit] for k in range(FRAMES)},
    }
    for name, content in files.items():
        (folder / name).write_text(json.dumps(content), encoding="utf-8")
    rows = [json.dumps({"step": k, "loss": 0.5 / (k + 1), "seconds": 0.1 * k}) for k in range(FRAMES)]
    (folder / "run/metrics.jsonl").write_text("\n".join(rows) + "\n", encoding="utf-8")


def _write_calibrations(folder: Path) -> None:
    matrix = "!!opencv-matrix\n  rows: {}\n  cols: {}\n  dt: d\n  data: [{}]"
    K = matrix.format(3, 3, "600., 0., 320., 0., 600., 240., 0., 0., 1.")
    none = matrix.format(5, 1, "0., 0., 0., 0., 0.")
    names = ("01", "02")
    lines = ["%YAML:1.0", "---", "names:", *(f'  - "{name}"' for name in names)]
    lines += [f"{key}_{name}: {value}" for name in names for key, value in (("K", K), ("dist", none))]
    (folder / "intri.yml").write_text("\n".join(lines) + "\n", encoding="utf-8")
    (folder / "colmap/cameras.txt").write_text("# cameras\n1 OPENCV 64 48 60 60 32 24 0 0 0 0\n", encoding="utf-8")
    images = [f"{k + 1} 1 0 0 0 0 0 3 1 {k:06d}.png\n1.0 2.0 -1\n" for k in range(FRAMES)]
    (folder / "colmap/images.txt").write_text("# images\n" + "".join(images), encoding="utf-8")


def _write_pickles(folder: Path, body: Body) -> None:
    import torch
    from scipy.sparse import csc_matrix

    poses, trans = np.zeros((FRAMES, 72), np.float32), np.tile(np.array([0, 1, 3], np.float32), (FRAMES, 1))
    betas = np.zeros((FRAMES, 10), np.float32)
    track = {"pose": poses, "trans": trans, "pose_world": poses, "trans_world": trans, "betas": betas}
    wham = pickle.dumps({0: {**track, "frame_ids": np.arange(FRAMES)}}, protocol=4)
    (folder / "wham.pkl").write_bytes(wham)
    (folder / "wham.pkl.gz").write_bytes(gzip.compress(wham))
    angles = {"body_pose": poses[:, :63], "global_orient": poses[:, :3], "transl": trans, "betas": betas}
    params = {name: torch.tensor(value) for name, value in angles.items()}
    K = torch.eye(3).repeat(FRAMES, 1, 1)
    content = {"smpl_params_incam": params, "smpl_params_global": params, "K_fullimg": K}
    torch.save(content, folder / "gvhmr.pt")
    vertices, skeleton = body.vertices, body.skeleton
    parents = np.where(skeleton.parents < 0, 2**32 - 1, skeleton.parents)
    smpl = {
        "v_template": vertices,
        "f": body.faces.astype(np.uint32),
        "weights": body.skinning_weights.astype(np.float64),
        "kintree_table": np.stack([parents, np.arange(len(skeleton))]),
        "J_regressor": csc_matrix(np.repeat(np.eye(len(skeleton)) / 4, 4, axis=1)),
        "shapedirs": np.zeros((*vertices.shape, 10)),
    }
    (folder / "smpl.pkl").write_bytes(pickle.dumps(smpl, protocol=2))


def _write_bvh(path: Path, skeleton: Skeleton) -> None:
    lines, joints = ["HIERARCHY"], []

    def write(joint: int, indent: str) -> None:
        parent = int(skeleton.parents[joint])
        offset = skeleton.rest_joints[joint] - (skeleton.rest_joints[parent] if joint else 0)
        lines.append(f"{indent}{'JOINT' if joint else 'ROOT'} {skeleton.names[joint]}")
        lines.append(f"{indent}{{")
        lines.append(f"{indent} OFFSET " + " ".join(f"{100 * x:.4f}" for x in offset))
        position = "" if joint else "Xposition Yposition Zposition "
        lines.append(f"{indent} CHANNELS {3 if joint else 6} {position}Zrotation Xrotation Yrotation")
        joints.append(joint)
        children = [child for child, above in enumerate(skeleton.parents) if above == joint]
        for child in children:
            write(child, indent + " ")
        if not children:
            lines.extend([f"{indent} End Site", f"{indent} {{", f"{indent}  OFFSET 0 5 0", f"{indent} }}"])
        lines.append(f"{indent}}}")

    write(0, "")
    lines += ["MOTION", f"Frames: {FRAMES}", "Frame Time: 0.0333333"]
    lines += [" ".join(["0", "90", "0", *("5",) * 3 * len(joints)])] * FRAMES
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _write_acclaim(folder: Path, skeleton: Skeleton) -> None:
    """02.asf and 02_01.amc."""
    names = ("root", *skeleton.names[1:])
    lines = [":version 1.10", ":name VICON", ":units", "  mass 1.0", "  length 0.45", "  angle deg", ":root"]
    lines += ["  order TX TY TZ RX RY RZ", "  axis XYZ", "  position 0 0 0", "  orientation 0 0 0", ":bonedata"]
    hierarchy = [":hierarchy", "  begin"]
    for joint, parent in enumerate(skeleton.parents):
        if joint:
            bone = (skeleton.rest_joints[joint] - skeleton.rest_joints[parent]) / 0.0254 * 0.45
            length = float(np.linalg.norm(bone))
            x, y, z = bone / length
            lines += ["  begin", f"     id {joint}", f"     name link{joint}"]  # rigid, to the joint
            lines += [
                f"     direction {x:.6f} {y:.6f} {z:.6f}",
                f"     length {length:.6f}",
                "     axis 0 0 0  XYZ",
                "  end",
            ]
            lines += ["  begin", f"     id {100 + joint}", f"     name {names[joint]}", "     direction 0 1 0"]
            lines += ["     length 0", "     axis 0 0 0  XYZ", "    dof rx ry rz", "  end"]
            hierarchy += [f"    {names[parent]} link{joint}", f"    link{joint} {names[joint]}"]
    (folder / "02.asf").write_text("\n".join([*lines, *hierarchy, "  end"]) + "\n", encoding="utf-8")
    motion = ["#!OML:ASF", ":FULLY-SPECIFIED", ":DEGREES"]
    for frame in range(FRAMES):
        motion += [str(frame + 1), "root 0 17 0 0 0 0", *(f"{name} 5 5 5" for name in names[1:])]
    (folder / "02_01.amc").write_text("\n".join(motion) + "\n", encoding="utf-8")


def _write_images(folder: Path) -> None:
    import av
    import OpenImageIO as oiio

    pixels = np.random.default_rng(0).uniform(0, 4, (16, 32, 3)).astype(np.float32)
    codes = (60 * pixels).astype(np.uint8)
    write_image(folder / "image.png", codes)
    write_image(folder / "light.exr", pixels)
    target: Any = oiio.ImageOutput.create(str(folder / "light.hdr"))
    target.open(str(folder / "light.hdr"), oiio.ImageSpec(32, 16, 3, "float"))
    target.write_image(pixels)
    target.close()
    with av.open(str(folder / "video.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=30)
        stream.height, stream.width, stream.pix_fmt = 16, 32, "yuv420p"
        for _ in range(FRAMES):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(codes, format="rgb24")))
        container.mux(stream.encode(None))


def _write_network(path: Path) -> None:
    """A mask network of one convolution and a sigmoid."""
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    weights = numpy_helper.from_array(np.full((1, 3, 3, 3), 0.1, np.float32), "weights")
    nodes = [
        helper.make_node("Conv", ["image", "weights"], ["raw"], pads=[1, 1, 1, 1]),
        helper.make_node("Sigmoid", ["raw"], ["mask"]),
    ]
    shapes = {"image": [1, 3, 16, 16], "mask": [1, 1, 16, 16]}
    ends = [helper.make_tensor_value_info(name, TensorProto.FLOAT, shape) for name, shape in shapes.items()]
    graph = helper.make_graph(nodes, "mask", ends[:1], ends[1:], [weights])
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8), path)
