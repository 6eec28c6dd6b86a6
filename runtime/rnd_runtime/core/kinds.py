"""The kind of a file, for refusals that help."""

from __future__ import annotations

import os
import struct
import zipfile
from pathlib import Path
from typing import Literal

from .errors import InputError

Kind = Literal["avatar", "body", "capture", "checkpoint", "light", "motion"]
"""kinds of files that a reader may want"""
_NAMES = {
    "avatar": "an avatar.onnx",
    "body": "a template body",
    "body model": "a body model",
    "capture": "a capture's folder",
    "checkpoint": "a checkpoint",
    "image": "an image",
    "light": "a light probe (.exr or .hdr)",
    "mesh": "a glTF file without an animation",
    "motion": "a motion",
    "run": "a run's folder",
    "video": "a video",
}
# What helps who gave the second kind where the first was wanted; {} is the path.
_HINTS = {
    ("avatar", "checkpoint"): "rnd-export {} makes one",
    ("avatar", "run"): "rnd-export {}/avatar.ckpt makes one",
    ("avatar", "capture"): "rnd-train {} learns one",
    ("avatar", "motion"): "a motion goes to --motion",
    ("avatar", "light"): "a light probe goes to --hdr",
    ("avatar", "body"): "rnd-train learns one from a capture",
    ("avatar", "body model"): "rnd-train learns one from a capture",
    ("capture", "run"): "rnd-train and rnd-eval take the capture's folder",
    ("capture", "video"): "rnd-data makes one",
    ("capture", "motion"): "rnd-data makes one",
    ("capture", "body"): "the folder with its capture.json",
    ("checkpoint", "avatar"): "rnd-train leaves avatar.ckpt in the run's folder",
    ("checkpoint", "run"): "{}/avatar.ckpt",
    ("motion", "body"): "a body has no poses over time",
    ("motion", "body model"): "a body model has no poses over time",
    ("motion", "capture"): "{}/motion.npz",
    ("motion", "light"): "a light probe goes to --hdr",
    ("motion", "mesh"): "export it with its armature's animation; a .vrm is a character, its motions are .vrma files",
    ("motion", "video"): "rnd-data estimates poses from videos",
    ("light", "motion"): "a motion goes to --motion",
    ("light", "image"): "radiance needs floating-point numbers",
}
_LOOK = 1 << 18  # bytes of a file's beginning or end
_ZIP_ERRORS = (OSError, ValueError, EOFError, RuntimeError, NotImplementedError, struct.error, zipfile.BadZipFile)
_BODY_MODEL = ("v_template", "kintree_table")


def kind_of(path: str | Path) -> str:
    """A ``Kind``, or "body model", "image", "mesh", "ONNX model", "run", "video", "folder", or "unknown".

    Reads names and a few hundred kilobytes; nothing is decoded, executed or raised. "unknown" also of what is
    missing or cannot be read.
    """
    try:
        return _folder(Path(path)) if os.path.isdir(path) else _file(Path(path))  # noqa: PTH112
    except (OSError, ValueError):  # a name with a zero byte among them
        return "unknown"


def explained(error: InputError, path: str | Path, wanted: Kind) -> InputError:
    """The line that helps instead of a reader's ``error``, where ``path`` is not of the ``wanted`` kind."""
    kind = kind_of(path)
    if kind == wanted or kind not in _NAMES:
        return error.at(file=path)
    hint = _HINTS.get((wanted, kind))
    line = f"expected {_NAMES[wanted]}, got {_NAMES[kind]}"
    return InputError(line, file=path, hint=None if hint is None else hint.format(path))


def _folder(path: Path) -> str:
    names = set(os.listdir(path))  # noqa: PTH208
    if "capture.json" in names:
        return "capture"
    return "run" if names & {"avatar.ckpt", "metrics.jsonl"} else "folder"


def _file(path: Path) -> str:
    suffix = path.suffix.lower()
    with path.open("rb") as stream:
        head = stream.read(_LOOK)
        if head[8:9] == b"{" and b"rnd_checkpoint" in head:  # safetensors: a length, then JSON
            return "checkpoint"
        if suffix == ".onnx":
            stream.seek(max(0, path.stat().st_size - _LOOK))
            return "avatar" if b"rnd_avatar" in stream.read() else "ONNX model"
    if head[:4] == b"PK\x03\x04":
        return _archive(path)
    if head[:4] == b"v/1\x01" or head[:2] == b"#?":
        return "light"
    if head[:8] == b"\x89PNG\r\n\x1a\n" or head[:3] == b"\xff\xd8\xff":
        return "image"
    if head[4:8] == b"ftyp" or suffix in (".avi", ".mkv", ".webm"):
        return "video"
    if head[:4] == b"glTF":
        return "motion" if b'"animations"' in head else "mesh"
    if suffix == ".json" and b'"rnd-capture/' in head:
        return "capture"
    if suffix in (".bvh", ".amc"):
        return "motion"
    if suffix in (".pkl", ".pickle"):
        return "body model" if any(name.encode() in path.read_bytes() for name in _BODY_MODEL) else "motion"
    return "unknown"


def _archive(path: Path) -> str:
    """Kind of a zip archive by the names of its members."""
    try:
        with zipfile.ZipFile(path) as archive:
            names = {name.removesuffix(".npy") for name in archive.namelist()}
    except _ZIP_ERRORS:
        return "unknown"
    if names & {"poses", "poses_all", "pose_body", "body_pose", "local_rot_mats", "pred_joint_coords"}:
        return "motion"
    if {"vertices", "skinning_weights"} <= names:
        return "body"
    return "body model" if names & {*_BODY_MODEL} else "unknown"
