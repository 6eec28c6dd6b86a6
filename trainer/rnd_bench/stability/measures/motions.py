"""Rows P13–P16: motion files that are broken, have other layouts, another body, or are out of view."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from rnd_bench.scenes.subject import Subject
from rnd_bench.stability.figures import Result, at_most, holds, refusal, result
from rnd_bench.stability.processes import Command, play, run_commands
from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_runtime.motion.formats.recordings import read_recording
from rnd_runtime.motion.motion import load_motion
from rnd_runtime.motion.readers.arrays import MotionRecord
from rnd_runtime.motion.skeleton import smpl_skeleton

HIGH = 6.0  # m; no camera sees both a body at this height and one at the origin


def _fields(subject: Subject, frames: int) -> dict[str, Any]:
    """The arrays of a motion file of the avatar's joints at rest."""
    names = subject.avatar.skeleton.names
    arrays = {"poses": np.zeros((frames, 3 * len(names))), "trans": np.zeros((frames, 3)), "joint_names": names}
    return {**arrays, "mocap_framerate": np.array(30.0), "up_axis": np.array("y")}


def bad_motions(subject: Subject) -> Result:
    """P13: each broken file is refused with file, field and frame; the command exits with 2."""
    joints = len(subject.avatar.skeleton)
    good = _fields(subject, 5)

    def with_value(value: float) -> np.ndarray:
        poses = good["poses"].copy()
        poses[3, 7] = value
        return poses

    cases: dict[str, tuple[dict[str, Any], tuple[str, ...]]] = {
        "empty": ({"poses": np.zeros((0, 3 * joints)), "trans": np.zeros((0, 3))}, ("poses",)),
        "NaN": ({"poses": with_value(np.nan)}, ("poses", "frame 3")),
        "infinite": ({"poses": with_value(np.inf)}, ("poses", "frame 3")),
        "1e6 rad": ({"poses": with_value(1e6)}, ("poses", "frame 3")),
        "objects": ({"poses": np.array([[None] * 3 * joints] * 5, object)}, ("poses",)),
        "NaN in trans": ({"trans": np.full((5, 3), np.nan)}, ("trans", "frame 0")),
        "kilometres": ({"trans": np.full((5, 3), 1e6)}, ("trans", "frame 0")),
        "negative fps": ({"mocap_framerate": np.array(-1.0)}, ("mocap_framerate",)),
    }
    wrong: list[str] = []
    runs: list[Command] = []
    for name, (change, words) in cases.items():
        file = subject.work / f"bad_{name.replace(' ', '_')}.npz"
        np.savez(file, **{**good, **change})
        wrong += refusal(name, load_motion, file, subject.avatar.skeleton, words=(file.name, *words))
        out = subject.work / f"out_bad_{len(runs)}"
        runs.append(play(subject.avatar_file, file, out, "--size", 16))
    wrong += [f"{name}: {done}" for name, done in zip(cases, run_commands(subject.work, runs)) if not done.refused]
    for name, change, frames in (
        ("one frame", {"poses": np.zeros((1, 3 * joints)), "trans": np.zeros((1, 3))}, 1),
        ("float64 and missing fps", {"mocap_framerate": None}, 5),
        ("float32", {"poses": good["poses"].astype(np.float32)}, 5),
    ):
        file = subject.work / "usable.npz"
        np.savez(file, **{k: v for k, v in {**good, **change}.items() if v is not None})
        motion = load_motion(file, subject.avatar.skeleton)
        if motion.frame_count != frames or ("missing" in name and not any("frame rate" in n for n in motion.notes)):
            wrong.append(name)
    return result(holds("motions neither read nor refused correctly", wrong))


def joint_counts(subject: Subject) -> Result:
    """P14: 22, 24, 52 and 55 joints are matched by name; other counts are refused."""
    rng, wrong = np.random.default_rng(0), []
    skeleton = smpl_skeleton(rng.normal(size=(24, 3)))
    keys = {66: "poses", 72: "poses", 156: "poses", 165: "poses", 63: "pose_body", 69: "body_pose"}
    for columns, key in keys.items():
        file = subject.work / f"joints_{columns}.npz"
        poses = rng.normal(size=(2, columns)) * 0.3
        still = np.zeros((2, 3))
        fields: dict[str, Any] = {key: poses, "trans": still, "root_orient": still, "mocap_framerate": 30.0}
        np.savez(file, **fields)
        read = read_recording(file)
        assert isinstance(read, MotionRecord)
        if len(read.joint_names) != columns // 3 + (columns in (63, 69)):
            wrong.append(f"{columns} columns: {len(read.joint_names)} joints")
        motion = load_motion(file, skeleton)
        if columns in (156, 165):  # right_hand is the base of the right index finger
            right = read.joint_names.index("right_index1")
            truth = axis_angle_to_matrix(poses[:, 3 * right : 3 * right + 3])
            if not np.allclose(motion.rotations[:, 23], truth):
                wrong.append(f"{columns} columns: the right hand is another joint")
    for columns in (48, 75, 90):
        file = subject.work / f"joints_{columns}.npz"
        np.savez(file, poses=np.zeros((2, columns)), trans=np.zeros((2, 3)))
        counts = "66, 72, 156 or 165", str(columns // 3)
        wrong += refusal(f"{columns} columns", read_recording, file, words=counts)
    return result(holds("layouts not matched by name or not refused with both counts", wrong))


def other_betas(subject: Subject) -> Result:
    """P15: a motion file with its own betas."""
    given = _fields(subject, 2)
    plain, fat = subject.work / "plain.npz", subject.work / "fat.npz"
    np.savez(plain, **given)
    np.savez(fat, **given, betas=np.full(10, 4.0))
    motions = [load_motion(file, subject.avatar.skeleton) for file in (plain, fat)]
    moved = float(np.abs(np.subtract(*(subject.avatar.pose(motion, 0.0).means for motion in motions))).max())
    warned = any("betas" in note for note in motions[1].notes)
    return result(
        at_most("largest displacement of a Gaussian by the motion's betas", 1e3 * moved, 0, "mm"),
        at_most("warnings missing", float(not warned), 0),
    )


def wrong_camera(subject: Subject) -> Result:
    """P16: a camera of another fit; a Y-up motion 6 m above the floor, read with either up axis."""
    lifted = subject.work / "lifted.npz"
    np.savez(lifted, poses=np.zeros((2, 72)), trans=np.tile([0.0, HIGH, 0.0], (2, 1)), mocap_framerate=60.0)
    view = subject.camera(0.0, 0.1, 32)
    away, above = view.world_to_camera.copy(), view.world_to_camera.copy()
    away[:3, 3] = [0, 0, -40.0]
    above[:3, 3] -= above[:3, :3] @ [0, HIGH, 0]
    files = {}
    for name, world_to_camera in (("away", away), ("above", above)):
        camera = {"width": 32, "height": 32, "K": view.K.tolist()}
        camera["world_to_camera"] = world_to_camera.tolist()
        files[name] = subject.work / f"{name}.json"
        files[name].write_text(json.dumps(camera), encoding="utf-8")
    cases = {
        "another fitter's camera": (subject.still_file, "away", "y", 2),
        "the right up axis": (lifted, "above", "y", 0),
        "the wrong up axis": (lifted, "above", "z", 2),
    }
    wrong, runs = [], []
    for number, (file, viewed, up, _) in enumerate(cases.values()):
        options = ("--format", "png", "--camera", files[viewed], "--motion-up", up)
        runs.append(play(subject.avatar_file, file, subject.work / f"out_view_{number}", *options))
    for (name, (*_, code)), done in zip(cases.items(), run_commands(subject.work, runs), strict=True):
        if done.code != code or (code == 2 and "nothing of the avatar is in view" not in done.errors):
            wrong.append(f"{name}: {done}")
    return result(holds("empty first frames not reported", wrong))
