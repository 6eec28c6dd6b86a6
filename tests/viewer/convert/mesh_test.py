"""rnd-convert mesh: the files are read back by independent code, posed, rendered and put beside the player's frame."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import trimesh

from rnd_runtime.avatar.avatar import Avatar
from rnd_runtime.capture.body import Body, skin
from rnd_runtime.core.images import srgb_to_linear
from rnd_runtime.motion.motion import load_motion
from rnd_runtime.playback.frame import FrameRenderer
from rnd_runtime.playback.framing import CameraOptions, frame_motion, front_path
from rnd_runtime.shading.files.load import load_light
from rnd_viewer.convert.cli import main
from rnd_viewer.convert.surface import JOINTS, _on_simplex, _simplex_projection, clothed_surface, posed_weights
from rnd_viewer.convert.texture import tangent_frames
from support.coarse_body import write_coarse_body
from support.glb import posed_vertices, read_glb, read_images
from support.mesh_raster import rasterize, sampled
from support.tiny import ASSETS

AVATAR, BODY, WALK, SKY = (ASSETS / name for name in ("avatar.onnx", "body.npz", "walk.npz", "sky.exr"))
FRAME = 20
pytest.importorskip("xatlas")
VALIDATOR = Path(os.environ.get("GLTF_VALIDATOR", ""))  # the npm package gltf-validator's folder


@pytest.fixture(scope="module")
def coarse(tmp_path_factory) -> Path:
    return write_coarse_body(tmp_path_factory.mktemp("body") / "coarse.npz")


@pytest.fixture(scope="module")
def converted(coarse, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("mesh")
    line = ["mesh", str(AVATAR), "--body", str(coarse), "--motion", str(WALK), "--out", str(out), "--texture", "512"]
    assert main([*line, "--format", "glb,obj", "--frames", f"{FRAME}:{FRAME + 1}"]) == 0
    return out


@pytest.fixture(scope="module")
def played():
    """The player's frame and its camera."""
    avatar = Avatar.load(AVATAR, threads=1)
    walk = load_motion(WALK, avatar.skeleton)
    camera = front_path(frame_motion(avatar.skeleton, walk), CameraOptions(288, 288))(0, 0.0)
    frame = FrameRenderer(avatar, load_light(SKY)).render(walk, FRAME / walk.fps, camera, aovs=("albedo", "normal"))
    return frame, camera


@pytest.mark.slow
def test_the_mesh_looks_like_the_player(converted, played):
    """Outline, base colour and normals of the GLB at a key of its animation."""
    frame, camera = played
    document, arrays = read_glb(converted / "avatar.glb")
    primitive = document["meshes"][0]["primitives"][0]
    at = {name: arrays[index] for name, index in primitive["attributes"].items()}
    faces = arrays[primitive["indices"]].reshape(-1, 3).astype(np.int64)
    vertices = posed_vertices(document, arrays, FRAME / 30)
    covered = rasterize(vertices, faces, camera)
    opaque = frame.alpha > 0.5
    assert (covered.mask & opaque).sum() / (covered.mask | opaque).sum() > 0.93  # 0.978 with the whole template
    inside = (frame.alpha > 0.99)[covered.mask]
    assert inside.sum() > 2000
    base, normal, _ = (image / 255 for image in read_images(converted / "avatar.glb"))
    uv = covered.of(at["TEXCOORD_0"].astype(np.float64))
    albedo = srgb_to_linear(sampled(base, uv))
    wanted = frame.aovs["albedo"][covered.mask]
    assert np.abs(albedo - wanted)[inside].mean() < 0.03
    mean = np.abs(wanted[inside].mean(axis=0) - wanted)[inside].mean()
    assert np.abs(albedo - wanted)[inside].mean() < 0.4 * mean  # texture, not a grey mannequin
    moved = trimesh.Trimesh(vertices, faces, process=False, validate=False)
    merged = trimesh.Trimesh(vertices, faces, process=True)
    normals = merged.vertex_normals[merged.kdtree.query(moved.vertices)[1]]
    frames = tangent_frames(vertices, normals, at["TEXCOORD_0"] * [1, -1], faces)
    texel = sampled(normal, uv) * 2 - 1
    n, t = covered.of(normals), covered.of(frames[:, :3])
    b = at["TANGENT"][covered.corners[:, 0], 3:] * np.cross(n, t)
    bent = texel[:, :1] * t + texel[:, 1:2] * b + texel[:, 2:] * n
    bent = bent / np.linalg.norm(bent, axis=1, keepdims=True) @ camera.world_to_camera[:3, :3].T
    cosines = (bent * frame.aovs["normal"][covered.mask]).sum(axis=1)[inside]
    assert np.degrees(np.arccos(cosines.clip(-1, 1))).mean() < 14


@pytest.mark.slow
def test_four_joints_move_as_the_avatar(converted):
    document, arrays = read_glb(converted / "avatar.glb")
    attributes = document["meshes"][0]["primitives"][0]["attributes"]
    assert {name for name in attributes if name.startswith(("JOINTS", "WEIGHTS"))} == {"JOINTS_0", "WEIGHTS_0"}
    np.testing.assert_allclose(arrays[attributes["WEIGHTS_0"]].sum(axis=1), 1, atol=1e-6)
    lines = [line.split() for line in (converted / f"{FRAME:06d}.obj").read_text().splitlines()]
    posed = np.array([line[1:] for line in lines if line[0] == "v"], np.float64)
    corners = {tuple(corner.split("/")[::2]) for line in lines if line[0] == "f" for corner in line[1:]}
    assert all(vertex == normal and 1 <= int(vertex) <= len(posed) for vertex, normal in corners)
    ours = posed_vertices(document, arrays, FRAME / 30)
    distances = np.linalg.norm(ours[:, None] - posed[None], axis=-1).min(axis=1)
    assert distances.mean() < 1e-3 and distances.max() < 1e-2  # m


@pytest.mark.slow
def test_fitted_weights_are_better_than_the_templates_strongest(coarse):
    """On poses that they were not fitted to."""
    avatar, body = Avatar.load(AVATAR, threads=1), Body.load(coarse)
    walk = load_motion(WALK, avatar.skeleton)
    surface = clothed_surface(avatar, body, walk)
    assert ((surface.weights > 0).sum(axis=1) <= JOINTS).all()
    strongest = body.skinning_weights * (
        body.skinning_weights >= -np.sort(-body.skinning_weights, 1)[:, JOINTS - 1, None]
    )
    strongest /= strongest.sum(axis=1, keepdims=True)
    errors = []
    for frame in (37, 101):
        pose = posed_weights(avatar, walk, (frame + 0.5) / walk.fps)
        own = surface.posed(avatar, walk, (frame + 0.5) / walk.fps)
        for weights in (surface.weights, strongest):
            moved = skin(surface.vertices, weights.astype(np.float64), pose.bones)
            errors.append(np.linalg.norm(moved @ pose.root[:3, :3].T + pose.root[:3, 3] - own, axis=1).mean())
    assert max(errors[::2]) < 0.5e-3 and max(errors[::2]) < 0.5 * min(errors[1::2])


@pytest.mark.slow
@pytest.mark.skipif(not (VALIDATOR / "package.json").is_file(), reason="GLTF_VALIDATOR names no gltf-validator")
def test_khronos_validator_finds_nothing(converted):
    program = (
        "require(process.argv[1]).validateBytes(new Uint8Array(require('fs').readFileSync(process.argv[2])))"
        ".then(r => console.log(JSON.stringify(r.issues)))"
    )
    node = shutil.which("node")
    assert node
    line = [node, "-e", program, str(VALIDATOR), str(converted / "avatar.glb")]
    issues = json.loads(subprocess.run(line, capture_output=True, check=True, text=True).stdout)
    assert not issues["messages"], issues


@pytest.mark.slow
def test_usd_moves_as_the_glb(coarse, converted, tmp_path):
    pxr = pytest.importorskip("pxr")
    from pxr import Usd, UsdGeom, UsdSkel

    assert pxr
    line = ["mesh", str(AVATAR), "--body", str(coarse), "--motion", str(WALK), "--out", str(tmp_path)]
    assert main([*line, "--texture", "64", "--format", "usd"]) == 0
    stage = Usd.Stage.Open(str(tmp_path / "avatar.usdz"))
    assert UsdGeom.GetStageUpAxis(stage) == "Y" and UsdGeom.GetStageMetersPerUnit(stage) == 1
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode(), stage.GetTimeCodesPerSecond()) == (0, 131, 30)
    root = UsdSkel.Root(stage.GetDefaultPrim())
    cache = UsdSkel.Cache()
    cache.Populate(root, Usd.PrimDefaultPredicate)
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/avatar/mesh"))
    query = cache.GetSkelQuery(UsdSkel.Skeleton(stage.GetPrimAtPath("/avatar/skeleton")))
    points = mesh.GetPointsAttr().Get()
    skinned = cache.GetSkinningQuery(mesh.GetPrim())
    assert skinned.ComputeSkinnedPoints(query.ComputeSkinningTransforms(FRAME), points, FRAME)
    document, arrays = read_glb(converted / "avatar.glb")
    ours, there = posed_vertices(document, arrays, FRAME / 30), np.array(points)
    assert np.linalg.norm(ours[:, None] - there[None], axis=-1).min(axis=1).max() < 1e-4


@pytest.mark.slow
def test_a_loops_animation_ends_where_it_begins(coarse, tmp_path):
    """glTF's ends at its last key: without the first frame as that, the last interval would be left out."""
    line = ["mesh", str(AVATAR), "--body", str(coarse), "--motion", str(WALK), "--out", str(tmp_path), "--loop"]
    assert main([*line, "--texture", "64"]) == 0
    document, arrays = read_glb(tmp_path / "avatar.glb")
    for sampler in document["animations"][0]["samplers"]:
        times, values = arrays[sampler["input"]], arrays[sampler["output"]]
        assert len(times) == len(values) == 118 and times[-1] == pytest.approx(3.9)
        np.testing.assert_allclose(np.abs(values[-1]), np.abs(values[0]), atol=1e-6)  # q and −q turn alike


def test_weights_on_the_simplex_are_the_best():
    """Against all weights of a fine grid."""
    rng = np.random.default_rng(0)
    root = rng.normal(size=(20, 3, 3))
    gram, right = root @ np.swapaxes(root, 1, 2), rng.normal(size=(20, 3))
    got = _on_simplex(gram, right, np.full((20, 3), 1 / 3))
    assert (got >= 0).all()
    np.testing.assert_allclose(got.sum(axis=1), 1, atol=1e-9)
    a, b = np.meshgrid(np.linspace(0, 1, 201), np.linspace(0, 1, 201))
    grid = np.stack([a, b, 1 - a - b], axis=-1)[a + b <= 1]

    def cost(w: np.ndarray) -> np.ndarray:
        return 0.5 * np.einsum("vgi,vij,vgj->vg", w, gram, w) - np.einsum("vgi,vi->vg", w, right)

    best = cost(np.broadcast_to(grid, (20, *grid.shape))).min(axis=1)
    assert (cost(got[:, None])[:, 0] <= best + 1e-6).all()
    np.testing.assert_allclose(
        _simplex_projection(np.array([[2.0, 0, -1], [0.2, 0.3, 0.5]])), [[1, 0, 0], [0.2, 0.3, 0.5]]
    )


def test_tangents_follow_u():
    """On a plane, unrotated, and mirrored: the bitangent's sign tells."""
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    faces, normals = np.array([[0, 1, 2], [0, 2, 3]]), np.tile([0.0, 0, 1], (4, 1))
    for uv, expected in ((vertices[:, :2], [1, 0, 0, 1]), (vertices[:, :2] * [-1, 1], [-1, 0, 0, -1])):
        np.testing.assert_allclose(tangent_frames(vertices, normals, uv, faces), np.tile(expected, (4, 1)), atol=1e-12)
