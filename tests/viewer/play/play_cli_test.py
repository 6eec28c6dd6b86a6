"""The command rnd-play: files it leaves, refusals, Ctrl-C. The avatar is a fake; the rest is real."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import rnd_viewer.play.play
from rnd_runtime.avatar.avatar import Avatar
from rnd_runtime.cli.lock import folder_lock
from rnd_runtime.core.images import linear_to_srgb, neutral, read_image, to_bytes, write_image
from rnd_runtime.core.kernels import COMPILING
from rnd_runtime.motion.motion import save_motion
from rnd_runtime.playback.doctor import Finding
from rnd_runtime.playback.frame import FrameRenderer
from rnd_viewer.inputs.cast import load_people
from rnd_viewer.inputs.options import PlayOptions
from rnd_viewer.inputs.scenes import read_scene
from rnd_viewer.play.cli import main
from support.paths import ROOT
from support.play_fakes import FakeAvatar, fake_motion

FRAMES = 6


@pytest.fixture
def files(tmp_path, monkeypatch) -> dict[str, Path]:
    """Input files, and an avatar that needs none."""
    monkeypatch.setattr(Avatar, "load", lambda path, **_: FakeAvatar())
    monkeypatch.setattr(rnd_viewer.play.play, "kernels_are_cold", lambda: False)  # whatever ran before
    save_motion(tmp_path / "walk.npz", fake_motion(FRAMES))
    rng = np.random.default_rng(0)
    write_image(tmp_path / "sky.exr", rng.uniform(0.2, 1, (16, 32, 3)).astype(np.float32))
    write_image(tmp_path / "black.exr", np.zeros((16, 32, 3), np.float32))
    broken = np.ones((16, 32, 3), np.float32)
    broken[3, 4] = np.nan
    write_image(tmp_path / "nan.exr", broken)
    (tmp_path / "torn.exr").write_bytes((tmp_path / "sky.exr").read_bytes()[:200])
    poses = {"poses": np.full((4, 72), np.nan), "trans": np.zeros((4, 3)), "mocap_framerate": 30.0}
    np.savez(tmp_path / "nan.npz", **poses)
    return {file.name: file for file in tmp_path.iterdir()}


def _arguments(files: dict[str, Path], folder: Path, **changes: object) -> list[str]:
    inputs = {"motion": files["walk.npz"], "hdr": files["sky.exr"], "out": folder}
    options: dict[str, object] = inputs | {"size": 48, "raster": "cpu"}
    options |= {"shade": "ao", "format": "png"} | changes
    named = [(f"--{key.replace('_', '-')}", str(value)) for key, value in options.items() if value is not None]
    return ["avatar.onnx", *(word for pair in named for word in pair)]


def _tree(folder: Path) -> dict[str, bytes]:
    """What is there, without the mark that says whose folder it is."""
    files = (file for file in folder.rglob("*") if file.is_file() and not file.name.startswith(".run-"))
    return {str(file.relative_to(folder)): file.read_bytes() for file in files}


def test_gl_draws_what_the_cpu_draws(files, tmp_path):
    pictures = {}
    for raster in ("cpu", "gl"):
        out = tmp_path / raster
        assert main(_arguments(files, out, raster=raster, shade="table", frames="0:2")) == 0
        pictures[raster] = [read_image(out / f"frames/{k:06d}.png").astype(int) for k in range(2)]
    report = json.loads(next((tmp_path / "gl").glob("play*.json")).read_text())
    assert report["raster"].startswith("gl (") and {"shading", "read-back"} <= set(report["times"])
    for cpu, gl in zip(pictures["cpu"], pictures["gl"]):
        assert cpu.max() > 100 and np.abs(cpu - gl).max() <= 2


def test_a_run_leaves_pictures_video_and_a_report(files, tmp_path, capsys):
    arguments = _arguments(files, tmp_path / "out", format="png,exr,mp4,webp", aov="normal,depth")
    assert main(arguments) == 0
    names = {f"{k:06d}" for k in range(FRAMES)}
    expected = {f"frames/{name}.png" for name in names} | {f"frames_exr/{name}.exr" for name in names}
    expected |= {f"aov/{aov}/{name}.png" for aov in ("normal", "depth") for name in names}
    assert set(_tree(tmp_path / "out")) == expected | {"play.mp4", "play.webp", "play.json"}
    report = json.loads((tmp_path / "out/play.json").read_text())
    assert report["frames"] == [0, FRAMES] and report["size"] == [48, 48] and report["fps"] == 30
    assert {"load", "encoders", "shading", "tonemap", "write"} <= set(report["times"])
    assert report["times"]["encoders"]["runs"] == FRAMES
    printed = capsys.readouterr()
    assert "median ms" in printed.out and "p95 ms" in printed.out and "frames/s" in printed.out
    assert printed.err == "rnd-play: rendering\n"
    assert main([*arguments, "--quiet"]) == 0
    assert capsys.readouterr() == (f"{tmp_path / 'out'}\n", "")


def test_the_same_run_gives_the_same_bytes(files, tmp_path):
    trees = []
    for name in ("a", "b"):
        assert main(_arguments(files, tmp_path / name, format="png,exr,mp4,webp", camera="orbit")) == 0
        tree = _tree(tmp_path / name)
        report = json.loads(tree.pop("play.json"))
        del report["times"]
        trees.append((tree, report))
    assert trees[0] == trees[1]


@pytest.mark.parametrize(("background", "shade"), [("hdr", "table+sun"), ("none", "ao")])
def test_a_light_that_turns_stands_in_each_frame_as_hdr_yaw_says(files, tmp_path, background, shade):
    turning = {"background": background, "shade": shade, "hdr_yaw": "30", "hdr_turn": "-0.5"}
    assert main(_arguments(files, tmp_path / "turning", **turning)) == 0
    pictures = []
    for number in (0, 4):
        still = turning | {"hdr_turn": None, "hdr_yaw": str(30 - 360 * number / 30 / 0.5)}
        out = tmp_path / f"still{number}"
        assert main(_arguments(files, out, frames=f"{number}:{number + 1}", **still)) == 0
        pictures.append(read_image(out / f"frames/{number:06d}.png").astype(int))
        turned = read_image(tmp_path / f"turning/frames/{number:06d}.png").astype(int)
        assert np.abs(turned - pictures[-1]).max() <= 1  # degrees and radians round apart
    assert np.abs(pictures[1] - pictures[0]).max() > 5


def test_parts_of_two_processes_make_the_whole_in_one_folder(files, tmp_path):
    """Real processes, at the same time."""
    assert main(_arguments(files, tmp_path / "whole")) == 0
    code = "import sys; sys.path.insert(0, 'tests'); from support import play_fakes\n"
    code += "import rnd_viewer.play.play, rnd_viewer.play.cli\n"
    code += "rnd_viewer.inputs.cast.Avatar.load = lambda path, **_: play_fakes.FakeAvatar()\n"
    code += "sys.exit(rnd_viewer.play.cli.main(sys.argv[1:]))"
    parts = [_arguments(files, tmp_path / "out", frames=part) for part in (":2", "2:")]
    processes = [subprocess.Popen([sys.executable, "-c", code, *part], cwd=ROOT) for part in parts]
    assert [process.wait(120) for process in processes] == [0, 0]
    whole, parts = _tree(tmp_path / "whole"), _tree(tmp_path / "out")
    names = {f"frames/{k:06d}.png" for k in range(FRAMES)}
    assert {name for name in parts if name.startswith("frames/")} == names
    assert all(parts[name] == whole[name] for name in names)
    assert {"play_000000-000002.json", "play_000002-000006.json"} <= parts.keys()


def test_another_run_at_the_same_time_is_told_who_holds_the_folder(files, tmp_path, capsys):
    (tmp_path / "out").mkdir()
    with folder_lock(tmp_path / "out", "rnd-play", shared_by=".run-0123456789abcdef"):
        assert main(_arguments(files, tmp_path / "out")) == 2
    error = capsys.readouterr().err
    assert "out: folder is being written to: got rnd-play (process " in error and error.count("\n") == 1
    assert not _tree(tmp_path / "out")


def test_parts_share_a_folder_inside_the_motions(files, tmp_path, capsys):
    motion, out = tmp_path / "smpl", tmp_path / "smpl/out"
    motion.mkdir()
    person = {"id": 0, "Rh": [[1.57, 0, 0]], "Th": [[0, 0, 1]], "poses": [[0] * 72], "shapes": [[0] * 10]}
    for frame in range(4):
        (motion / f"{frame:06d}.json").write_text(json.dumps([person]))
    for part in ("0:2", "2:4"):
        assert main(_arguments(files, out, motion=motion, frames=part)) == 0
    pictures = {name for name in _tree(out) if name.startswith("frames/")}
    assert pictures == {f"frames/{k:06d}.png" for k in range(4)}
    assert main(_arguments(files, motion, motion=motion)) == 2  # whose play.json would be one of its files
    assert "--out: expected another folder than the motion's" in capsys.readouterr().err


def test_parts_that_spell_a_path_or_choose_a_rasterizer_their_own_way_are_of_one_run(
    files, tmp_path, monkeypatch, capsys
):
    camera = {"width": 48, "height": 48, "K": [[50, 0, 24], [0, 50, 24], [0, 0, 1]]}
    camera["world_to_camera"] = [[1, 0, 0, 0], [0, -1, 0, 1], [0, 0, -1, 4], [0, 0, 0, 1]]
    (tmp_path / "cameras.json").write_text(json.dumps({"cameras": {"a": camera}}))
    monkeypatch.chdir(tmp_path)
    for part, folder, raster in (("0:2", Path(), "cpu"), ("2:6", tmp_path, "auto")):
        named = {"motion": folder / "walk.npz", "hdr": folder / "sky.exr", "camera": f"{folder / 'cameras.json'}:a"}
        arguments = _arguments(files, folder / "out", frames=part, raster=raster, size=None, **named)
        assert main(arguments) == 0
    before = _tree(tmp_path / "out")
    assert len(before) == FRAMES + 2
    assert main(_arguments(files, tmp_path / "out")) == 2
    assert "--out holds frames/" in capsys.readouterr().err and _tree(tmp_path / "out") == before


def test_what_faces_away_is_left_out_on_every_path(files, tmp_path, capsys):
    """By the CPU, by OpenGL, and beside AOVs, which are drawn another way."""
    pictures = {}
    for name, changes in {
        "whole": {"cull": None},
        "cpu": {},
        "gl": {"raster": "gl"},
        "aov": {"aov": "normal", "format": "png,exr"},
    }.items():
        options = {"shade": "table", "frames": "0:1", "cull": 0.3} | changes
        assert main(_arguments(files, tmp_path / name, **options)) == 0
        pictures[name] = read_image(tmp_path / name / "frames/000000.png").astype(int)
    assert np.abs(pictures["cpu"] - pictures["whole"]).max() > 20
    assert np.abs(pictures["cpu"] - pictures["gl"]).max() <= 2
    np.testing.assert_array_equal(pictures["aov"], pictures["cpu"])
    assert main(_arguments(files, tmp_path / "no", cull=2)) == 2
    assert "--cull: expected a cosine, from -1 to 1, got 2" in capsys.readouterr().err


def test_without_hdr_the_light_of_the_avatar_shines(files, tmp_path):
    for name, changes in (("a", {}), ("b", {"exposure": "-1"})):
        assert main(_arguments(files, tmp_path / name, hdr=None, frames=":1", **changes)) == 0
    bright, dark = (read_image(tmp_path / name / "frames/000000.png") for name in ("a", "b"))
    assert 0 < dark[..., :3].max() < bright[..., :3].max()
    assert json.loads((tmp_path / "b/play_000000-000001.json").read_text())["light"]["maximum"] == 0.25


def test_light_options_reach_the_light(files, tmp_path):
    half = np.zeros((16, 32, 3), np.float32)
    half[:, 8:24] = 1.0  # shines from +X, the right of what a front camera sees
    write_image(tmp_path / "half.exr", half)
    pictures, maxima = {}, {}
    for name, value in (("exposure", "0"), ("exposure", "1"), ("hdr_yaw", "180"), ("hdr_up", "z")):
        folder = tmp_path / f"{name}{value}"
        options = {"hdr": tmp_path / "half.exr", "frames": ":1", "background": "0,0,0", name: value}
        assert main(_arguments(files, folder, **options)) == 0
        pictures[folder.name] = read_image(folder / "frames/000000.png").astype(int).sum(axis=2)
        maxima[folder.name] = json.loads((folder / "play_000000-000001.json").read_text())["light"]["maximum"]
    assert maxima == {"exposure0": 1, "exposure1": 2, "hdr_yaw180": 1, "hdr_upz": 1}
    assert (pictures["exposure1"] >= pictures["exposure0"]).all()
    columns = {name: picture.sum(axis=0) @ np.arange(48) / picture.sum() for name, picture in pictures.items()}
    assert columns["hdr_yaw180"] < columns["exposure0"] - 0.1  # lit from the picture's right, then from its left
    assert (pictures["hdr_upz"] != pictures["exposure0"]).any()


def test_the_neutral_tone_clips_nothing_and_leaves_an_exr_as_it_is(files, tmp_path):
    shown, linear = {}, {}
    for tone in ("srgb", "neutral"):
        look = {"tone": tone, "exposure": 2, "frames": ":1", "format": "png,exr"}
        assert main(_arguments(files, tmp_path / tone, **look)) == 0
        shown[tone] = read_image(tmp_path / tone / "frames/000000.png")
        linear[tone] = read_image(tmp_path / tone / "frames_exr/000000.exr")
    assert (linear["srgb"] == linear["neutral"]).all()
    assert (shown["srgb"][..., :3] == 255).any() and shown["neutral"][..., :3].max() < 255
    covered = linear["neutral"][..., 3] > 0
    premultiplied, alpha = np.split(linear["neutral"][covered].astype(np.float64), [3], axis=-1)
    expected = to_bytes(linear_to_srgb(neutral(premultiplied / alpha)))
    assert np.abs(shown["neutral"][covered][:, :3].astype(int) - expected).max() <= 1


def test_background_colour_fills_the_corner(files, tmp_path):
    assert main(_arguments(files, tmp_path / "out", background="#204060", frames=":1")) == 0
    picture = read_image(tmp_path / "out/frames/000000.png")
    assert picture.shape == (48, 48, 3) and picture[0, 0].tolist() == [0x20, 0x40, 0x60]


def test_warnings_name_what_was_found(files, tmp_path, capsys):
    assert main(_arguments(files, tmp_path / "out", hdr=files["nan.exr"], frames=":1")) == 0
    assert "1 texels of the light were NaN" in capsys.readouterr().err
    assert main(_arguments(files, tmp_path / "dark", hdr=files["black.exr"], frames=":1")) == 0
    assert "the light is dark: its largest radiance is 0" in capsys.readouterr().err


def test_a_ground_catches_the_shadow(files, tmp_path):
    exr = {"format": "png,exr", "frames": ":1", "elevation": 30, "background": "1,1,1"}
    assert main(_arguments(files, tmp_path / "floats", **exr)) == 0
    assert main(_arguments(files, tmp_path / "stands", ground="auto", **exr)) == 0
    floats, stands = (read_image(tmp_path / name / "frames_exr/000000.exr") for name in ("floats", "stands"))
    left = stands[..., 4:7]
    assert floats.shape[2] == 4 and left.min() < 0.9 and left.max() == 1
    behind = floats[..., :3] == 1  # the plate alone
    assert behind.any() and np.allclose(stands[..., :3][behind], left[behind], atol=1e-6)
    assert (
        main(_arguments(files, tmp_path / "clear", ground="auto", **exr | {"background": None, "format": "png"})) == 0
    )
    alpha = read_image(tmp_path / "clear/frames/000000.png")[..., 3] / 255
    plate = behind.all(-1)
    assert np.abs(alpha - (1 - left.mean(-1)))[plate].max() < 0.005


def test_the_ground_lights_the_body(files, tmp_path):
    images = []
    for albedo in ("0", "0.8,0.4,0"):
        how = {"ground": "auto", "ground_albedo": albedo, "format": "exr", "frames": ":1"}
        assert main(_arguments(files, tmp_path / albedo, **how)) == 0
        images.append(read_image(tmp_path / albedo / "frames_exr/000000.exr"))
    np.testing.assert_array_equal(images[0][..., 3:], images[1][..., 3:])  # outline and shadow stay
    red, green, blue = (images[1] - images[0])[..., :3].mean((0, 1))
    assert red > 1.5 * green > 0.001 and abs(blue) < 1e-6


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"motion": "none.npz"}, "none.npz"),
        ({"motion": "nan.npz"}, "nan.npz"),
        ({"hdr": "none.exr"}, "none.exr"),
        ({"hdr": "torn.exr"}, "torn.exr"),
        ({"shade": "fancy"}, "fancy"),
        ({"frames": "4:4"}, "--frames: expected START:END within 0:6"),
        ({"frames": "4:40"}, "--frames"),
        ({"size": "0"}, "--size"),
        ({"fov": "180"}, "--fov"),
        ({"fps": "nan"}, "--fps"),
        ({"orbit_seconds": "0"}, "--orbit-seconds"),
        ({"hdr_turn": "0"}, "--hdr-turn: expected not 0, got 0"),
        ({"orbit_seconds": "4"}, "--orbit-seconds: expected the default, got 4.0 (needs --camera orbit)"),
        ({"camera": "a.json", "fov": "40"}, "--fov: expected the default, got 40.0 (the camera's file"),
        ({"hdr": None, "hdr_up": "z"}, "--hdr-up: expected the default, got z (needs --hdr)"),
        ({"motion_fps": "inf"}, "--motion-fps: expected 0.001 to 10000, got inf"),
        ({"background": "bluish"}, "--background"),
        ({"ground": "low"}, "--ground: expected none, auto or metres, got low"),
        ({"ground_albedo": "0.5"}, "--ground-albedo: expected --ground, got none"),
        ({"ground": "auto", "ground_albedo": "0.5,2,1"}, "--ground-albedo: expected r,g,b or one number, 0 to 1"),
        ({"aov": "albedo,beauty"}, "--aov"),
        ({"format": "gif"}, "--format"),
        ({"camera": "above"}, "--camera"),
        ({"camera": "none.json"}, "camera file not found"),
        ({"threads": "0"}, "--threads"),
        ({"motion": None, "out": None}, "missing --motion, --out"),
    ],
)
def test_unusable_input_is_one_line_and_exit_2(files, tmp_path, capsys, changes, message):
    here = {name: tmp_path / value for name, value in changes.items() if name in ("motion", "hdr") and value}
    assert main(_arguments(files, tmp_path / "out", **(changes | here))) == 2
    printed = capsys.readouterr()
    assert printed.err.startswith("rnd-play: ") and message in printed.err
    assert printed.err.count("\n") == 1 and printed.out == ""
    assert not _tree(tmp_path / "out")


def test_kernels_that_are_not_compiled_yet_are_said_before_they_are_needed(files, tmp_path, monkeypatch, capsys):
    def compiling(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(rnd_viewer.play.play, "kernels_are_cold", lambda: True)
    monkeypatch.setattr(rnd_viewer.play.play, "FrameRenderer", compiling)
    main(_arguments(files, tmp_path / "out"))
    assert capsys.readouterr().err.splitlines() == [f"rnd-play: {COMPILING}", "rnd-play: interrupted"]


def test_avatar_out_of_view_is_an_error_that_says_so(files, tmp_path, capsys):
    camera = {"width": 32, "height": 32, "K": [[40, 0, 16], [0, 40, 16], [0, 0, 1]]}
    camera["world_to_camera"] = np.eye(4).tolist()  # at the feet, looking past the body
    camera["world_to_camera"][2][3] = -4.0
    (tmp_path / "camera.json").write_text(json.dumps(camera))
    assert main(_arguments(files, tmp_path / "out", camera=tmp_path / "camera.json", size=None)) == 2
    assert "frame 0: nothing of the avatar is in view in the first frame" in capsys.readouterr().err
    assert not _tree(tmp_path / "out")


def _cameras_that_lose_the_body(folder: Path, seen: int, size: int = 48) -> Path:
    """A camera file for all frames: the body is in view in the first ``seen`` and behind the camera afterwards."""
    cameras = []
    for frame in range(FRAMES):
        pose = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenCV: looking along −Z
        pose[:3, 3] = [0, 1, 4 if frame < seen else -4]
        intrinsics = [[size, 0, size / 2], [0, size, size / 2], [0, 0, 1]]
        record = {"width": size, "height": size, "K": intrinsics, "world_to_camera": pose.tolist()}
        cameras.append(record)
    file = folder / "walking.json"
    file.write_text(json.dumps({"cameras": cameras}))
    return file


def test_a_run_that_fails_at_once_leaves_nothing(files, tmp_path, capsys):
    out = tmp_path / "out"
    away = _cameras_that_lose_the_body(tmp_path, seen=0)
    assert main(_arguments(files, out, camera=away, size=None)) == 2
    for format in ("webp", "png,webp"):
        assert main(_arguments(files, out, frames="0:2", format=format, size="1x16384")) == 2
        assert "webp encoder refuses 1x16384" in capsys.readouterr().err
    assert not [file for file in out.rglob("*") if file.is_file()]


@pytest.mark.parametrize(
    ("option", "name"),
    [("hdr", "frames_exr/000000.exr"), ("hdr", "aov/normal/000003.exr"), ("camera", "play_000000-000001.json")],
)
def test_a_file_that_runs_write_is_no_input_of_one_beside_it(files, tmp_path, capsys, option, name):
    walking = _cameras_that_lose_the_body(tmp_path, seen=FRAMES)
    file = tmp_path / "out" / name
    file.parent.mkdir(parents=True)
    shutil.copy(files["sky.exr"] if option == "hdr" else walking, file)
    before = file.read_bytes()
    changes = {option: file} | ({"size": None} if option == "camera" else {})
    assert main(_arguments(files, tmp_path / "out", frames="0:1", **changes)) == 2
    assert f"{file}: cannot be an input: runs write such files into --out" in capsys.readouterr().err
    assert _tree(tmp_path / "out") == {name: before}
    assert main(_arguments(files, tmp_path / "other", frames="0:1", **changes)) == 0


def test_a_part_without_the_body_is_no_mistake(files, tmp_path, capsys):
    walking = _cameras_that_lose_the_body(tmp_path, seen=2)
    out = tmp_path / "out"
    for part in ("0:2", f"2:{FRAMES}"):
        assert main(_arguments(files, out, camera=walking, size=None, frames=part)) == 0
    assert "nothing of the avatar is in view in any of these frames" in capsys.readouterr().err
    assert len([name for name in _tree(out) if name.startswith("frames/")]) == FRAMES


def test_mp4_of_cameras_of_several_sizes_is_refused(files, tmp_path, capsys):
    walking = _cameras_that_lose_the_body(tmp_path, seen=FRAMES)
    document = json.loads(walking.read_text())
    document["cameras"][2] |= {"width": 64, "height": 64}
    walking.write_text(json.dumps(document))
    assert main(_arguments(files, tmp_path / "out", camera=walking, size=None, format="mp4")) == 2
    assert "mp4: expected frames of one size, 48x48, got 64x64" in capsys.readouterr().err


def test_ctrl_c_leaves_whole_files_only(files, tmp_path, monkeypatch, capsys):
    rendered = []

    def draw(self, encoded, camera, **options):
        rendered.append(camera)
        if len(rendered) == 3:
            raise KeyboardInterrupt
        return original(self, encoded, camera, **options)

    original = FrameRenderer.draw
    monkeypatch.setattr(FrameRenderer, "draw", draw)
    assert main(_arguments(files, tmp_path / "out", format="png,exr,mp4,webp")) == 130
    assert "interrupted" in capsys.readouterr().err
    left = _tree(tmp_path / "out")
    assert set(left) == {
        f"{folder}/{k:06d}.{kind}" for folder, kind in (("frames", "png"), ("frames_exr", "exr")) for k in (0, 1)
    }
    for name in left:
        assert read_image(tmp_path / "out" / name).shape[:2] == (48, 48)


def test_doctor_needs_no_avatar_and_gives_advice(monkeypatch, capsys):
    found = [Finding("rasteriser", "cpu", None), Finding("OpenGL, EGL", "missing", "apt install libegl1")]
    monkeypatch.setattr("rnd_runtime.playback.doctor.report", lambda: found)
    assert main(["--doctor"]) == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert lines[:3] == [["rasteriser", "cpu"], ["OpenGL,", "EGL", "missing"], ["→", "apt", "install", "libegl1"]]
    assert lines[3][:2] == ["PyAV", "(mp4,"]


def _scene(files: dict[str, Path], text: str) -> Path:
    file = files["walk.npz"].with_name("scene.toml")
    file.write_text(text, encoding="utf-8")
    return file


def _play_scene(files: dict[str, Path], text: str, folder: Path, **changes: object) -> int:
    return main([str(_scene(files, text)), *_arguments(files, folder, motion=None, **changes)[1:]])


PERSON = '[[person]]\navatar = "avatar.onnx"\nmotion = "walk.npz"\n'


def test_a_scene_of_one_is_the_avatar(files, tmp_path):
    assert main(_arguments(files, tmp_path / "avatar")) == 0
    assert _play_scene(files, PERSON, tmp_path / "scene") == 0
    alone, scene = (_tree(tmp_path / name) for name in ("avatar", "scene"))
    assert sum(name.endswith(".png") for name in alone) == FRAMES
    for name in alone:
        assert name.endswith(".json") or alone[name] == scene[name], name
    assert _play_scene(files, PERSON + "start = 0.1\n", tmp_path / "later") == 0  # three frames of its first pose
    later = _tree(tmp_path / "later")
    assert later["frames/000000.png"] == later["frames/000003.png"]
    assert sum(name.endswith(".png") for name in later) == FRAMES + 3


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "[[person]] tables, got none"),
        ("person = 3", "[[person]] tables, got 3"),
        ("person = [1, 2]", "person: expected [[person]] tables, got 1"),
        ("[[person]\n", "scene file: expected TOML, got "),
        ("\ncamera = 1\n" + PERSON, "line 2: camera: expected [[person]] tables alone"),
        ("[light]\nx = 1\n" + PERSON, "line 1: light: "),
        (PERSON + "\n[[person]]\nmotion = 'a.npz'\n", "line 5: avatar: expected the name of a file, got nothing"),
        (
            PERSON + PERSON + "motion_ = 1\n",
            "line 7: motion_: expected one of avatar, motion, position, heading, start",
        ),
        (PERSON + "position = [1]\n", "line 4: position: expected [x, z] of at most 10000 metres, got [1]"),
        (PERSON + "position = [nan, 0]\n", "line 4: position: "),
        (PERSON + "heading = true\n", "line 4: heading: expected a number of at most 1e+06, got True"),
        (PERSON + "# so\nstart = inf\n", "line 5: start: "),
        (PERSON.replace('"walk.npz"', "7"), "line 3: motion: expected the name of a file, got 7"),
    ],
)
def test_a_scene_file_is_refused_by_key_and_line(files, tmp_path, capsys, text, says):
    assert _play_scene(files, text, tmp_path / "out") == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "scene.toml: " in line and says in line, line
    assert not (tmp_path / "out").exists()


def test_a_scene_brings_its_motions_and_loads_an_avatar_once(files, tmp_path, capsys, monkeypatch):
    words = _arguments(files, tmp_path / "out")
    assert main([str(_scene(files, PERSON)), *words[1:]]) == 2
    assert "--motion: expected the default" in capsys.readouterr().err
    loaded = []
    monkeypatch.setattr(Avatar, "load", lambda path, **_: loaded.append(path) or FakeAvatar())
    options = PlayOptions(avatar=_scene(files, PERSON + "position = [1, 0]\n" + PERSON), out=tmp_path / "out")
    here, there = load_people(read_scene(options.avatar), options.reading)
    assert len(loaded) == 1 and here.avatar is there.avatar and here.motion is there.motion
    assert here.place[0, 3] == 1 and (there.place == np.eye(4)).all()
