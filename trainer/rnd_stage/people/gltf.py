"""Skinned glTF 2.0 (.glb, .gltf): the first skin's meshes, with what trimesh leaves out: joints and weights."""

from __future__ import annotations

import base64
import json
import struct
import urllib.parse
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import existing_file
from rnd_runtime.core.images import read_image
from rnd_runtime.core.rotations import quaternion_to_matrix
from rnd_runtime.core.signals import temporary_folder

from .character import Character, Floats, sample_texture

_TYPES = {5120: np.int8, 5121: np.uint8, 5122: np.int16, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}
_SHAPES = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
_GLB, _JSON, _BIN = 0x46546C67, 0x4E4F534A, 0x004E4942


def read_gltf(path: Path) -> Character:
    """Read the skinned meshes of a glTF file, in the pose they were bound in and where its nodes put the skeleton.

    Raises:
        InputError: not glTF 2.0, without a skin, compressed, or with indices that lead nowhere.
    """
    existing_file(path, what="character")
    try:
        document, binary = _open(path)
        return _Gltf(path, document, binary).character()
    except (KeyError, IndexError, ValueError, TypeError, struct.error, OSError) as error:
        raise InputError("not a skinned glTF", got=f"{type(error).__name__}: {error}", file=path) from error


def _open(path: Path) -> tuple[dict[str, Any], bytes]:
    content = path.read_bytes()
    if path.suffix.lower() == ".gltf":
        return json.loads(content), b""
    magic, version, _ = struct.unpack_from("<III", content)
    if magic != _GLB or version != 2:
        raise ValueError("no GLB of version 2")
    document, binary, offset = {}, b"", 12
    while offset < len(content):
        length, kind = struct.unpack_from("<II", content, offset)
        chunk = content[offset + 8 : offset + 8 + length]
        if kind == _JSON:
            document = json.loads(chunk)
        elif kind == _BIN:
            binary = chunk
        offset += 8 + length
    return document, binary


class _Gltf:
    """A parsed file and its buffers."""

    def __init__(self, path: Path, document: dict[str, Any], binary: bytes) -> None:
        self.path, self.document = path, document
        self.buffers = [self._bytes(entry.get("uri"), binary) for entry in document["buffers"]]

    def character(self) -> Character:
        skin = self.document["skins"][0]
        nodes = self.document["nodes"]
        joints = skin["joints"]
        names = tuple(nodes[j].get("name", f"joint{j}") for j in joints)
        above = {child: parent for parent, node in enumerate(nodes) for child in node.get("children", [])}
        parents = np.array([joints.index(above[j]) if above.get(j) in joints else -1 for j in joints])
        bind = self.accessor(skin["inverseBindMatrices"]).reshape(-1, 4, 4).swapaxes(1, 2)  # column-major
        top = int(np.argmin(parents))
        # A skinned point p is where jointWorld · inverseBind · p puts it: the same for all joints in the bound pose.
        # What the nodes above the skeleton do (metres, Y up) is in there, what a mesh's own node does is not.
        world = self._world(joints[top], above) @ bind[top]
        positions = _moved(np.asarray(np.linalg.inv(bind)[:, :3, 3], np.float64), world)
        parts = [
            self._primitive(primitive, len(joints))
            for node in nodes
            if node.get("skin") == 0
            for primitive in self.document["meshes"][node["mesh"]]["primitives"]
        ]
        if not parts:
            raise ValueError("no mesh has a skin")
        offsets = np.cumsum([0, *(len(part["vertices"]) for part in parts)])
        materials = [entry.get("name", f"material{k}") for k, entry in enumerate(self.document.get("materials", []))]
        material = [np.full(len(part["faces"]), part["material"]) for part in parts]
        joined = {
            name: np.concatenate([part[name] for part in parts])
            for name in ("vertices", "weights", "albedo", "opacity")
        }
        joined["vertices"] = _moved(joined["vertices"], world)
        return Character(
            faces=np.concatenate([part["faces"] + offset for part, offset in zip(parts, offsets)]),
            material=np.concatenate(material),
            materials=tuple(materials) or ("body",),
            joint_names=names,
            parents=parents,
            joints=positions,
            **joined,
        )

    def _world(self, node: int, above: dict[int, int]) -> Floats:
        """[4, 4] of a node at rest, with all that is above it."""
        chain = [node]
        while (parent := above.get(chain[-1])) is not None:
            if parent in chain:
                raise ValueError(f"node {parent} is above itself")
            chain.append(parent)
        world = np.eye(4)
        for number in reversed(chain):
            world = world @ _local(self.document["nodes"][number])
        return world

    def accessor(self, number: int) -> Floats:
        """The values of an accessor [N, C] as float64, integers scaled where it says so."""
        entry = self.document["accessors"][number]
        kind, columns = np.dtype(_TYPES[entry["componentType"]]), _SHAPES[entry["type"]]
        view = self.document["bufferViews"][entry["bufferView"]]
        start = view.get("byteOffset", 0) + entry.get("byteOffset", 0)
        stride = view.get("byteStride", kind.itemsize * columns)
        rows = np.ndarray((entry["count"], columns), kind, self.buffers[view["buffer"]], start, (stride, kind.itemsize))
        values = rows.astype(np.float64)
        return values / np.iinfo(kind.name).max if entry.get("normalized") else values

    def _primitive(self, primitive: dict[str, Any], joint_count: int) -> dict[str, Any]:
        if primitive.get("mode", 4) != 4:
            raise ValueError("only triangles are read")
        attributes = primitive["attributes"]
        vertices = self.accessor(attributes["POSITION"])
        faces = self.accessor(primitive["indices"]).astype(np.int64).reshape(-1, 3)
        weights = np.zeros((len(vertices), joint_count))
        layers = (k for k in range(4) if f"JOINTS_{k}" in attributes)
        for k in layers:
            joints = self.accessor(attributes[f"JOINTS_{k}"]).astype(np.int64)
            np.add.at(weights, (np.arange(len(vertices))[:, None], joints), self.accessor(attributes[f"WEIGHTS_{k}"]))
        uv = self.accessor(attributes["TEXCOORD_0"]) if "TEXCOORD_0" in attributes else None
        albedo, opacity = self._paint(primitive.get("material"), uv, len(vertices))
        number = primitive.get("material", 0)
        return {
            "vertices": vertices,
            "faces": faces,
            "weights": weights,
            "albedo": albedo,
            "opacity": opacity,
            "material": number,
        }

    def _paint(self, material: int | None, uv: Floats | None, count: int) -> tuple[Floats, Floats]:
        entry = {} if material is None else self.document["materials"][material]
        metal = entry.get("pbrMetallicRoughness", {})
        factor = np.array(metal.get("baseColorFactor", [1.0, 1, 1, 1]))
        albedo, opacity = np.ones((count, 3)), np.ones(count)
        if uv is not None and "baseColorTexture" in metal:
            image = self.document["textures"][metal["baseColorTexture"]["index"]]["source"]
            upwards = uv * [1, -1] + [0, 1]  # glTF's v points down
            albedo, opacity = sample_texture(self._image(image), upwards)
        if entry.get("alphaMode", "OPAQUE") == "OPAQUE":
            opacity = np.ones(count)
        return albedo * factor[:3], opacity * factor[3]

    def _image(self, number: int) -> NDArray[np.generic]:
        entry = self.document["images"][number]
        if "uri" in entry:
            content = self._bytes(entry["uri"], b"")
        else:
            view = self.document["bufferViews"][entry["bufferView"]]
            start = view.get("byteOffset", 0)
            content = self.buffers[view["buffer"]][start : start + view["byteLength"]]
        suffix = ".png" if content[:4] == b"\x89PNG" else ".jpg"
        with temporary_folder() as folder:
            file = folder / f"texture{suffix}"
            file.write_bytes(content)
            return read_image(file)

    def _bytes(self, uri: str | None, binary: bytes) -> bytes:
        """A buffer: the GLB's own, base64, or a file beside this one."""
        if uri is None:
            return binary
        if uri.startswith("data:"):
            return base64.b64decode(uri.partition(",")[2])
        beside = (self.path.parent / urllib.parse.unquote(uri)).resolve()
        if not beside.is_relative_to(self.path.parent.resolve()):
            raise ValueError(f"{uri} is not beside the file")
        return beside.read_bytes()


def _local(node: dict[str, Any]) -> Floats:
    """[4, 4] of a node in the one above it: its matrix, column by column, or scale, rotation and translation."""
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    rotation = quaternion_to_matrix(np.roll(node.get("rotation", (0.0, 0, 0, 1)), 1))
    local = np.eye(4)
    local[:3, :3] = rotation * np.array(node.get("scale", (1.0, 1, 1)))
    local[:3, 3] = node.get("translation", (0.0, 0, 0))
    return local


def _moved(points: Floats, motion: Floats) -> Floats:
    """``points`` [N, 3] after ``motion`` [4, 4]."""
    return points @ motion[:3, :3].T + motion[:3, 3]
