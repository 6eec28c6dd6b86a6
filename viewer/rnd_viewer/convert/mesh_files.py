"""The posed template as a mesh: OBJ for one frame, glTF binary with skeleton, weights and the whole motion."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.capture.body import Body
from rnd_runtime.core.files import atomic_path
from rnd_runtime.core.rotations import matrix_to_quaternion
from rnd_runtime.motion.motion import Motion

from .glb import ELEMENT_ARRAY_BUFFER, FLOAT, UNSIGNED_BYTE, UNSIGNED_INT, UNSIGNED_SHORT, GlbBuilder

Floats = NDArray[np.float64]
PER_SET = 4  # joints in one JOINTS_n attribute


def vertex_normals(vertices: Floats, faces: NDArray[np.int32]) -> Floats:
    """Area-weighted unit normals [V, 3]; Y where a vertex has no face."""
    corners = vertices[faces]
    crosses = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(normals, faces[:, corner], crosses)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    unit: Floats = np.where(lengths > 0, normals / np.where(lengths > 0, lengths, 1), [0.0, 1.0, 0.0])
    return unit


def write_obj(path: Path, vertices: Floats, faces: NDArray[np.int32]) -> None:
    """Wavefront OBJ with normals; metres, Y up."""
    lines = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in vertices.tolist()]
    lines += [f"vn {x:.4f} {y:.4f} {z:.4f}" for x, y, z in vertex_normals(vertices, faces).tolist()]
    lines += [f"f {a}//{a} {b}//{b} {c}//{c}" for a, b, c in (faces + 1).tolist()]
    with atomic_path(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="ascii")


def write_rigged_glb(path: Path, body: Body, motion: Motion) -> None:
    """The rest mesh with its joints as nodes, all its weights, and ``motion`` as an animation.

    Weights are sorted: a reader of one JOINTS set gets the four strongest of each vertex.
    """
    glb = GlbBuilder()
    skeleton, joints = body.skeleton, len(body.skeleton)
    parents, rest = skeleton.parents, skeleton.rest_joints
    attributes = {
        "POSITION": glb.accessor(body.vertices, "VEC3", FLOAT, bounds=True),
        "NORMAL": glb.accessor(vertex_normals(body.vertices, body.faces), "VEC3", FLOAT),
        **_weight_sets(glb, body.skinning_weights),
    }
    indices = glb.accessor(body.faces.ravel(), "SCALAR", UNSIGNED_INT, target=ELEMENT_ARRAY_BUFFER)
    material = {"pbrMetallicRoughness": {"baseColorFactor": [0.6, 0.6, 0.6, 1], "metallicFactor": 0}}
    nodes: list[dict[str, Any]] = []
    for joint, name in enumerate(skeleton.names):
        children = np.flatnonzero(parents == joint).tolist()
        offset = rest[joint] - (rest[parents[joint]] if joint else 0)
        nodes.append({"name": name, "translation": offset.tolist()} | ({"children": children} if children else {}))
    nodes.append({"name": "body", "mesh": 0, "skin": 0})
    inverse = np.tile(np.eye(4), (joints, 1, 1))
    inverse[:, 3, :3] = -rest  # column-major: the translation is the last row of the array
    skin = {
        "joints": list(range(joints)),
        "skeleton": 0,
        "inverseBindMatrices": glb.accessor(inverse, "MAT4", FLOAT, target=None),
    }
    glb.write(
        path,
        {
            "scene": 0,
            "scenes": [{"nodes": [0, joints]}],
            "nodes": nodes,
            "meshes": [{"primitives": [{"attributes": attributes, "indices": indices, "material": 0}]}],
            "materials": [material],
            "skins": [skin],
            "animations": [_animation(glb, rest[0], motion)],
        },
    )


def _weight_sets(glb: GlbBuilder, weights: NDArray[np.float32]) -> dict[str, int]:
    """JOINTS_n and WEIGHTS_n, as many sets as the vertex with the most joints needs."""
    sets = -(-int((weights > 0).sum(axis=1).max()) // PER_SET)
    order = np.argsort(-weights, axis=1, kind="stable")[:, : PER_SET * sets]
    order = np.pad(order, ((0, 0), (0, PER_SET * sets - order.shape[1])))
    strongest = np.take_along_axis(weights, order, axis=1)
    strongest[:, weights.shape[1] :] = 0
    order[strongest == 0] = 0  # glTF requires joint 0 where the weight is 0
    component = UNSIGNED_BYTE if weights.shape[1] <= 256 else UNSIGNED_SHORT
    attributes = {}
    for k in range(sets):
        part = slice(PER_SET * k, PER_SET * (k + 1))
        attributes[f"JOINTS_{k}"] = glb.accessor(order[:, part], "VEC4", component)
        attributes[f"WEIGHTS_{k}"] = glb.accessor(strongest[:, part], "VEC4", FLOAT)
    return attributes


def _animation(glb: GlbBuilder, rest_root: Floats, motion: Motion) -> dict[str, Any]:
    """Joint rotations and root positions in every frame of ``motion``; a closed one ends with its first frame."""
    keys = np.arange(motion.frame_count + motion.closed)
    times = glb.accessor(keys / motion.fps, "SCALAR", FLOAT, target=None, bounds=True)
    frames = keys % motion.frame_count
    quaternions = matrix_to_quaternion(motion.rotations[frames])  # [K, J, 4]
    dots = (quaternions[1:] * quaternions[:-1]).sum(axis=-1)
    signs = np.cumprod(np.where(dots < 0, -1.0, 1.0), axis=0)
    quaternions[1:] *= signs[..., None]  # consecutive ones on one hemisphere, for players that lerp
    positions = glb.accessor(rest_root + motion.translations[frames], "VEC3", FLOAT, target=None)
    samplers = [{"input": times, "output": positions, "interpolation": "LINEAR"}]
    channels: list[dict[str, Any]] = [{"sampler": 0, "target": {"node": 0, "path": "translation"}}]
    for joint in range(motion.rotations.shape[1]):
        output = glb.accessor(quaternions[:, joint][:, [1, 2, 3, 0]], "VEC4", FLOAT, target=None)
        samplers.append({"input": times, "output": output, "interpolation": "LINEAR"})
        channels.append({"sampler": joint + 1, "target": {"node": joint, "path": "rotation"}})
    return {"name": "motion", "samplers": samplers, "channels": channels}
