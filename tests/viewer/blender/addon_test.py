"""The Blender add-on in Blender's own Python, with the real rnd-play."""

from __future__ import annotations

import ast
import importlib.util
import json
import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

from rnd_runtime.avatar.avatar import Avatar
from rnd_runtime.motion.motion import load_motion
from rnd_runtime.shading.files.load import load_light
from rnd_runtime.shading.light import texel_directions, texel_solid_angles
from rnd_viewer.convert.cameras import read_cameras
from rnd_viewer.convert.cli import main
from rnd_viewer.inputs.cameras import file_path
from support.coarse_body import write_coarse_body
from support.paths import ROOT
from support.tiny import ASSETS

ADDON, SCENE = ROOT / "viewer/blender/rnd_avatar.py", ROOT / "tests/support/blender_scene.py"
LAMPS = ROOT / "tests/support/blender_lamps.py"
BLENDER = os.environ.get("BLENDER_PYTHON") or (sys.executable if importlib.util.find_spec("bpy") else None)
needs_blender = pytest.mark.skipif(BLENDER is None, reason="BLENDER_PYTHON names no Python with the module bpy")
FRAMES, SIZE, YAW, STRENGTH = (18, 20), (160, 200), 1.2, 1.5


def test_blender_finds_what_it_needs_in_the_file():
    """Blender reads bl_info without running the file; 4.2's Python has no packages but numpy."""
    tree = ast.parse(ADDON.read_text())
    info = next(
        ast.literal_eval(node.value)
        for node in tree.body
        if getattr(node, "targets", [None])[0:1]
        and isinstance(node, ast.Assign)
        and getattr(node.targets[0], "id", "") == "bl_info"
    )
    assert info["blender"] == (4, 2, 0) and info["name"] == "RnD-Avatar"
    imported = {
        alias.name.split(".")[0] if isinstance(node, ast.Import) else str(node.module)
        for node in ast.walk(tree)
        if isinstance(node, ast.Import | ast.ImportFrom)
        for alias in node.names
    }
    assert imported <= {"bpy", "numpy", "mathutils", *sys.stdlib_module_names}


def _run(script: Path, told: dict) -> dict:
    own = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    line = [str(BLENDER), str(script), json.dumps(told)]
    done = subprocess.run(line, capture_output=True, text=True, check=False, env=own)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    return json.loads(next(row for row in done.stdout.splitlines() if row.startswith("{")))


def _blender(out: Path, **told) -> dict:
    program = Path(sys.executable).with_name("rnd-play")
    values = {"glb": "", "hdr": str(ASSETS / "sky.exr"), "yaw": YAW, "strength": STRENGTH, "composite": False}
    values |= {"addon": str(ADDON), "avatar": str(ASSETS / "avatar.onnx"), "program": str(program), "out": str(out)}
    return _run(SCENE, values | {"frames": FRAMES, "size": SIZE} | told)


@pytest.fixture(scope="module")
def rendered(tmp_path_factory) -> tuple[dict, Path]:
    """The walk through Blender: our rig and its animation there, and back by the add-on."""
    pytest.importorskip("xatlas")
    out = tmp_path_factory.mktemp("blender")
    body = write_coarse_body(out / "body.npz")
    line = ["mesh", str(ASSETS / "avatar.onnx"), "--body", str(body), "--texture", "64"]
    assert main([*line, "--motion", str(ASSETS / "walk.npz"), "--out", str(out)]) == 0
    result = _blender(out, glb=str(out / "avatar.glb"), composite=True)
    assert "problem" not in result, result
    return result, out


@needs_blender
@pytest.mark.slow
def test_the_armatures_motion_is_the_walk(rendered):
    _, out = rendered
    skeleton = Avatar.load(ASSETS / "avatar.onnx", threads=1).skeleton
    back, walk = (load_motion(path, skeleton) for path in (out / "motion.npz", ASSETS / "walk.npz"))
    part = slice(FRAMES[0], FRAMES[1] + 1)
    np.testing.assert_allclose(back.rotations, walk.rotations[part], atol=1e-3)
    np.testing.assert_allclose(back.translations, walk.translations[part], atol=1e-5)
    assert back.fps == 30 and not back.notes


@needs_blender
@pytest.mark.slow
def test_the_camera_is_blenders_own_export(rendered):
    """By USD, which has a lens shift, and by glTF, which has none."""
    _, out = rendered
    ours = file_path(str(out / "camera.json"), None, range(3))
    by_gltf = read_cameras(out / "shot.glb", None, SIZE, 30.0)
    assert len(by_gltf) == 3
    for k, camera in enumerate(by_gltf):
        np.testing.assert_allclose(camera.world_to_camera, ours(k, 0).world_to_camera, atol=1e-3)
        np.testing.assert_allclose(np.diag(camera.K), np.diag(ours(k, 0).K), rtol=1e-4)
    pytest.importorskip("pxr")
    for k, camera in enumerate(read_cameras(out / "shot.usdc", None, SIZE, 30.0)):
        np.testing.assert_allclose(camera.world_to_camera, ours(k, 0).world_to_camera, atol=1e-4)
        np.testing.assert_allclose(camera.K, ours(k, 0).K, atol=1e-2)


@needs_blender
@pytest.mark.slow
def test_frames_come_back_with_depth(rendered):
    result, out = rendered
    assert result["source"] == "SEQUENCE" and result["shown"] == ["RnD-Avatar"]
    files = sorted((out / "frames/frames_exr").iterdir())
    assert [file.name for file in files] == [f"{k:06d}.exr" for k in range(3)] and result["file"] == str(files[0])
    settings = json.loads((out / "frames/play.json").read_text())["settings"]
    assert settings["hdr_yaw"] == pytest.approx(math.degrees(YAW), abs=1e-3)
    assert settings["exposure"] == pytest.approx(math.log2(STRENGTH), abs=1e-5)
    frame, combined = (oiio.ImageBuf(str(path)) for path in (files[2], out / "composite.exr"))
    names = frame.spec().channelnames
    assert {"Z", "normal.X", "albedo.R"} <= set(names)
    pixels, shown = frame.get_pixels("float"), combined.get_pixels("float")[..., :3]
    alpha, rgb = pixels[..., names.index("A")], pixels[..., :3]
    inside, outside = alpha > 0.999, alpha < 1e-3
    wall = np.abs(shown - [0, 0, 1]).max(axis=-1) < 0.02  # before the knees
    board = np.abs(shown - [0, 1, 1]).max(axis=-1) < 0.02  # behind the body
    body = np.abs(shown - rgb).max(axis=-1) < 0.02
    assert (inside & wall).sum() > 100 and (inside & body).sum() > 500 and (outside & board).sum() > 500
    assert (inside & (wall | body)).sum() > 0.95 * inside.sum() and not (inside & board).any()


@needs_blender
@pytest.mark.slow
def test_a_foreign_armature_and_a_plain_world_are_exported_or_refused(tmp_path):
    """Its bones mean nothing to rnd-play, whose line comes back; the world's colour became a probe."""
    result = _blender(tmp_path, hdr="")
    assert "joints" in result["problem"] or "rnd-play: " in result["problem"]
    assert (tmp_path / "motion.bvh").is_file()
    probe = oiio.ImageBuf(str(tmp_path / "world.exr")).get_pixels("float")
    np.testing.assert_allclose(probe[..., :3].reshape(-1, 3).mean(axis=0), [0.2, 0.4, 0.6], atol=1e-3)


@needs_blender
@pytest.mark.slow
def test_lamps_light_as_cycles_renders_them(tmp_path):
    """Irradiance of a floor below each kind of lamp; a sun in the exported map has it too, and the sun's direction."""
    told = _run(LAMPS, {"addon": str(ADDON), "out": str(tmp_path)})
    for kind, row in told["lamps"].items():
        np.testing.assert_allclose(row["ours"], row["cycles"], rtol=0.03, err_msg=kind)
    sun = told["lamps"]["SUN"]
    assert sun["radius"] == pytest.approx(math.radians(2))
    assert told["arguments"][0] == "--hdr" and told["arguments"][2:] == ["--exposure", "0"]
    light = load_light(told["arguments"][1])
    radiance, shape = light.radiance, light.radiance.shape[:2]
    texels, solid = texel_directions(*shape), texel_solid_angles(*shape)
    bright = np.where(radiance[..., :1] > 10, radiance, 0)
    x, y, z = sun["direction"]
    cosine = texels @ np.array([x, z, -y])
    across = (bright * (solid * cosine)[..., None]).sum((0, 1))
    np.testing.assert_allclose(across, [3, 1.5, 0.75], rtol=0.01)
    assert np.degrees(np.arccos(cosine[bright[..., 0] > 0].min())) < 2.5
