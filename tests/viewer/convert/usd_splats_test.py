"""A relit clip of splats in USD, read back by USD's own library and rendered."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rnd_runtime.avatar.avatar import Avatar
from rnd_runtime.core.images import linear_to_srgb, to_bytes
from rnd_runtime.motion.motion import load_motion
from rnd_runtime.playback.frame import FrameRenderer
from rnd_runtime.playback.framing import CameraOptions, frame_motion, front_path
from rnd_runtime.raster.cpu import rasterize
from rnd_runtime.raster.outline import sharpened
from rnd_viewer.convert.cli import main
from rnd_viewer.inputs.lights import chosen_light
from support.tiny import ASSETS

AVATAR, WALK, SKY = (str(ASSETS / name) for name in ("avatar.onnx", "walk.npz", "sky.exr"))


def test_usd_without_its_library_names_the_extra(monkeypatch, capsys, tmp_path):
    monkeypatch.setitem(__import__("sys").modules, "pxr", None)
    assert main(["splats", AVATAR, "--motion", WALK, "--format", "usd", "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert "usd-core" in error and "rnd-avatar[usd]" in error and not (tmp_path / "out").exists()


def test_a_clip_of_splats_shows_the_players_images(tmp_path):
    pytest.importorskip("pxr")
    from pxr import Usd, UsdGeom, UsdVol

    line = ["splats", AVATAR, "--motion", WALK, "--hdr", SKY, "--frames", "20:22", "--format", "usd"]
    assert main([*line, "--coding", "linear", "--out", str(tmp_path)]) == 0
    stage = Usd.Stage.Open(str(tmp_path / "splats.usdc"))
    assert UsdGeom.GetStageUpAxis(stage) == "Y" and UsdGeom.GetStageMetersPerUnit(stage) == 1
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode(), stage.GetTimeCodesPerSecond()) == (20, 21, 30)
    prim = stage.GetDefaultPrim()
    assert prim.IsA(UsdVol.ParticleField3DGaussianSplat)
    assert prim.GetAttribute("radiance:sphericalHarmonicsDegree").Get() == 0
    avatar = Avatar.load(AVATAR, threads=1)
    walk = load_motion(WALK, avatar.skeleton)
    camera = front_path(frame_motion(avatar.skeleton, walk), CameraOptions(288, 288, math.radians(35)))(0, 0.0)
    renderer = FrameRenderer(avatar, chosen_light(avatar, ASSETS / "sky.exr", up="y", yaw=0, exposure=0), camera)
    for code in (20, 21):
        names = ("positions", "scales", "opacities", "radiance:sphericalHarmonicsCoefficients")
        means, scales, opacities, sh = (np.array(prim.GetAttribute(name).Get(code)) for name in names)
        wxyz = np.array([[q.GetReal(), *q.GetImaginary()] for q in prim.GetAttribute("orientations").Get(code)])
        axes = Rotation.from_quat(wxyz[:, [1, 2, 3, 0]]).as_matrix() * scales[:, None, :]
        full = axes @ np.swapaxes(axes, 1, 2)
        covariances = full[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
        colours = 0.5 + 0.28209479177387814 * sh
        arrays = (np.ascontiguousarray(a, np.float32) for a in (means, covariances, opacities, colours))
        image = sharpened(rasterize(*arrays, camera)).image
        played = renderer.render(walk, code / walk.fps)
        again = to_bytes(linear_to_srgb(image)).astype(int)
        assert np.abs(again - played.srgb).max() <= 1  # of 255
        low, high = np.array(prim.GetAttribute("extent").Get(code))
        assert (means >= low).all() and (means <= high).all()
