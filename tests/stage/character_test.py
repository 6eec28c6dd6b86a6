"""Characters from files: glTF and the project's own layout, renamed, straightened and freed."""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from support.paths import ASSETS

pytest.importorskip("mitsuba")
pytest.importorskip("skimage")

from rnd_runtime.capture.body import Body
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.images import linear_to_srgb, write_image
from rnd_runtime.core.npz import save_npz
from rnd_runtime.motion.smpl import SMPL_NAMES, SMPL_PARENTS
from rnd_stage.people import characters

pytestmark = pytest.mark.slow
MIXAMO = dict(
    zip(
        SMPL_NAMES,
        (
            *("Hips", "LeftUpLeg", "RightUpLeg", "Spine", "LeftLeg", "RightLeg", "Spine1", "LeftFoot"),
            *("RightFoot", "Spine2", "LeftToeBase", "RightToeBase", "Neck", "LeftShoulder", "RightShoulder"),
            *("Head", "LeftArm", "RightArm", "LeftForeArm", "RightForeArm", "LeftHand", "RightHand"),
            *("LeftHandMiddle1", "RightHandMiddle1"),
        ),
    )
)


@pytest.fixture(scope="module")
def body() -> Body:
    return Body.load(ASSETS / "body.npz")


def write_glb(path: Path, body: Body, above: dict | None = None) -> None:
    """The body as a skinned GLB with Mixamo's names and a four-coloured texture, its joints below a node ``above``."""
    order = np.argsort(-body.skinning_weights, axis=1)[:, :4]
    weights = np.take_along_axis(body.skinning_weights, order, axis=1)
    weights = weights / weights.sum(axis=1, keepdims=True)
    bind = np.tile(np.eye(4), (24, 1, 1))
    bind[:, :3, 3] = -body.skeleton.rest_joints
    pixels = np.zeros((2, 2, 3), np.uint8)
    pixels[0] = [[255, 0, 0], [0, 255, 0]]
    pixels[1] = [[0, 0, 255], [255, 255, 255]]
    write_image(path.with_suffix(".png"), pixels)
    uv = np.where(body.vertices[:, :1] > 0, 0.75, 0.25), np.where(body.vertices[:, 1:2] > 1, 0.25, 0.75)
    arrays = [
        (body.vertices.astype(np.float32), 5126, "VEC3"),
        (body.faces.astype(np.uint32).reshape(-1, 1), 5125, "SCALAR"),
        (order.astype(np.uint16), 5123, "VEC4"),
        (weights.astype(np.float32), 5126, "VEC4"),
        (np.concatenate(uv, axis=1).astype(np.float32), 5126, "VEC2"),
        (bind.swapaxes(1, 2).reshape(24, 16).astype(np.float32), 5126, "MAT4"),
    ]
    blobs = [array.tobytes() for array, _, _ in arrays] + [path.with_suffix(".png").read_bytes()]
    blobs = [blob + b"\0" * (-len(blob) % 4) for blob in blobs]
    starts = np.cumsum([0, *map(len, blobs)])
    views = [{"buffer": 0, "byteOffset": int(s), "byteLength": len(b)} for s, b in zip(starts, blobs)]
    names = [f"mixamorig:{MIXAMO[name]}" for name in SMPL_NAMES]
    shifts = body.skeleton.rest_joints - np.where(
        np.arange(24)[:, None] > 0, body.skeleton.rest_joints[np.maximum(SMPL_PARENTS, 0)], 0
    )
    nodes: list[dict] = [
        {"name": name, "children": [], "translation": shift.tolist()} for name, shift in zip(names, shifts)
    ]
    for child, parent in enumerate(SMPL_PARENTS[1:], 1):
        nodes[parent]["children"].append(child)
    document = {
        "asset": {"version": "2.0"},
        "nodes": [*nodes, {"mesh": 0, "skin": 0}, {"name": "Armature", "children": [0]} | (above or {})],
        "skins": [{"joints": list(range(24)), "inverseBindMatrices": 5}],
        "meshes": [
            {
                "primitives": [
                    {"indices": 1, "material": 0}
                    | {"attributes": {"POSITION": 0, "JOINTS_0": 2, "WEIGHTS_0": 3, "TEXCOORD_0": 4}}
                ]
            }
        ],
        "materials": [{"name": "shirt", "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        "textures": [{"source": 0}],
        "images": [{"bufferView": 6, "mimeType": "image/png"}],
        "accessors": [
            {"bufferView": k, "componentType": kind, "count": len(array), "type": shape}
            for k, (array, kind, shape) in enumerate(arrays)
        ],
        "bufferViews": views,
        "buffers": [{"byteLength": int(starts[-1])}],
    }
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    binary = b"".join(blobs)
    path.write_bytes(
        struct.pack("<III", 0x46546C67, 2, 28 + len(text) + len(binary))
        + struct.pack("<II", len(text), 0x4E4F534A)
        + text
        + struct.pack("<II", len(binary), 0x004E4942)
        + binary
    )


def test_a_skinned_glb_keeps_its_shape_weights_and_colours(body: Body, tmp_path: Path) -> None:
    write_glb(tmp_path / "person.glb", body)
    dressed = characters.load_character(tmp_path / "person.glb")
    assert dressed.body.skeleton.names == SMPL_NAMES
    assert len(dressed.vertices) == len(body.vertices)
    assert np.ptp(dressed.vertices[:, 1]) == pytest.approx(np.ptp(body.vertices[:, 1]), abs=0.02)
    np.testing.assert_allclose(dressed.weights.sum(axis=1), 1, atol=1e-5)
    elbow = SMPL_NAMES.index("left_elbow")
    assert abs(dressed.weights[:, elbow].sum() - body.skinning_weights[:, elbow].sum()) < 0.02 * len(body.vertices)
    head_left = (dressed.vertices[:, 1] > 1.5) & (dressed.vertices[:, 0] > 0.01)
    np.testing.assert_allclose(dressed.colour[head_left].mean(0), [0.03, 0.80, 0.03], atol=1e-6)
    assert (dressed.drape.radius > 0).all()  # its only material is a shirt


HALF = np.sqrt(0.5)
ABOVE = {
    "centimetres": (100 * np.eye(3), {"scale": [0.01, 0.01, 0.01]}),
    "Z up": ([[1, 0, 0], [0, 0, -1], [0, 1, 0]], {"rotation": [-HALF, 0, 0, HALF]}),
    "both, moved": (
        [[100, 0, 0], [0, 0, -100], [0, 100, 0]],
        {"matrix": [0.01, 0, 0, 0, 0, 0, -0.01, 0, 0, 0.01, 0, 0, 0.3, 1, 0.5, 1]},
    ),
}


@pytest.mark.parametrize("stored", ABOVE)
def test_a_node_above_the_skeleton_brings_it_to_metres_and_upright(body: Body, tmp_path: Path, stored: str) -> None:
    """As what was FBX once often is: mesh and binds in other units and axes, and a node that takes them to glTF's."""
    axes, node = np.array(ABOVE[stored][0]), ABOVE[stored][1]
    joints = body.skeleton.rest_joints @ axes.T
    theirs = Body(body.vertices @ axes.T, body.faces, body.skinning_weights, replace(body.skeleton, rest_joints=joints))
    write_glb(tmp_path / "plain.glb", body)
    write_glb(tmp_path / "theirs.glb", theirs, node)
    plain, dressed = (characters.load_character(tmp_path / f"{name}.glb") for name in ("plain", "theirs"))
    moved = np.array([0.3, 0, 0.5]) if "moved" in stored else np.zeros(3)  # they stand on the floor
    np.testing.assert_allclose(np.sort(dressed.vertices, 0), np.sort(plain.vertices + moved, 0), atol=1e-4)
    positions = dressed.body.skeleton.rest_joints
    np.testing.assert_allclose(positions, plain.body.skeleton.rest_joints + moved, atol=1e-4)


def test_who_is_as_tall_as_a_house_is_refused(body: Body, tmp_path: Path) -> None:
    joints = 100 * body.skeleton.rest_joints
    tall = Body(100 * body.vertices, body.faces, body.skinning_weights, replace(body.skeleton, rest_joints=joints))
    write_glb(tmp_path / "tall.glb", tall)
    said = r"tall\.glb: height of the character: expected 0\.4 to 2\.6 m along Y, got 17\d$"
    with pytest.raises(InputError, match=said):
        characters.load_character(tmp_path / "tall.glb")


def test_a_node_above_itself_is_refused(body: Body, tmp_path: Path) -> None:
    write_glb(tmp_path / "ring.glb", body, {"children": [0, 25]})
    with pytest.raises(InputError, match="node 25 is above itself"):
        characters.load_character(tmp_path / "ring.glb")


def test_buffers_with_spaces_and_suffixes_in_capitals_are_read(body: Body, tmp_path: Path) -> None:
    write_glb(tmp_path / "PERSON.GLB", body)
    content = (tmp_path / "PERSON.GLB").read_bytes()
    (length,) = struct.unpack_from("<I", content, 12)
    document = json.loads(content[20 : 20 + length])
    document["buffers"][0]["uri"] = "my%20person.bin"
    (tmp_path / "my person.bin").write_bytes(content[28 + length :])
    (tmp_path / "me.GLTF").write_text(json.dumps(document))
    one, other = (characters.load_character(tmp_path / name) for name in ("PERSON.GLB", "me.GLTF"))
    np.testing.assert_array_equal(one.vertices, other.vertices)


def test_bent_arms_are_straightened(body: Body, tmp_path: Path) -> None:
    """A character that stands with its arms down comes to the stage in a T-pose."""
    from rnd_runtime.core.rotations import axis_angle_to_matrix
    from rnd_runtime.motion.skeleton import bone_transforms

    rotations = np.tile(np.eye(3), (24, 1, 1))
    rotations[SMPL_NAMES.index("left_shoulder")] = axis_angle_to_matrix([0, 0, -0.9])
    rotations[SMPL_NAMES.index("right_shoulder")] = axis_angle_to_matrix([0, 0, 0.9])
    bones = bone_transforms(body.skeleton, rotations, np.zeros(3))
    blend = np.tensordot(body.skinning_weights, bones, axes=1)
    posed = np.einsum("vij,vj->vi", blend[:, :, :3], body.vertices) + blend[:, :, 3]
    joints = body.skeleton.joint_transforms(rotations, np.zeros(3))[:, :3, 3]
    lowered = Body(posed, body.faces, body.skinning_weights, replace(body.skeleton, rest_joints=joints))
    write_glb(tmp_path / "lowered.glb", lowered)
    dressed = characters.load_character(tmp_path / "lowered.glb")
    assert np.ptp(lowered.vertices[:, 0]) < 1.4
    assert np.ptp(dressed.vertices[:, 0]) == pytest.approx(np.ptp(body.vertices[:, 0]), abs=0.03)
    wrist, shoulder = (dressed.body.skeleton.rest_joints[SMPL_NAMES.index(f"left_{n}")] for n in ("wrist", "shoulder"))
    assert abs(wrist[1] - shoulder[1]) < 1e-6


def write_character(path: Path, body: Body, names: tuple[str, ...] = ("jeans", "skin")) -> None:
    """The body in the project's own layout: grey, jeans up to 1.5 m."""
    grey = np.full((4, 4, 4), round(255 * float(linear_to_srgb(0.2))), np.uint8)
    grey[..., 3] = 255
    write_image(path.with_name("cloth.png"), grey)
    save_npz(
        path,
        {
            "vertices": body.vertices,
            "faces": body.faces,
            "uv": np.zeros((1, 2)),
            "face_uv": 0 * body.faces,
            "material": (body.vertices[body.faces[:, 0], 1] > 1.5).astype(np.uint8),
            "material_names": np.array(names),
            "textures": np.array(["cloth.png", "cloth.png"]),
            "weights": body.skinning_weights,
            "joint_names": np.array(SMPL_NAMES),
            "parents": np.array(SMPL_PARENTS),
            "joints": body.skeleton.rest_joints,
        },
    )


def test_the_project_layout_is_read_with_its_textures(body: Body, tmp_path: Path) -> None:
    write_character(tmp_path / "person.npz", body)
    dressed = characters.load_character(tmp_path / "person.npz")
    np.testing.assert_allclose(dressed.colour, 0.2, atol=0.005)
    cloth = dressed.drape.radius > 0
    assert 0.5 < cloth.mean() < 0.95 and dressed.vertices[cloth, 1].max() < 1.6
    assert set(np.round(dressed.roughness, 2)) == {0.45, 0.8}


def test_a_material_without_a_name_is_refused(body: Body, tmp_path: Path) -> None:
    write_character(tmp_path / "person.npz", body, ("jeans",))
    with pytest.raises(InputError, match=r"person\.npz: material: expected indices below 1, got 1"):
        characters.load_character(tmp_path / "person.npz")


def test_skin_under_clothes_is_tucked_in(body: Body) -> None:
    """A shirt 5 mm over the trunk: the skin below it sinks, what is bare stays, and so does the shirt."""
    from rnd_stage.people.remesh import vertex_normals

    normals = vertex_normals(body.vertices, body.faces)
    height = body.vertices[body.faces][:, :, 1]
    trunk = body.faces[(height > 0.95).all(1) & (height < 1.35).all(1)]
    worn, shirt = np.unique(trunk, return_inverse=True)
    count = len(body.vertices)
    vertices = np.concatenate([body.vertices, body.vertices[worn] + 0.005 * normals[worn]])
    faces = np.concatenate([body.faces, shirt.reshape(-1, 3) + count])
    weights = np.concatenate([body.skinning_weights, body.skinning_weights[worn]])
    of_vertex = np.repeat([0, 1], [count, len(worn)])
    tucked = characters._tucked_in(vertices, faces, weights, of_vertex, ("skin", "shirt"))
    moved = np.linalg.norm(tucked - vertices, axis=1)
    y, x = body.vertices[:, 1], np.abs(body.vertices[:, 0])
    belly = (y > 1.05) & (y < 1.2) & (x < 0.2)
    np.testing.assert_allclose((vertices - tucked)[:count][belly], characters.SUNK * normals[belly], atol=1e-9)
    assert moved[:count][(y < 0.9) | (y > 1.5) | (x > 0.4)].max() == 0
    assert moved[count:].max() == 0


@pytest.mark.parametrize("name", ["person.obj", "person.glb", "missing.npz"])
def test_other_files_are_refused(name: str, tmp_path: Path) -> None:
    if name == "person.glb":
        (tmp_path / name).write_bytes(b"glTF\2\0\0\0\x0c\0\0\0")
    with pytest.raises(InputError):
        characters.load_character(tmp_path / name)


def test_a_character_without_arms_is_refused(body: Body, tmp_path: Path) -> None:
    write_glb(tmp_path / "person.glb", body)
    content = (tmp_path / "person.glb").read_bytes().replace(b"LeftArm", b"Leftxxx")
    (tmp_path / "person.glb").write_bytes(content)
    with pytest.raises(InputError, match="left_shoulder"):
        characters.load_character(tmp_path / "person.glb")
