"""The player as a library: what a frame holds, what stands behind it, what it depends on."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from threading import Thread

import numpy as np
import pytest

from rnd_runtime.core.camera import Camera
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.gaussians import Gaussians
from rnd_runtime.core.images import linear_to_srgb, srgb_to_linear, to_bytes
from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_runtime.core.sh import sh_basis, sphere_quadrature
from rnd_runtime.playback.aov import CHANNELS, ambient_visibility, parse_aovs
from rnd_runtime.playback.frame import FrameRenderer, RenderedFrame
from rnd_runtime.raster.cpu import rasterize
from rnd_runtime.shading.light import Light
from rnd_viewer.inputs.background import Background
from rnd_viewer.inputs.cameras import CameraOptions, frame_motion, front_path
from rnd_viewer.inputs.options import parse_frames, parse_size
from rnd_viewer.play import run_folder
from rnd_viewer.play.player import Player
from rnd_viewer.play.run_folder import claim
from rnd_viewer.play.timing import StageTimes
from support.play_fakes import FakeAvatar, fake_motion, white_light

MOTION = fake_motion()
INSIDE = 0.99  # alpha above which a pixel shows the surface and nothing else


class FlatShader:
    """Everything glows with one radiance."""

    def __init__(self, radiance: float, light: Light) -> None:
        self.radiance, self.light = radiance, light

    def shade(self, gaussians: Gaussians, camera_position: np.ndarray, seen=None) -> np.ndarray:
        return np.full((len(gaussians.means), 3), self.radiance, np.float32)

    def in_frame(self, frame_to_world: np.ndarray) -> FlatShader:
        return self


def _player(radiance: float = 0.18, light: Light | None = None, **options) -> Player:
    shader = FlatShader(radiance, light or white_light())
    return Player(FrameRenderer(FakeAvatar(), shader, raster=rasterize), **options)


def _camera(width: int = 96, height: int = 80) -> Camera:
    return front_path(frame_motion(FakeAvatar().skeleton, MOTION), CameraOptions(width, height, 0.6, 0.1))(0, 0.0)


def test_grey_card_is_118():
    """18 % is 118 of 255, and the coding comes after the blending."""
    frame = _player().render(MOTION, 0.2, _camera())
    inside = frame.alpha > INSIDE
    assert inside.sum() > 200
    over_itself = replace(frame, background=np.full(3, 0.18, np.float32))
    assert set(over_itself.srgb.ravel()) == {118}
    assert set(frame.srgb[inside].ravel()) <= {117, 118}


def test_blending_is_linear():
    frame = _player(0.9).render(MOTION, 0.2, _camera())
    over = replace(frame, background=np.full(3, 0.1, np.float32))
    expected = 0.9 * frame.alpha + 0.1 * (1 - frame.alpha)
    edge = (frame.alpha > 0.2) & (frame.alpha < 0.8)
    assert edge.any()
    np.testing.assert_allclose(over.linear()[..., 0], expected, atol=1e-5)
    np.testing.assert_array_equal(over.srgb, to_bytes(linear_to_srgb(over.linear()[..., :3])))


def test_a_frame_depends_on_nothing_but_its_arguments():
    player, camera = _player(), _camera()
    first = player.render(MOTION, 0.1, camera)
    player.render(MOTION, 0.3, _camera(64, 64))
    again = player.render(MOTION, 0.1, camera)
    np.testing.assert_array_equal(first.radiance, again.radiance)
    np.testing.assert_array_equal(first.radiance, _player().render(MOTION, 0.1, camera).radiance)
    assert (player.render(MOTION, 0.3, camera).radiance != first.radiance).any()


def test_nothing_in_view_gives_the_background_back():
    camera = Camera.look_at([0, 1, 5], [0, 1, 10], width=8, height=6, fov_y=0.5)  # its back to the body
    frame = _player(background=Background.parse("#336699")).render(MOTION, 0.0, camera)
    assert not frame.alpha.any()
    np.testing.assert_array_equal(frame.srgb, np.tile([0x33, 0x66, 0x99], (6, 8, 1)))


def test_aovs_are_those_of_the_surface():
    player = _player(aovs=parse_aovs("depth,visibility,roughness,normal,albedo"))
    camera = _camera()
    frame = player.render(MOTION, 0.2, camera)
    inside = frame.alpha > INSIDE
    assert list(frame.aovs) == list(CHANNELS)
    np.testing.assert_allclose(
        frame.aovs["albedo"], frame.alpha[..., None] * np.array([0.6, 0.4, 0.2], np.float32), atol=1e-5
    )
    np.testing.assert_allclose(frame.aovs["roughness"][inside], 0.5, atol=1e-5)
    np.testing.assert_allclose(frame.aovs["visibility"][inside], 1, atol=1e-5)
    normals = frame.aovs["normal"][inside]
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1, atol=1e-5)
    assert np.mean(normals[:, 2] < 0) > 0.98  # what we see faces us
    depth = frame.aovs["depth"][inside]
    distance = np.linalg.norm(camera.position - FakeAvatar().pose(MOTION, 0.2).means.mean(axis=0))
    assert np.abs(depth - distance).max() < 0.5
    plain = _player().render(MOTION, 0.2, camera)
    np.testing.assert_allclose(frame.radiance, plain.radiance, atol=1e-6)  # more channels change nothing


def test_normals_are_in_the_cameras_axes():
    """The upper half of every ball points up, which is −Y for the camera."""
    player, camera = _player(aovs=("normal",)), _camera(200, 200)
    frame = player.render(MOTION, 0.0, camera)
    head = FakeAvatar().skeleton.rest_joints[15]
    for offset, axis, sign in (([0, 0.08, 0.03], 1, -1), ([0.08, 0, 0.03], 0, 1), ([-0.08, 0, 0.03], 0, -1)):
        x, y, z = camera.K @ (camera.world_to_camera @ [*(head + offset), 1])[:3]
        normal = frame.aovs["normal"][int(y / z), int(x / z)]
        assert sign * normal[axis] > 0.5


def test_ambient_visibility_is_the_cosine_weighted_mean():
    """Against quadrature, for a random function turned with its root."""
    rng = np.random.default_rng(0)
    directions, weights = sphere_quadrature(64)
    normals = rng.normal(size=(5, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    visibility = rng.normal(size=(5, 16)) * 0.05
    visibility[:, 0] += 0.5 * np.sqrt(4 * np.pi)
    root = axis_angle_to_matrix([0.3, -1.1, 0.4])
    values = sh_basis(directions @ root) @ visibility.T  # world direction → root frame
    lobe = np.maximum(directions @ normals.T, 0) / np.pi
    expected = (values * lobe * weights[:, None]).sum(axis=0)
    blank = FakeAvatar().pose(MOTION, 0.0)
    gaussians = replace(blank, normals=normals, visibility=visibility, root_rotation=root)
    np.testing.assert_allclose(ambient_visibility(gaussians), expected, atol=2e-3)  # the lobe's own degree ≥ 4
    assert 0.2 < expected.min() < expected.max() < 0.8


@pytest.mark.parametrize(("text", "colour"), [("#ff8000", [1, 0x80 / 255, 0]), ("#000000", [0, 0, 0])])
def test_hex_colours_are_srgb(text, colour):
    np.testing.assert_allclose(Background.parse(text).colour, srgb_to_linear(np.array(colour)))


def test_number_colours_are_linear():
    assert Background.parse("0.1,0.2,3").colour == (0.1, 0.2, 3.0)


@pytest.mark.parametrize("text", ["", "red", "#12345", "1,2", "1,2,3,4", "nan,0,0", "-1,0,0", "inf,0,0", "1e39,0,0"])
def test_other_backgrounds_are_refused(text):
    with pytest.raises(InputError, match="none, hdr, #rrggbb or r,g,b"):
        Background.parse(text)


@pytest.mark.parametrize("yaw", [0.0, 0.7])
def test_the_light_stands_behind_the_avatar_where_it_shines_from(yaw):
    """A bright texel at azimuth φ of the file appears where a point at azimuth φ + yaw is projected."""
    radiance = np.full((64, 128, 3), 0.1, np.float32)
    radiance[30, 100] = 5.0  # azimuth (100.5 / 128 − 0.5) · 2π, polar angle 30.5 / 64 · π
    light = Light(radiance, yaw=yaw)
    azimuth, polar = (100.5 / 128 - 0.5) * 2 * np.pi + yaw, 30.5 / 64 * np.pi
    direction = np.array([np.sin(polar) * np.cos(azimuth), np.cos(polar), np.sin(polar) * np.sin(azimuth)])
    eye = np.array([3.0, 1.0, 2.0])
    target = eye + direction + np.array([0.1, 0.05, -0.1])
    camera = Camera.look_at(eye, target, width=160, height=120, fov_y=0.8)
    behind = Background.parse("hdr").radiance(camera, light)
    assert behind.shape == (120, 160, 3)
    x, y, z = camera.K @ camera.world_to_camera[:3, :3] @ direction
    rows, columns = np.nonzero(behind[..., 0] > 4)
    assert np.hypot(columns.mean() + 0.5 - x / z, rows.mean() + 0.5 - y / z) < 1.0


def test_srgb_alpha_ignores_the_background():
    frame = _player().render(MOTION, 0.0, _camera())
    seen = frame.srgb_alpha[..., 3] > 20
    assert np.abs(frame.srgb_alpha[seen][:, :3].astype(int) - 118).max() <= 1
    assert isinstance(frame, RenderedFrame)


def test_options_parse():
    assert parse_size("512") == (512, None) and parse_size("64x48") == (64, 48) and parse_size(None) is None
    assert parse_frames(None, 9) == range(9) and parse_frames("2:", 9) == range(2, 9)
    assert parse_frames(":3", 9) == range(3) and parse_frames("2:5", 9) == range(2, 5)
    assert parse_aovs("") == () and parse_aovs("depth, albedo,albedo") == ("albedo", "depth")


def test_frames_of_a_motion():
    for frames, fps in ((31, 30), (1, 30), (12, 30), (11, 60)):
        motion = fake_motion(frames, fps)
        assert motion.frames_at(fps) == frames and motion.frames_at(2 * fps) == 2 * frames - 1
        assert replace(motion, closed=True).frames_at(2 * fps) == 2 * frames


@pytest.mark.parametrize("text", ["5:5", "6:5", "0:10", "9:", "a:b", "3", "-1:4", "", f"0:{'9' * 5000}"])
def test_empty_or_impossible_ranges_are_refused(text):
    with pytest.raises(InputError, match="START:END within 0:9"):
        parse_frames(text, 9)


@pytest.mark.parametrize("text", ["0", "x", "12x", "-5", "99999", "1x99999", "3.5", ""])
def test_impossible_sizes_are_refused(text):
    with pytest.raises(InputError, match="--size"):
        parse_size(text)


def test_stage_times_summary():
    times = StageTimes()
    for seconds in (0.001, 0.002, 0.009):
        times.add("a", seconds)
    assert times.summary() == {"a": {"runs": 3, "median_ms": 2.0, "p95_ms": 8.3, "total_s": 0.012}}


def test_the_same_inputs_elsewhere_are_the_same_run(tmp_path) -> None:
    """As on two machines that share the folder for pictures alone, each with a clone of its own."""
    out, frame = tmp_path / "out", tmp_path / "out" / "frames" / "000001.png"
    frame.parent.mkdir(parents=True)
    for place, content in (("one", b"walk"), ("other", b"walk"), ("third", b"jump")):
        (tmp_path / place).write_bytes(content)
    claim(out, {}, [tmp_path / "one"])
    _date(next(out.glob(".run-*")), 1)
    frame.write_bytes(b"one's")
    _date(frame, 1)  # long before what comes
    assert claim(out, {}, [tmp_path / "other"]) == 0 and frame.exists()
    assert claim(out, {}, [tmp_path / "third"]) == 1 and not frame.exists()


def test_pictures_that_no_run_left_stay(tmp_path) -> None:
    """Names such as 000001.png are ffmpeg's, too; those of another run are taken away."""
    inner = tmp_path / "frames" / "cam01" / "000001.png"
    mine, other = tmp_path / "frames" / "000001.png", tmp_path / "frames" / "000002.png"
    inner.parent.mkdir(parents=True)
    for file in (mine, inner, other, tmp_path / "play.mp4"):
        file.write_bytes(b"mine")
        _date(file, 1)
    assert claim(tmp_path, {"size": 1}, []) == 0
    _date(next(tmp_path.glob(".run-*")), 2)
    for file in (other, inner):
        _date(file, 3)
    assert claim(tmp_path, {"size": 2}, []) == 1 and len(list(tmp_path.glob(".run-*"))) == 1
    assert mine.exists() and (tmp_path / "play.mp4").exists() and not other.exists()
    assert inner.exists()  # no run writes there


@pytest.mark.parametrize("locks", [True, False])
def test_a_part_that_starts_while_the_folder_is_cleaned_keeps_its_frames(tmp_path, monkeypatch, locks) -> None:
    """Where the file system has locks it waits; elsewhere its frames are younger than the mark."""
    if not locks:
        monkeypatch.setattr(run_folder, "_lock", lambda file: None)
    frames, original = _left_by_another_run(tmp_path), Path.unlink
    at_hand: list[Path] = []

    def render() -> None:
        claim(tmp_path, {"size": 2}, [])
        for frame in set(frames) - set(at_hand):
            frame.write_bytes(b"new")

    def unlink(file: Path, missing_ok: bool = False) -> None:
        if not at_hand:
            at_hand.append(file)
            part.start()
            part.join(timeout=0.3)
        original(file, missing_ok)

    part = Thread(target=render)
    monkeypatch.setattr(Path, "unlink", unlink)
    claim(tmp_path, {"size": 2}, [])
    part.join()
    assert sorted(frame.read_bytes() for frame in frames if frame.exists()) == [b"new", b"new"]


def test_what_an_interrupted_run_did_not_take_away_the_next_one_does(tmp_path, monkeypatch) -> None:
    frames, original = _left_by_another_run(tmp_path), Path.unlink

    def unlink(file: Path, missing_ok: bool = False) -> None:
        if sum(frame.exists() for frame in frames) == 2:
            raise KeyboardInterrupt
        original(file, missing_ok)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Path, "unlink", unlink)
        claim(tmp_path, {"size": 2}, [])
    assert claim(tmp_path, {"size": 2}, []) == 2 and not any(frame.exists() for frame in frames)


def _left_by_another_run(folder: Path) -> list[Path]:
    """Three frames, of long ago."""
    frames = [folder / "frames" / f"{number:06d}.png" for number in range(3)]
    frames[0].parent.mkdir()
    claim(folder, {"size": 1}, [])
    _date(next(folder.glob(".run-*")), 1)
    for frame in frames:
        frame.write_bytes(b"old")
        _date(frame, 1)
    return frames


def _date(file: Path, seconds: int) -> None:
    os.utime(file, (seconds, seconds))
