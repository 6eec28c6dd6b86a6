"""The clothed surface as files: OBJ for one frame, glTF binary with skeleton, textures, weights and the motion."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.files import atomic_path
from rnd_runtime.core.images import write_image
from rnd_runtime.core.rotations import matrix_to_quaternion
from rnd_runtime.core.signals import temporary_folder
from rnd_runtime.motion.motion import Motion
from rnd_runtime.motion.skeleton import Skeleton

from .glb import ELEMENT_ARRAY_BUFFER, FLOAT, UNSIGNED_BYTE, UNSIGNED_INT, UNSIGNED_SHORT, GlbBuilder
from .surface import JOINTS, Surface, vertex_normals
from .texture import Textures, Unwrapped

Floats = NDArray[np.float64]
LINEAR_MIPMAP, LINEAR = 9987, 9729  # of glTF's samplers


def write_obj(path: Path, vertices: Floats, charts: Unwrapped, faces: NDArray[np.int32]) -> None:
    """Wavefront OBJ of ``vertices`` [V, 3] and ``faces`` [F, 3], with normals and UVs; metres, Y up."""
    lines = ["mtllib avatar.mtl", "usemtl avatar"]
    lines += [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in vertices.tolist()]
    lines += [f"vt {u:.6f} {v:.6f}" for u, v in charts.uv.tolist()]
    lines += [f"vn {x:.4f} {y:.4f} {z:.4f}" for x, y, z in vertex_normals(vertices, faces).tolist()]
    for corners, texels in zip((charts.original[charts.faces] + 1).tolist(), (charts.faces + 1).tolist()):
        lines.append("f " + " ".join(f"{k}/{t}/{k}" for k, t in zip(corners, texels)))
    with atomic_path(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="ascii")


def write_mtl(path: Path, albedo: str) -> None:
    """The material of ``write_obj``, its base colour the image ``albedo``."""
    with atomic_path(path) as temporary:
        temporary.write_text(f"newmtl avatar\nKd 1 1 1\nmap_Kd {albedo}\n", encoding="ascii")


def write_rigged_glb(
    path: Path, surface: Surface, charts: Unwrapped, textures: Textures, skeleton: Skeleton, motion: Motion
) -> None:
    """The textured surface at rest with joints as nodes, four weights a vertex, and ``motion`` as an animation."""
    glb, original = GlbBuilder(), charts.original
    joints, weights = strongest_joints(surface.weights[original])
    component = UNSIGNED_BYTE if len(skeleton) <= 256 else UNSIGNED_SHORT
    attributes = {
        "POSITION": glb.accessor(surface.vertices[original], "VEC3", FLOAT, bounds=True),
        "NORMAL": glb.accessor(surface.normals[original], "VEC3", FLOAT),
        "TANGENT": glb.accessor(charts.tangents, "VEC4", FLOAT),
        "TEXCOORD_0": glb.accessor(charts.uv * [1, -1] + [0, 1], "VEC2", FLOAT),  # v down
        "JOINTS_0": glb.accessor(joints, "VEC4", component),
        "WEIGHTS_0": glb.accessor(weights, "VEC4", FLOAT),
    }
    indices = glb.accessor(charts.faces.ravel(), "SCALAR", UNSIGNED_INT, target=ELEMENT_ARRAY_BUFFER)
    images = [glb.image(png_bytes(image)) for image in (textures.albedo, textures.normal, textures.material)]
    material = {
        "name": "avatar",
        "pbrMetallicRoughness": {
            "baseColorTexture": {"index": 0},
            "metallicRoughnessTexture": {"index": 2},
            "metallicFactor": 0,
        },
        "normalTexture": {"index": 1},
        "occlusionTexture": {"index": 2},
    }
    nodes: list[dict[str, Any]] = []
    rest, parents = skeleton.rest_joints, skeleton.parents
    for joint, name in enumerate(skeleton.names):
        children = np.flatnonzero(parents == joint).tolist()
        offset = rest[joint] - (rest[parents[joint]] if joint else 0)
        nodes.append({"name": name, "translation": offset.tolist()} | ({"children": children} if children else {}))
    nodes.append({"name": "body", "mesh": 0, "skin": 0})
    inverse = np.tile(np.eye(4), (len(skeleton), 1, 1))
    inverse[:, 3, :3] = -rest  # column-major: the translation is the last row of the array
    skin = {
        "joints": list(range(len(skeleton))),
        "skeleton": 0,
        "inverseBindMatrices": glb.accessor(inverse, "MAT4", FLOAT, target=None),
    }
    glb.write(
        path,
        {
            "scene": 0,
            "scenes": [{"nodes": [0, len(skeleton)]}],
            "nodes": nodes,
            "meshes": [{"primitives": [{"attributes": attributes, "indices": indices, "material": 0}]}],
            "materials": [material],
            "samplers": [{"magFilter": LINEAR, "minFilter": LINEAR_MIPMAP}],
            "textures": [{"sampler": 0, "source": image} for image in images],
            "skins": [skin],
            "animations": [_animation(glb, rest[0], motion)],
        },
    )


def strongest_joints(weights: NDArray[np.float32]) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
    """Joints and weights [V, 4] of ``weights`` [V, J], the largest first; joint 0 where the weight is 0."""
    order = np.argsort(-weights, axis=1, kind="stable")[:, :JOINTS]
    order = np.pad(order, ((0, 0), (0, JOINTS - order.shape[1])))
    strongest = np.take_along_axis(weights, order, axis=1)
    strongest[:, weights.shape[1] :] = 0
    order[strongest == 0] = 0
    return order, strongest / strongest.sum(axis=1, keepdims=True)


def png_bytes(image: NDArray[np.uint8]) -> bytes:
    """The PNG file of ``image`` [H, W, C]."""
    with temporary_folder() as folder:
        write_image(folder / "image.png", np.ascontiguousarray(image))
        return (folder / "image.png").read_bytes()


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
