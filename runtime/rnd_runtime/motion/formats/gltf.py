"""Skinned animations of binary glTF: .glb as Blender writes it, VRM's .vrm and .vrma."""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Collection
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from rnd_runtime.core.budget import Budget
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import existing_file
from rnd_runtime.core.rotations import matrix_to_quaternion, quaternion_to_matrix
from rnd_runtime.motion.readers.tree import Floats, MocapTree, unique_names

from .rigs import world_tree

SUFFIXES = (".glb", ".gltf", ".vrm", ".vrma")
Tracks = dict[tuple[int, str], tuple[Floats, Floats, str]]
"""times [K], values and interpolation by (node, path)"""
_MAGIC, _JSON, _BIN = b"glTF", 0x4E4F534A, 0x004E4942
_TYPES = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
_COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_PATHS = {"rotation": 4, "translation": 3, "scale": 3}
_FPS = 30.0  # of sparse keys
_FPS_LIMITS = (5.0, 240.0)
_ROUNDED = 0.02  # relative distance to a whole number of frames per second
MAX_FRAMES, _MAX_NODES = 200_000, 20_000
_MAX_NUMBER = 1e6
_HUMANOID = {
    **{"hips": "pelvis", "spine": "spine1", "chest": "spine2", "upperChest": "spine3", "neck": "neck", "head": "head"},
    **{
        f"{side}{bone}": f"{side}_{joint}"
        for side in ("left", "right")
        for bone, joint in {
            **{"Shoulder": "collar", "UpperArm": "shoulder", "LowerArm": "elbow", "Hand": "wrist"},
            **{"MiddleProximal": "hand", "UpperLeg": "hip", "LowerLeg": "knee", "Foot": "ankle", "Toes": "foot"},
        }.items()
    },
}
"""VRM's humanoid bones"""


def read_gltf(path: str | Path) -> tuple[MocapTree, dict[str, int] | None]:
    """The first animation of ``path`` on its nodes, and the joints that VRM's humanoid names; Y up, in metres.

    Keys are sampled at a constant rate: that of the keys where they have one, else 30 per second.

    Raises:
        InputError: damaged, compressed by an extension, without nodes or without an animation.
    """
    path = existing_file(path, what="motion")
    try:
        return _read(GltfDocument(path))
    except InputError as error:
        raise error.at(file=path) from error
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, struct.error, OverflowError) as error:
        got = f"{type(error).__name__}: {error}"
        raise InputError("glTF file", expected="a valid one", got=got, file=path) from error


class GltfDocument:
    """JSON and buffers of a glTF file."""

    def __init__(self, path: Path) -> None:
        self.path, self.budget = path, Budget.of(path)
        content = path.read_bytes()
        self._binary = b""
        if content[:4] == _MAGIC:
            text, self._binary = _chunks(content)
        else:
            text = content
        try:
            self.json = json.loads(text.decode("utf-8-sig"))
        except (ValueError, RecursionError) as error:
            raise InputError("glTF file", expected="JSON", got=str(error)) from error
        if not isinstance(self.json, dict) or "asset" not in self.json:
            raise InputError("glTF file", expected="a glTF document", got="other JSON")
        if len(self.json.get("nodes", ())) > _MAX_NODES:
            raise InputError("nodes", expected=f"at most {_MAX_NODES}", got=len(self.json["nodes"]))

    def numbers(self, index: int) -> Floats:
        """[N, C] of accessor ``index``, normalised integers as numbers."""
        accessor = self.json["accessors"][index]
        if "sparse" in accessor or "bufferView" not in accessor:
            raise InputError("accessor of the animation", expected="a dense one", got="a sparse one")
        view = self.json["bufferViews"][accessor["bufferView"]]
        if extensions := view.get("extensions"):
            raise InputError("animation", expected="an uncompressed one", got=", ".join(extensions))
        dtype, width = np.dtype(_COMPONENTS[accessor["componentType"]]), _TYPES[accessor["type"]]
        count, stride = int(accessor["count"]), int(view.get("byteStride", 0)) or dtype.itemsize * width
        start = int(view.get("byteOffset", 0)) + int(accessor.get("byteOffset", 0))
        buffer = self._buffer(view["buffer"])
        if count < 0 or stride < dtype.itemsize * width or start < 0:
            raise InputError("accessor of the animation", expected="a positive size", got=f"{count}, {stride}, {start}")
        if count and start + (count - 1) * stride + dtype.itemsize * width > len(buffer):
            raise InputError("glTF file", expected=f"{count} numbers", got="an end before")
        self.budget.take(8 * count * width, "animation")
        raw = np.frombuffer(buffer, np.uint8)
        rows = np.lib.stride_tricks.as_strided(raw[start:], (count, dtype.itemsize * width), (stride, 1))
        values: Floats = np.ascontiguousarray(rows).view(dtype).reshape(count, width).astype(np.float64)
        if accessor.get("normalized"):
            values = np.maximum(values / np.iinfo(dtype).max, -1)
        if not np.isfinite(values).all() or np.abs(values).max(initial=0) > _MAX_NUMBER:
            raise InputError("animation", expected=f"finite numbers of at most {_MAX_NUMBER:g}", got="others")
        return values

    def _buffer(self, index: int) -> bytes:
        uri = self.json["buffers"][index].get("uri")
        if uri is None:
            return self._binary
        if uri.startswith("data:"):
            self.budget.take(len(uri), "buffer")
            return base64.b64decode(uri.partition(",")[2])
        name = unquote(uri)
        beside = self.path.parent / name
        if Path(name).name != name:
            raise InputError("buffer of the glTF file", expected="a file beside it", got=uri)
        return existing_file(beside, what="buffer").read_bytes()


def _chunks(content: bytes) -> tuple[bytes, bytes]:
    """JSON and binary chunk of a .glb."""
    version = struct.unpack_from("<I", content, 4)[0]
    if version != 2:
        raise InputError("version of glTF", expected=2, got=version)
    text, binary, at = b"", b"", 12
    while at + 8 <= len(content):
        size, kind = struct.unpack_from("<II", content, at)
        chunk = content[at + 8 : at + 8 + size]
        if len(chunk) < size:
            raise InputError("glTF file", expected=f"{size} bytes", got="an end before")
        if kind == _JSON:
            text = chunk
        elif kind == _BIN and not binary:
            binary = chunk
        at += 8 + size + -size % 4
    return text, binary


def _read(document: GltfDocument) -> tuple[MocapTree, dict[str, int] | None]:
    nodes = document.json.get("nodes", [])
    animations = document.json.get("animations", [])
    if not animations:
        raise InputError("glTF file", expected="an animation", got="none")
    parents = parents_of(nodes)
    turned = [sum(channel["target"]["path"] == "rotation" for channel in one["channels"]) for one in animations]
    taken = next(k for k, count in enumerate(turned) if 2 * count >= max(turned))  # not a face's or a camera's
    animation = animations.pop(taken)
    tracks = tracks_of(document, animation)
    if not tracks:
        raise InputError("animation", expected="rotations of nodes", got="none")
    fps, times = _times([times for times, _, _ in tracks.values()])
    document.budget.take(len(times) * len(nodes) * 8 * 24, "animation")
    order, positions, rotations = _world(nodes, parents, tracks, times)
    joints = _kept(document, nodes, parents, {node for node, _ in tracks})
    kept = [node for node in order if node in joints]
    names = unique_names(["scene", *(str(nodes[node].get("name") or f"node {node}") for node in kept)])
    above = [-1, *(1 + kept.index(parents[node]) if parents[node] in joints else 0 for node in kept)]
    still = np.zeros((len(times), 1, 3)), np.tile(np.eye(3), (len(times), 1, 1, 1))
    notes: tuple[str, ...] = ()
    if animations:
        others = ", ".join(str(other.get("name", "one without a name")) for other in animations)
        notes = (f"of the file's animations {animation.get('name', taken)} is taken; left out: {others}",)
    world = np.concatenate([still[0], positions[:, kept]], 1), np.concatenate([still[1], rotations[:, kept]], 1)
    tree = world_tree(names, above, *world, fps, notes)
    humanoid = _humanoid(document.json)
    if humanoid is None:
        return tree, None
    return tree, {ours: 1 + kept.index(node) for ours, node in humanoid.items() if node in joints}


def parents_of(nodes: list[dict[str, Any]]) -> list[int]:
    """[N] parent of each node, −1 for roots; a node has one, and none is above itself."""
    parents = [-1] * len(nodes)
    for node, content in enumerate(nodes):
        for child in content.get("children", ()):
            if not 0 <= child < len(nodes) or parents[child] >= 0:
                raise InputError("nodes", expected="one parent each", got=f"several of node {child}")
            parents[child] = node
    for node in range(len(nodes)):
        above, steps = parents[node], 0
        while above >= 0:
            above, steps = parents[above], steps + 1
            if steps > len(nodes):
                raise InputError("nodes", expected="a tree", got="a circle")
    return parents


def tracks_of(document: GltfDocument, animation: dict[str, Any], nodes: Collection[int] | None = None) -> Tracks:
    """Times [K], values [K, C] (of splines [K, 3, C]) and interpolation by (node, path), of all or some ``nodes``."""
    tracks: Tracks = {}
    count = len(document.json.get("nodes", ()))
    for channel in animation["channels"]:
        target, sampler = channel["target"], animation["samplers"][channel["sampler"]]
        node, path = target.get("node"), target["path"]
        if path not in _PATHS or node is None or (nodes is not None and node not in nodes):
            continue
        if not 0 <= node < count:
            raise InputError("animation", expected=f"one of {count} nodes", got=node)
        times, values = document.numbers(sampler["input"])[:, 0], document.numbers(sampler["output"])
        method = sampler.get("interpolation", "LINEAR")
        each = 3 if method == "CUBICSPLINE" else 1
        if values.shape != (each * len(times), _PATHS[path]) or not len(times) or (np.diff(times) < 0).any():
            raise InputError("animation", expected="a value for each of ascending times", got=f"{len(values)} values")
        tracks[node, path] = times, values.reshape(len(times), each, -1) if each == 3 else values, method
    return tracks


def _times(keys: list[Floats]) -> tuple[float, Floats]:
    """Frames per second, and the times [F] s of frames from the first key to the last."""
    first, last = min(times[0] for times in keys), max(times[-1] for times in keys)
    densest = max(keys, key=len)
    fps = _FPS
    if len(densest) > 2 and (step := float(np.median(np.diff(densest)))) > 0:
        low, high = _FPS_LIMITS
        fps = 1 / step if low <= 1 / step <= high else _FPS
        fps = float(round(fps)) if abs(round(fps) - fps) < _ROUNDED * fps else fps
    frames = int(np.floor((last - first) * fps + 1e-3)) + 1
    if not 0 < frames <= MAX_FRAMES:
        raise InputError("animation", expected=f"at most {MAX_FRAMES} frames", got=frames)
    return fps, np.minimum(first + np.arange(frames) / fps, last)


def _sampled(track: tuple[Floats, Floats, str], times: Floats, rotation: bool) -> Floats:
    """Values [F, C] at ``times`` by the track's interpolation (glTF 2.0, appendix C)."""
    keys, values, method = track
    if len(keys) == 1:
        value = values[0, 1] if method == "CUBICSPLINE" else values[0]
        return np.broadcast_to(value, (len(times), len(value)))
    after = np.clip(np.searchsorted(keys, times, side="right"), 1, len(keys) - 1)
    step = np.maximum(keys[after] - keys[after - 1], 1e-9)
    t = np.clip((times - keys[after - 1]) / step, 0, 1)[:, None]
    if method == "STEP":
        reached = times >= keys[after] - _ROUNDED * step  # keys are single-precision
        return np.where(reached[:, None], values[after], values[after - 1])
    if method == "CUBICSPLINE":
        (_, a, out), (into, b, _) = values[after - 1].swapaxes(0, 1), values[after].swapaxes(0, 1)
        out, into = step[:, None] * out, step[:, None] * into
        cube, square = t**3, t**2
        cubic: Floats = a + (3 * square - 2 * cube) * (b - a) + (cube - 2 * square + t) * out + (cube - square) * into
        return cubic
    a, b = values[after - 1], values[after]
    if not rotation:
        return (1 - t) * a + t * b
    lengths = np.linalg.norm(a, axis=-1, keepdims=True) * np.linalg.norm(b, axis=-1, keepdims=True)
    cosine = (a * b).sum(-1, keepdims=True) / np.maximum(lengths, 1e-9)
    b, cosine = np.where(cosine < 0, -b, b), np.abs(cosine)
    angle = np.arccos(np.minimum(cosine, 1))
    sine = np.sin(angle)
    near = sine < 1e-6
    safe = np.where(near, 1, sine)
    return np.where(near, (1 - t) * a + t * b, (np.sin((1 - t) * angle) * a + np.sin(t * angle) * b) / safe)


def _world(
    nodes: list[dict[str, Any]], parents: list[int], tracks: Tracks, times: Floats
) -> tuple[list[int], Floats, Floats]:
    """Nodes with parents first, their world positions [F, N, 3], and rotations [F, N, 3, 3] without scale.

    Those of a mirrored node are its matrices times −1, as fixed to it as its own axes.
    """
    depth = {-1: -1}
    for node in range(len(nodes)):
        chain = [node]
        while parents[chain[-1]] not in depth:
            chain.append(parents[chain[-1]])
        for above in reversed(chain):
            depth[above] = depth[parents[above]] + 1
    order = sorted(range(len(nodes)), key=lambda node: depth[node])
    positions, rotations = np.zeros((len(times), len(nodes), 3)), np.zeros((len(times), len(nodes), 3, 3))
    linear = np.zeros((len(times), len(nodes), 3, 3))
    for node in order:
        turn, place, scale = local_parts(nodes, node, tracks, times)
        local, flipped = turn * scale[..., None, :], turn * np.where(scale < 0, -1.0, 1.0)[..., None, :]
        above = parents[node]
        if above < 0:
            linear[:, node], rotations[:, node], positions[:, node] = local, flipped, place
        else:
            linear[:, node], rotations[:, node] = linear[:, above] @ local, rotations[:, above] @ flipped
            step = np.einsum("fij,fj->fi", linear[:, above], np.broadcast_to(place, (len(times), 3)))
            positions[:, node] = positions[:, above] + step
    return order, positions, rotations * np.sign(np.linalg.det(rotations))[..., None, None]


def local_parts(nodes: list[dict[str, Any]], node: int, tracks: Tracks, times: Floats) -> tuple[Floats, Floats, Floats]:
    """Rotation [3, 3], translation [3] and scale [3] of ``node`` below its parent; [F, …] where they are animated."""
    quaternion, place, scale = (
        _sampled(tracks[node, path], times, path == "rotation") if (node, path) in tracks else value
        for path, value in zip(("rotation", "translation", "scale"), _rest(nodes[node]))
    )
    if (np.linalg.norm(quaternion, axis=-1) < 1e-6).any():
        raise InputError(f"rotation of node {node}", expected="a quaternion", got="zero")
    return quaternion_to_matrix(quaternion[..., [3, 0, 1, 2]]), place, scale


def _rest(node: dict[str, Any]) -> tuple[Floats, Floats, Floats]:
    """Quaternion xyzw, translation and scale of a node at rest."""
    if "matrix" in node:
        matrix = np.array(node["matrix"], np.float64).reshape(4, 4).T
        scale = np.linalg.norm(matrix[:3, :3], axis=0)
        scale[0] *= np.sign(np.linalg.det(matrix[:3, :3])) or 1.0  # a mirrored node
        wxyz = matrix_to_quaternion(matrix[:3, :3] / np.where(np.abs(scale) < 1e-12, 1e-12, scale))
        return wxyz[[1, 2, 3, 0]], matrix[:3, 3], scale
    parts = (node.get("rotation", [0, 0, 0, 1]), node.get("translation", [0, 0, 0]), node.get("scale", [1, 1, 1]))
    rotation, translation, scale = (np.array(part, np.float64) for part in parts)
    if (rotation.shape, translation.shape, scale.shape) != ((4,), (3,), (3,)):
        raise InputError("node", expected="rotation, translation and scale of 4, 3 and 3 numbers", got="others")
    return rotation, translation, scale


def _kept(document: GltfDocument, nodes: list[dict[str, Any]], parents: list[int], animated: set[int]) -> set[int]:
    """Nodes of the skeleton: joints of skins, animated nodes and humanoid bones, and all above them."""
    joints = set(animated)
    for skin in document.json.get("skins", []):
        joints |= set(skin.get("joints", ()))
    joints |= set((_humanoid(document.json) or {}).values())
    for node in list(joints):
        if not 0 <= node < len(nodes):
            raise InputError("joints", expected=f"some of {len(nodes)} nodes", got=node)
        while (node := parents[node]) >= 0:
            joints.add(node)
    return joints


def _humanoid(document: dict[str, Any]) -> dict[str, int] | None:
    """Node by SMPL's name where the file names VRM's humanoid bones, else None."""
    extensions = document.get("extensions", {})
    for name in ("VRMC_vrm_animation", "VRMC_vrm", "VRM"):
        bones = extensions.get(name, {}).get("humanoid", {}).get("humanBones")
        if isinstance(bones, list):  # VRM 0
            bones = {bone["bone"]: bone for bone in bones}
        if bones:
            return {_HUMANOID[bone]: int(value["node"]) for bone, value in bones.items() if bone in _HUMANOID}
    return None
