"""rnd-convert: every file is read back by code independent of the writer, and rendered or posed again."""

from __future__ import annotations

import math
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import onnxruntime as ort
import pytest
from scipy.spatial.transform import Rotation

from rnd_runtime.avatar.avatar import Avatar
from rnd_runtime.capture.body import Body
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.images import linear_to_srgb, srgb_to_linear, to_bytes, write_image
from rnd_runtime.core.npz import save_npz
from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_runtime.motion.amass import write_amass
from rnd_runtime.motion.motion import load_motion
from rnd_runtime.motion.skeleton import Skeleton
from rnd_runtime.motion.smpl import SMPL_NAMES, SMPLH_NAMES
from rnd_runtime.playback.frame import FrameRenderer, in_root_frame
from rnd_runtime.playback.framing import CameraOptions, frame_motion, front_path
from rnd_runtime.raster.cpu import rasterize
from rnd_runtime.raster.outline import sharpened
from rnd_runtime.shading.files.load import load_light
from rnd_runtime.shading.shader import Shader
from rnd_viewer.convert.cli import main
from rnd_viewer.convert.splat_files import TRANSFORM
from rnd_viewer.convert.splats import fixed_colour, half_turned, make_splats, stored_colours
from rnd_viewer.convert.visionary import check_clip, packed, write_visionary
from support.glb import read_glb
from support.tiny import ASSETS, body

AVATAR, BODY = ASSETS / "avatar.onnx", ASSETS / "body.npz"
WALK, SKY = ASSETS / "walk.npz", ASSETS / "sky.exr"
SIDE = 288  # px; smaller bodies are rendered on a finer grid by the player
FRAME = 20
ONE_STEP = 1  # of 255: float32 logarithms and back
INSIDE = 0.99  # alpha above which nothing behind the body shows
CODED_PSNR = 33.0  # dB inside the body, where coded colours are blended; measured 35.9 (31.0 without correction)
PACKED_MEAN = 2.0  # of 255, inside the body: what SPZ, SOG and compressed PLY round
FITTED_MEAN = 1.5  # of 255: a degree-3 fit over all views against the shading of one; measured 0.93


def _ply(path: Path) -> dict[str, np.ndarray]:
    """The columns of a binary PLY of floats, by name."""
    content = path.read_bytes()
    header, _, data = content.partition(b"end_header\n")
    lines = header.decode("ascii").splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    names = [line.split()[2] for line in lines if line.startswith("property float ")]
    count = next(int(line.split()[2]) for line in lines if line.startswith("element vertex "))
    rows = np.frombuffer(data, "<f4").reshape(count, len(names))
    return dict(zip(names, rows.T.astype(np.float64)))


def _covariances(quaternions_xyzw: np.ndarray, scales: np.ndarray) -> np.ndarray:
    axes = Rotation.from_quat(quaternions_xyzw).as_matrix() * scales[:, None, :]
    full = axes @ np.swapaxes(axes, 1, 2)
    return full[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]


def _rendered(means, covariances, opacities, colours) -> np.ndarray:
    arrays = (np.ascontiguousarray(a, np.float32) for a in (means, covariances, opacities, colours))
    return sharpened(rasterize(*arrays, _camera())).image


def _rendered_ply(path: Path, half_turn: bool) -> np.ndarray:
    """The image of a PLY with colours of one view, as 3DGS says; blended as stored."""
    ply = _ply(path)
    means = np.stack([ply[k] for k in "xyz"], axis=-1)
    wxyz = np.stack([ply[f"rot_{k}"] for k in range(4)], axis=-1)
    scales = np.exp(np.stack([ply[f"scale_{k}"] for k in range(3)], axis=-1))
    covariances = _covariances(wxyz[:, [1, 2, 3, 0]], scales)
    if half_turn:
        means = means * [-1, -1, 1]
        covariances = covariances * [1, 1, -1, 1, -1, 1]
    colours = 0.5 + 0.28209479177387814 * np.stack([ply[f"f_dc_{k}"] for k in range(3)], axis=-1)
    return _rendered(means, covariances, 1 / (1 + np.exp(-ply["opacity"])), colours)


def _camera():
    skeleton = Avatar.load(AVATAR, threads=1).skeleton
    framing = frame_motion(skeleton, load_motion(WALK, skeleton))
    return front_path(framing, CameraOptions(SIDE, SIDE, math.radians(35), math.radians(5)))(0, 0.0)


@pytest.fixture(scope="module")
def played():
    """The frame that rnd-play shows."""
    avatar = Avatar.load(AVATAR, threads=1)
    walk, light = load_motion(WALK, avatar.skeleton), load_light(SKY)
    return FrameRenderer(avatar, light).render(walk, FRAME / walk.fps, _camera())


def _splats(folder: Path, *words: str, light: tuple[str, ...] = ("--hdr", str(SKY))) -> Path:
    line = ["splats", str(AVATAR), "--motion", str(WALK), "--out", str(folder), *light]
    assert main([*line, "--frames", f"{FRAME}:{FRAME + 1}", *words]) == 0
    return folder / f"{FRAME:06d}.ply"


def test_a_ply_shows_the_players_image(played, tmp_path):
    for words, half_turn in (((), True), (("--ply-axes", "y-up"), False)):
        path = _splats(tmp_path, "--coding", "linear", *words)
        again = to_bytes(linear_to_srgb(_rendered_ply(path, half_turn))).astype(int)
        assert (played.alpha > INSIDE).sum() > 500
        assert np.abs(again - played.srgb).max() <= ONE_STEP


def test_a_ply_for_viewers_blends_coded_colours(played, tmp_path):
    """Nearer by far than colours that are merely coded, and near enough to look the same."""
    inside = played.alpha > INSIDE
    path = _splats(tmp_path)
    corrected = to_bytes(_rendered_ply(path, True)).astype(int)
    psnr = 10 * np.log10(255**2 / np.mean((corrected - played.srgb)[inside] ** 2.0))
    assert psnr > CODED_PSNR
    _splats(tmp_path, "--coding", "linear")
    ply = _ply(path)
    merely = linear_to_srgb(0.5 + 0.28209479177387814 * np.stack([ply[f"f_dc_{k}"] for k in range(3)], -1))
    gaussians = Avatar.load(AVATAR, threads=1)
    posed = gaussians.pose(load_motion(WALK, gaussians.skeleton), FRAME / 30)
    plain = to_bytes(_rendered(posed.means, posed.covariances, posed.opacities, merely)).astype(int)
    assert np.mean((plain - played.srgb)[inside] ** 2.0) > 2.5 * np.mean((corrected - played.srgb)[inside] ** 2.0)


def test_ply_has_the_fields_of_3dgs_in_their_order(tmp_path):
    ply = _ply(_splats(tmp_path))
    assert list(ply)[:9] == ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    assert list(ply)[9:54] == [f"f_rest_{k}" for k in range(45)]
    assert list(ply)[54:] == ["opacity", *(f"scale_{k}" for k in range(3)), *(f"rot_{k}" for k in range(4))]
    assert ply["y"].mean() < -0.5  # Y down: a standing body is at negative heights
    lengths = sum(ply[f"n{k}"] ** 2 for k in "xyz")
    np.testing.assert_allclose(lengths, 1, atol=1e-4)


def test_a_ply_may_carry_the_material(tmp_path):
    ply = _ply(_splats(tmp_path, "--material"))
    assert list(ply)[62:] == ["albedo_0", "albedo_1", "albedo_2", "roughness", "ambient_visibility"]
    avatar = Avatar.load(AVATAR, threads=1)
    posed = avatar.pose(load_motion(WALK, avatar.skeleton), FRAME / 30)
    np.testing.assert_allclose(np.stack([ply[f"albedo_{k}"] for k in range(3)], -1), posed.albedo, atol=1e-6)
    np.testing.assert_allclose(ply["roughness"], posed.roughness, atol=1e-6)
    assert 0 <= ply["ambient_visibility"].min() < ply["ambient_visibility"].max() <= 1


def test_fitted_sh_gives_the_colour_of_any_view(played, tmp_path):
    ply = _ply(_splats(tmp_path, "--coding", "linear", "--sh-degree", "3"))
    means = np.stack([ply[k] for k in "xyz"], axis=-1)
    eye = _camera().position * [-1, -1, 1]
    x, y, z = ((means - eye) / np.linalg.norm(means - eye, axis=1, keepdims=True)).T
    basis = [  # the constants of the 3DGS authors' sh_utils
        np.full_like(x, 0.28209479177387814),
        *(-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x),
        *(1.0925484305920792 * x * y, -1.0925484305920792 * y * z),
        0.31539156525252005 * (2 * z * z - x * x - y * y),
        *(-1.0925484305920792 * x * z, 0.5462742152960396 * (x * x - y * y)),
        *(-0.5900435899266435 * y * (3 * x * x - y * y), 2.890611442640554 * x * y * z),
        -0.4570457994644658 * y * (4 * z * z - x * x - y * y),
        0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y),
        -0.4570457994644658 * x * (4 * z * z - x * x - y * y),
        *(1.445305721320277 * z * (x * x - y * y), -0.5900435899266435 * x * (x * x - 3 * y * y)),
    ]
    colours = np.empty((len(means), 3))
    for k in range(3):
        coefficients = [ply[f"f_dc_{k}"], *(ply[f"f_rest_{15 * k + j}"] for j in range(15))]
        colours[:, k] = 0.5 + sum(c * b for c, b in zip(coefficients, basis))
    wxyz = np.stack([ply[f"rot_{k}"] for k in range(4)], axis=-1)
    covariances = _covariances(wxyz[:, [1, 2, 3, 0]], np.exp(np.stack([ply[f"scale_{k}"] for k in range(3)], -1)))
    image = _rendered(
        means * [-1, -1, 1], covariances * [1, 1, -1, 1, -1, 1], 1 / (1 + np.exp(-ply["opacity"])), colours.clip(0)
    )
    again = to_bytes(linear_to_srgb(image)).astype(int)
    inside = played.alpha > INSIDE
    assert np.abs(again - played.srgb)[inside].mean() < FITTED_MEAN
    assert any(np.abs(ply[f"f_rest_{j}"]).max() > 1e-3 for j in range(45))


def test_gltf_splats_show_the_players_image(played, tmp_path):
    _splats(tmp_path, "--format", "glb", "--coding", "linear")
    document, arrays = read_glb(tmp_path / f"{FRAME:06d}.glb")
    assert document["extensionsUsed"] == ["KHR_gaussian_splatting"]
    primitive = document["meshes"][0]["primitives"][0]
    assert primitive["mode"] == 0
    extension = {"kernel": "ellipse", "colorSpace": "lin_rec709_display"}
    assert primitive["extensions"] == {"KHR_gaussian_splatting": extension}
    named = {name.split(":")[-1]: arrays[index] for name, index in primitive["attributes"].items()}
    assert set(named) == {"POSITION", "COLOR_0", "ROTATION", "SCALE", "OPACITY", "SH_DEGREE_0_COEF_0"}
    image = _rendered(
        named["POSITION"],
        _covariances(named["ROTATION"], named["SCALE"]),
        named["OPACITY"],
        0.5 + 0.28209479177387814 * named["SH_DEGREE_0_COEF_0"],
    )
    again = to_bytes(linear_to_srgb(image)).astype(int)
    assert np.abs(again - played.srgb).max() <= ONE_STEP


def test_a_probe_made_for_a_z_up_world_lights_as_the_player_has_it(tmp_path):
    """Half of the colours at least are others than under the same file taken for Y up."""
    y_up, z_up = (_ply(_splats(tmp_path / up, "--hdr-up", up, "--coding", "linear")) for up in "yz")
    avatar = Avatar.load(AVATAR, threads=1)
    walk = load_motion(WALK, avatar.skeleton)
    encoded = avatar.encode(walk, FRAME / walk.fps)
    shader, camera = in_root_frame(encoded.root, Shader(load_light(SKY, up="z"), "table+sun"), _camera())
    lit = shader.shade(avatar.posed(encoded), camera.position)
    stored = 0.5 + 0.28209479177387814 * np.stack([z_up[f"f_dc_{k}"] for k in range(3)], axis=-1)
    np.testing.assert_allclose(stored, lit, rtol=0, atol=1e-3)
    assert np.mean(np.abs(y_up["f_dc_1"] - z_up["f_dc_1"]) > 0.05) > 0.5


def test_splats_rotate_by_half_a_turn():
    avatar = Avatar.load(AVATAR, threads=1)
    posed = avatar.pose(load_motion(WALK, avatar.skeleton), 0.0)
    splats = make_splats(posed, fixed_colour(posed.albedo))
    turned = half_turned(splats)
    assert splats.quaternions[:, 0].min() >= 0 and turned.quaternions[:, 0].min() >= 0
    upright, over = (Rotation.from_quat(a.quaternions, scalar_first=True) for a in (splats, turned))
    expected = np.diag([-1.0, -1.0, 1.0]) @ upright.as_matrix()
    np.testing.assert_allclose(over.as_matrix(), expected, atol=1e-12)


def test_colours_of_unseen_gaussians_are_finite():
    avatar = Avatar.load(AVATAR, threads=1)
    posed = avatar.pose(load_motion(WALK, avatar.skeleton), 0.0)
    unseen = replace(posed, opacities=np.zeros_like(posed.opacities))
    assert np.isfinite(stored_colours(unseen, posed.albedo, "srgb", avatar.spacing)).all()


def test_gaussians_that_are_not_finite_are_left_out_and_counted(tmp_path, monkeypatch, capsys):
    posed = Avatar.posed

    def broken(avatar, encoded):
        gaussians = posed(avatar, encoded)
        covariances, visibility = gaussians.covariances.copy(), gaussians.visibility.copy()
        covariances[5, 2], visibility[9, 3] = np.nan, np.inf
        return replace(gaussians, covariances=covariances, visibility=visibility)

    monkeypatch.setattr(Avatar, "posed", broken)
    ply = _ply(_splats(tmp_path))
    assert len(ply["x"]) == Avatar.load(AVATAR, threads=1).gaussians - 2
    assert all(np.isfinite(column).all() for column in ply.values())
    assert "note: Gaussians with numbers that are not finite were left out, 2 of" in capsys.readouterr().err


def test_faults_of_a_light_are_reported(tmp_path, capsys):
    broken = np.ones((16, 32, 3), np.float32)
    broken[3, 4] = np.nan
    write_image(tmp_path / "nan.exr", broken)
    _splats(tmp_path, light=("--hdr", str(tmp_path / "nan.exr")))
    assert "note: 1 texels of the light" in capsys.readouterr().err


def test_albedo_is_the_materials(tmp_path):
    ply = _ply(_splats(tmp_path, "--colour", "albedo", "--coding", "linear", light=()))
    albedo = Avatar.load(AVATAR, threads=1).pose(load_motion(WALK, body().skeleton), 0.0).albedo
    for k in range(3):
        np.testing.assert_allclose(0.5 + 0.28209479177387814 * ply[f"f_dc_{k}"], albedo[:, k], atol=1e-6)


def test_spz_and_sog_name_the_program_they_need(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("PATH", str(tmp_path))
    line = ["splats", str(AVATAR), "--motion", str(WALK), "--out", str(tmp_path), "--format", "spz"]
    assert main(line) == 2
    error = capsys.readouterr().err
    assert "splat-transform, which is not installed (npm install -g @playcanvas/splat-transform)" in error


def test_a_clip_for_visionary_is_its_frames(tmp_path):
    """The graph by itself, at times within, between and beyond the frames, against the PLY of each."""
    line = ["splats", str(AVATAR), "--motion", str(WALK), "--hdr", str(SKY), "--out", str(tmp_path)]
    assert main([*line, "--frames", "10:13", "--format", "ply,visionary"]) == 0
    model = onnx.load(tmp_path / "visionary.onnx")
    onnx.checker.check_model(model, full_check=True)
    session = ort.InferenceSession(tmp_path / "visionary.onnx", providers=["CPUExecutionProvider"])
    count, fps = Avatar.load(AVATAR, threads=1).gaussians, 30.0
    assert [(i.name, i.type, i.shape) for i in session.get_inputs()] == [("time", "tensor(float)", [1])]
    assert [(o.name, o.type, o.shape) for o in session.get_outputs()] == [
        ("gaussian_f32", "tensor(float)", [count, 10]),
        ("color_rgb", "tensor(float)", [count, 4]),
        ("num_points", "tensor(int32)", [1]),
    ]
    for time, frame in ((0.0, 10), (1 / fps, 11), (1.9 / fps, 11), (2 / fps, 12), (3 / fps, 10), (3001 / fps, 11)):
        gaussians, colours, points = session.run(None, {"time": np.array([time], np.float32)})
        assert points == count and (colours[:, 3] == 1).all()
        covariances = gaussians[:, 4:] * [1, 1, -1, 1, -1, 1]
        image = _rendered(gaussians[:, :3] * [-1, -1, 1], covariances, gaussians[:, 3], colours[:, :3])
        wanted = _rendered_ply(tmp_path / f"{frame:06d}.ply", True)
        assert np.abs(to_bytes(image).astype(int) - to_bytes(wanted)).max() <= ONE_STEP, time


def test_clips_that_visionary_cannot_show_are_refused(tmp_path):
    check_clip(2**27 // (40 * 30_000), 30_000)
    with pytest.raises(InputError, match="--frames: expected at most 111 of this avatar for visionary, got 112"):
        check_clip(112, 30_000)
    avatar = Avatar.load(AVATAR, threads=1)
    posed = avatar.pose(load_motion(WALK, avatar.skeleton), 0.0)
    parts = [posed.only(np.arange(count)) for count in (7, 9)]
    clip = [packed(make_splats(part, fixed_colour(part.albedo))) for part in parts]
    with pytest.raises(InputError, match="as many finite Gaussians in every frame, got 7 to 9"):
        write_visionary(tmp_path / "clip.onnx", clip, 30.0)


def test_viewers_without_the_extension_get_linear_colours(tmp_path):
    """COLOR_0 is linear in glTF, however the SH coefficients are coded."""
    for coding, decoded in (("linear", np.asarray), ("srgb", srgb_to_linear)):
        _splats(tmp_path, "--format", "glb", "--coding", coding)
        document, arrays = read_glb(tmp_path / f"{FRAME:06d}.glb")
        attributes = document["meshes"][0]["primitives"][0]["attributes"]
        sh = arrays[attributes["KHR_gaussian_splatting:SH_DEGREE_0_COEF_0"]]
        colour = decoded((0.5 + 0.28209479177387814 * sh).clip(0, 1))
        np.testing.assert_allclose(arrays[attributes["COLOR_0"]][:, :3], colour, atol=1e-6)


@pytest.mark.skipif(shutil.which(TRANSFORM) is None, reason="splat-transform is not installed")
def test_splat_transform_understands_our_ply(tmp_path):
    """Its glTF of our PLY, rotated upright again with all SH coefficients, is our glTF."""
    ply = _splats(tmp_path, "--format", "ply,glb", "--sh-degree", "3")
    ours, theirs = (read_glb(path) for path in (ply.with_suffix(".glb"), _transformed(ply, tmp_path / "theirs.glb")))
    attributes = [document["meshes"][0]["primitives"][0]["attributes"] for document, _ in (ours, theirs)]
    assert attributes[0].keys() == attributes[1].keys()
    for name in attributes[0].keys() - {"COLOR_0"}:
        a, b = (arrays[which[name]] for which, (_, arrays) in zip(attributes, (ours, theirs)))
        if name.endswith("ROTATION"):
            b = b * np.sign((a * b).sum(axis=1, keepdims=True))  # q and −q are one rotation
        np.testing.assert_allclose(a, b, atol=1e-5, err_msg=name)


@pytest.mark.skipif(shutil.which(TRANSFORM) is None, reason="splat-transform is not installed")
def test_compressed_splats_show_the_same_image(tmp_path):
    """SPZ and SOG as we have them made, and its compressed PLY: read back by it, they are our image."""
    ply = _splats(tmp_path, "--format", "ply,spz,sog")
    wanted = to_bytes(_rendered_ply(ply, True)).astype(int)
    packed = [ply.with_suffix(".spz"), ply.with_suffix(".sog"), _transformed(ply, tmp_path / "of.compressed.ply")]
    for path in packed:
        assert path.stat().st_size < 0.3 * ply.stat().st_size, path.name
        back = _transformed(path, tmp_path / f"from_{path.suffix[1:]}.ply")
        again = to_bytes(_rendered_ply(back, True)).astype(int)
        assert np.abs(again - wanted)[wanted.any(-1)].mean() < PACKED_MEAN, path.name


def _transformed(source: Path, out: Path) -> Path:
    """What splat-transform makes of ``source``."""
    program = shutil.which(TRANSFORM)
    assert program
    subprocess.run([program, "--quiet", "--gpu", "cpu", str(source), str(out)], check=True)
    return out


# Motions


def _motion(*words: object) -> int:
    return main(["motion", *map(str, words)])


def test_amass_brings_the_motion_back(tmp_path):
    skeleton = Body.load(ASSETS / "body.npz").skeleton
    walk = load_motion(WALK, skeleton)
    assert _motion(AVATAR, "--motion", WALK, "--out", tmp_path / "w.npz") == 0
    with np.load(tmp_path / "w.npz") as archive:
        assert archive["poses"].shape == (132, 156) and archive["betas"].shape == (16,)
        assert float(archive["mocap_framerate"]) == 30 and str(archive["gender"]) == "neutral"
        assert archive["trans"][:, 2].mean() > 0.5  # Z up
    again = load_motion(tmp_path / "w.npz", skeleton)
    np.testing.assert_allclose(again.rotations, walk.rotations, atol=1e-9)
    np.testing.assert_allclose(again.translations, walk.translations, atol=1e-9)
    shutil.copy(ASSETS / "body.npz", tmp_path / "BODY.NPZ")
    assert _motion(tmp_path / "BODY.NPZ", "--motion", WALK, "--out", tmp_path / "v.npz") == 0
    assert (tmp_path / "w.npz").read_bytes() == (tmp_path / "v.npz").read_bytes()


def test_a_loop_at_another_rate_repeats_no_frame(tmp_path, capsys):
    """132 frames less a seam of 15 take 3.9 s, at 60 per second 234 frames."""
    options = ("--loop", "--in-place", "--fps", 60)
    assert _motion(AVATAR, "--motion", WALK, "--out", tmp_path / "w.npz", *options) == 0
    assert "234 frames at 60 per second" in capsys.readouterr().out
    with np.load(tmp_path / "w.npz") as archive:
        assert len(archive["poses"]) == 234 and archive["mocap_framerate"] == 60
        assert np.ptp(archive["trans"][:, :2], axis=0).max() < 1e-9  # Z up: the floor's axes
        assert np.abs(archive["poses"][0] - archive["poses"][-1]).max() > 1e-3  # rad


def test_a_hand_rotates_all_its_fingers(tmp_path):
    skeleton = Body.load(ASSETS / "body.npz").skeleton
    still = load_motion(WALK, skeleton)
    rotations = still.rotations.copy()
    angles = {"left": np.array([0.1, 0.2, 0.3]), "right": np.array([-0.3, 0, 0.2])}
    for side, angle in angles.items():
        rotations[:, skeleton.names.index(f"{side}_hand")] = axis_angle_to_matrix(angle)
    assert not write_amass(tmp_path / "a.npz", replace(still, rotations=rotations), skeleton)
    with np.load(tmp_path / "a.npz") as archive:
        poses = archive["poses"].reshape(-1, 52, 3)
    for joint, name in enumerate(SMPLH_NAMES[22:], 22):
        expected = angles[name.split("_")[0]] if name.endswith("1") else np.zeros(3)
        np.testing.assert_allclose(poses[:, joint], np.tile(expected, (len(poses), 1)), atol=1e-9)


def test_joints_that_smplh_or_the_skeleton_lacks_are_named(tmp_path, capsys):
    names = list(body().skeleton.names)
    names[names.index("head")] = "antenna"
    with np.load(ASSETS / "body.npz") as archive:
        save_npz(tmp_path / "robot.npz", dict(archive) | {"joint_names": np.array(names)})
    angles = np.zeros((6, 24, 3))
    angles[:, names.index("antenna"), 0] = 0.3
    arrays = {"poses": angles.reshape(6, -1), "trans": np.zeros((6, 3)), "mocap_framerate": np.array(30.0)}
    save_npz(tmp_path / "nod.npz", arrays | {"joint_names": np.array(names)})
    assert _motion(tmp_path / "robot.npz", "--motion", tmp_path / "nod.npz", "--out", tmp_path / "out.npz") == 0
    assert "left out: antenna" in capsys.readouterr().err
    assert _motion(AVATAR, "--motion", tmp_path / "nod.npz", "--out", tmp_path / "out.npz") == 0
    assert "left out: antenna" in capsys.readouterr().err


def test_fingers_that_move_are_kept(tmp_path):
    names, rng = (*SMPL_NAMES, *SMPLH_NAMES[22:]), np.random.default_rng(0)
    skeleton = Skeleton(names, np.maximum(np.arange(54) - 1, -1), np.zeros((54, 3)))
    poses = 0.3 * rng.normal(size=(4, 52, 3))
    save_npz(tmp_path / "in.npz", {"poses": poses, "trans": np.zeros((4, 3)), "mocap_framerate": np.array(30.0)})
    moves = load_motion(tmp_path / "in.npz", skeleton)
    assert write_amass(tmp_path / "out.npz", moves, skeleton) == ()
    with np.load(tmp_path / "out.npz") as archive:
        np.testing.assert_allclose(archive["poses"].reshape(4, 52, 3), poses, atol=1e-9)
    moves.rotations[:, names.index("left_hand")] = axis_angle_to_matrix([0.1, 0, 0])
    assert write_amass(tmp_path / "out.npz", moves, skeleton) == ("left_hand",)


def test_motions_are_read_as_the_player_reads_them(tmp_path, capsys):
    with np.load(WALK) as archive:
        arrays = {name: archive[name] for name in ("poses", "trans")}
    strange = [f"B{joint}" for joint in range(arrays["poses"].shape[1] // 3)]
    save_npz(tmp_path / "strange.npz", arrays | {"joint_names": np.array(strange)})
    table = "\n".join(f'{ours} = "B{joint}"' for joint, ours in enumerate(body().skeleton.names))
    (tmp_path / "names.toml").write_text(table)
    line = (AVATAR, "--motion", tmp_path / "strange.npz", "--out", tmp_path / "out.npz")
    assert _motion(*line) == 2
    assert _motion(*line, "--joint-map", tmp_path / "names.toml") == 0
    assert "note: no frame rate in the file" in capsys.readouterr().err
    assert _motion(*line, "--joint-map", tmp_path / "names.toml", "--motion-fps", "24") == 0
    printed = capsys.readouterr()
    assert "at 24 per second" in printed.out and "note:" not in printed.err


SPLATS = ["splats", AVATAR, "--motion", WALK, "--out", "OUT"]
MESH = ["mesh", AVATAR, "--body", BODY, "--motion", WALK, "--out", "OUT"]


@pytest.mark.parametrize(
    ("words", "names"),
    [
        ([*SPLATS, "--format", "fbx"], ["--format", "fbx"]),
        ([*SPLATS, "--frames", "9:4"], ["--frames", "9:4"]),
        ([*SPLATS, "--format", "visionary", "--sh-degree", "1"], ["--sh-degree", "visionary"]),
        ([*SPLATS, "--format", "visionary", "--coding", "linear"], ["--coding", "visionary"]),
        ([*SPLATS, "--camera", "above"], ["--camera", "above"]),
        ([*SPLATS, "--colour", "albedo", "--exposure", "1"], ["--exposure", "1"]),
        ([*SPLATS, "--sh-degree", "1", "--camera", "a.json"], ["--camera", "a.json"]),
        ([*SPLATS, "--format", "glb", "--ply-axes", "y-up"], ["--ply-axes", "y-up"]),
        ([*SPLATS, "--format", "glb", "--material"], ["--material", ".ply"]),
        ([*SPLATS, "--exposure", "2000"], ["--exposure", "2000"]),
        ([*SPLATS, "--hdr-up", "z"], ["--hdr-up", "needs --hdr"]),
        ([*MESH, "--frames", "0:2"], ["--frames", "0:2"]),
        (["splats", WALK, "--motion", WALK, "--out", "OUT"], ["walk.npz"]),
        ([*MESH, "--texture", "9"], ["--texture", "9"]),
        ([*MESH, "--format", "fbx"], ["--format", "fbx"]),
        (["mesh", WALK, "--body", BODY, "--motion", WALK, "--out", "OUT"], ["walk.npz"]),
        (["mesh", AVATAR, "--body", WALK, "--motion", WALK, "--out", "OUT"], ["walk.npz"]),
        (["motion", "none.onnx", "--motion", WALK, "--out", "a.npz"], ["none.onnx", "not found"]),
        (["motion", AVATAR, "--motion", WALK, "--out", "a.bvh"], ["--out", "a.bvh"]),
        (["motion", BODY, "--motion", WALK, "--out", BODY], ["another file than what is read"]),
        (["motion", AVATAR, "--motion", WALK, "--out", "a.npz", "--fps", "0"], ["--fps", "0"]),
    ],
)
def test_unusable_input_is_one_line_and_exit_2(words, names, tmp_path, capsys):
    assert main([str(tmp_path / "out") if word == "OUT" else str(word) for word in words]) == 2
    error = capsys.readouterr().err
    assert error.startswith("rnd-convert: ") and all(name in error for name in names), error
    assert error.count("\n") == 1 and not (tmp_path / "out").exists()
