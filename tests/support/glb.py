"""GLB files read by code independent of the writer."""

from __future__ import annotations

import json
import math
import struct
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
from scipy.spatial.transform import Rotation


def read_glb(path: Path):
    """The JSON of a GLB, and its accessors as arrays."""
    content = path.read_bytes()
    magic, version, length = struct.unpack_from("<4sII", content)
    assert (magic, version, length) == (b"glTF", 2, len(content))
    size, kind = struct.unpack_from("<I4s", content, 12)
    assert kind == b"JSON"
    document = json.loads(content[20 : 20 + size])
    start = 20 + size + 8
    assert struct.unpack_from("<I4s", content, 20 + size) == (len(content) - start, b"BIN\0")
    arrays = []
    for accessor in document["accessors"]:
        view = document["bufferViews"][accessor["bufferView"]]
        dtype = {5126: "<f4", 5121: "u1", 5123: "<u2", 5125: "<u4"}[accessor["componentType"]]
        shape = {"SCALAR": (), "VEC2": (2,), "VEC3": (3,), "VEC4": (4,), "MAT4": (4, 4)}[accessor["type"]]
        assert view["byteOffset"] % 4 == 0
        values = np.frombuffer(content, dtype, accessor["count"] * math.prod(shape), start + view["byteOffset"])
        arrays.append(values.reshape(-1, *shape))
    return document, arrays


def read_images(path: Path) -> list[np.ndarray]:
    """The PNG images of a GLB, uint8 [H, W, C]."""
    content = path.read_bytes()
    document, _ = read_glb(path)
    start = 20 + struct.unpack_from("<I", content, 12)[0] + 8
    images = []
    for number, image in enumerate(document["images"]):
        view = document["bufferViews"][image["bufferView"]]
        file = path.with_name(f"{path.stem}_{number}.png")
        file.write_bytes(content[start + view["byteOffset"] :][: view["byteLength"]])
        images.append(oiio.ImageBuf(str(file)).get_pixels("uint8"))
    return images


def posed_vertices(document, arrays, time_s: float) -> np.ndarray:
    """Vertices of a skinned GLB at a key time, by the words of the glTF specification."""
    nodes = document["nodes"]
    local = {k: [np.array(n.get("translation", [0, 0, 0])), Rotation.identity()] for k, n in enumerate(nodes)}
    animation = document["animations"][0]
    for channel in animation["channels"]:
        sampler = animation["samplers"][channel["sampler"]]
        key = int(np.abs(arrays[sampler["input"]] - time_s).argmin())
        value = arrays[sampler["output"]][key]
        if channel["target"]["path"] == "rotation":
            local[channel["target"]["node"]][1] = Rotation.from_quat(value)
        else:
            local[channel["target"]["node"]][0] = value
    world: dict[int, np.ndarray] = {}

    def visit(node: int, parent: np.ndarray) -> None:
        own = np.eye(4)
        own[:3, :3], own[:3, 3] = local[node][1].as_matrix(), local[node][0]
        world[node] = parent @ own
        for child in nodes[node].get("children", []):
            visit(child, world[node])

    for root in document["scenes"][0]["nodes"]:
        visit(root, np.eye(4))
    skin = document["skins"][0]
    inverse = np.swapaxes(arrays[skin["inverseBindMatrices"]], 1, 2).astype(np.float64)
    matrices = np.stack([world[joint] @ inverse[k] for k, joint in enumerate(skin["joints"])])
    attributes = document["meshes"][0]["primitives"][0]["attributes"]
    points = np.c_[arrays[attributes["POSITION"]].astype(np.float64), np.ones(len(arrays[0]))]
    posed = np.zeros((len(points), 4))
    for k in range(sum(name.startswith("JOINTS_") for name in attributes)):
        joints, weights = (arrays[attributes[f"{what}_{k}"]] for what in ("JOINTS", "WEIGHTS"))
        for slot in range(4):
            posed += weights[:, slot, None] * np.einsum("vrc,vc->vr", matrices[joints[:, slot]], points)
    return posed[:, :3]
