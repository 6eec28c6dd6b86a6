"""The player as a library: what a frame holds, what stands behind it, what it depends on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rnd_runtime.core.camera import Camera
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.gaussians import Gaussians
from rnd_runtime.core.images import linear_to_srgb, srgb_to_linear, to_bytes
from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_runtime.playback.aov import CHANNELS, ambient_visibility, parse_aovs
from rnd_runtime.playback.frame import FrameRenderer, RenderedFrame
from rnd_runtime.playback.framing import CameraOptions, frame_motion, front_path
from rnd_runtime.raster.cpu import rasterize
from rnd_runtime.shading.light import Light
from rnd_runtime.shading.sh import sh_basis, sphere_quadrature
from rnd_viewer.inputs.background import Backdrop, Background
from rnd_viewer.inputs.options import parse_frames
from rnd_viewer.play.run_folder import mark_of, refuse_others
from rnd_viewer.play.timing import StageTimes
from support.play_fakes import FakeAvatar, fake_motion, white_light

MOTION = fake_motion()
INSIDE = 0.99  # alpha above which a pixel shows the surface and nothing else


class FlatShader:
    """Everything glows with one radiance."""

    def __init__(self, radiance: float, light: Light) -> None:
        self.radiance, self.light = radiance, light

    def shade(self, gaussians: Gaussians, camera_position: np.ndarray, seen=None, **options) -> np.ndarray:
        return np.full((len(gaussians.means), 3), self.radiance, np.float32)

    def in_frame(self, frame_to_world: np.ndarray) -> FlatShader:
        return self


def _renderer(radiance: float = 0.18) -> FrameRenderer:
    return FrameRenderer(FakeAvatar(), FlatShader(radiance, white_light()), raster=rasterize)


def _camera(width: int = 96, height: int = 80) -> Camera:
    return front_path(frame_motion(FakeAvatar().skeleton, MOTION), CameraOptions(width, height, 0.6, 0.1))(0, 0.0)


def test_grey_card_is_118():
    """18 % is 118 of 255, and the coding comes after the blending."""
    frame = _renderer().render(MOTION, 0.2, _camera())
    inside = frame.alpha > INSIDE
    assert inside.sum() > 200
    over_itself = replace(frame, background=np.full(3, 0.18, np.float32))
    assert set(over_itself.srgb.ravel()) == {118}
    assert set(frame.srgb[inside].ravel()) <= {117, 118}


def test_blending_is_linear():
    frame = _renderer(0.9).render(MOTION, 0.2, _camera())
    over = replace(frame, background=np.full(3, 0.1, np.float32))
    expected = 0.9 * frame.alpha + 0.1 * (1 - frame.alpha)
    edge = (frame.alpha > 0.2) & (frame.alpha < 0.8)
    assert edge.any()
    np.testing.assert_allclose(over.linear()[..., 0], expected, atol=1e-5)
    np.testing.assert_array_equal(over.srgb, to_bytes(linear_to_srgb(over.linear()[..., :3])))


def test_a_frame_depends_on_nothing_but_its_arguments():
    renderer, camera = _renderer(), _camera()
    first = renderer.render(MOTION, 0.1, camera)
    renderer.render(MOTION, 0.3, _camera(64, 64))
    again = renderer.render(MOTION, 0.1, camera)
    np.testing.assert_array_equal(first.radiance, again.radiance)
    np.testing.assert_array_equal(first.radiance, _renderer().render(MOTION, 0.1, camera).radiance)
    assert (renderer.render(MOTION, 0.3, camera).radiance != first.radiance).any()


def test_nothing_in_view_gives_the_background_back():
    camera = Camera.look_at([0, 1, 5], [0, 1, 10], width=8, height=6, fov_y=0.5)  # its back to the body
    backdrop = Backdrop(Background.parse("#369"))
    frame = backdrop.behind(_renderer().render(MOTION, 0.0, camera), camera, white_light())
    assert not frame.alpha.any()
    np.testing.assert_array_equal(frame.srgb, np.tile([0x33, 0x66, 0x99], (6, 8, 1)))


def test_aovs_are_those_of_the_surface():
    camera = _camera()
    frame = _renderer().render(MOTION, 0.2, camera, aovs=parse_aovs("depth,visibility,roughness,normal,albedo"))
    inside = frame.alpha > INSIDE
    assert list(frame.aovs) == list(CHANNELS)[:5]
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
    plain = _renderer().render(MOTION, 0.2, camera)
    np.testing.assert_allclose(frame.radiance, plain.radiance, atol=1e-6)  # more channels change nothing


def test_normals_are_in_the_cameras_axes():
    """The upper half of every ball points up, which is −Y for the camera."""
    camera = _camera(200, 200)
    frame = _renderer().render(MOTION, 0.0, camera, aovs=("normal",))
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


@pytest.mark.parametrize(
    ("text", "colour"), [("#ff8000", [255, 128, 0]), ("#f0a", [255, 0, 170]), ("Red", [255, 0, 0])]
)
def test_named_and_hex_colours_are_srgb(text, colour):
    np.testing.assert_allclose(Background.parse(text).colour, srgb_to_linear(np.array(colour) / 255))


def test_number_colours_are_linear():
    assert Background.parse("0.1,0.2,3").colour == (0.1, 0.2, 3.0)


@pytest.mark.parametrize("text", ["", "reds", "#12345", "1,2", "1,2,3,4", "nan,0,0", "-1,0,0", "inf,0,0", "1e39,0,0"])
def test_other_backgrounds_are_refused(text):
    with pytest.raises(InputError, match="--background: expected none, hdr"):
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
    frame = _renderer().render(MOTION, 0.0, _camera())
    seen = frame.srgb_alpha[..., 3] > 20
    assert np.abs(frame.srgb_alpha[seen][:, :3].astype(int) - 118).max() <= 1
    assert isinstance(frame, RenderedFrame)


def test_frames_of_a_motion():
    for frames, fps in ((31, 30), (1, 30), (12, 30), (11, 60)):
        motion = fake_motion(frames, fps)
        assert motion.frames_at(fps) == frames and motion.frames_at(2 * fps) == 2 * frames - 1
        assert replace(motion, closed=True).frames_at(2 * fps) == 2 * frames


@pytest.mark.parametrize("text", ["5:5", "6:5", "0:10", "9:", "a:b", "3", "-1:4", "", f"0:{'9' * 5000}"])
def test_empty_or_impossible_ranges_are_refused(text):
    with pytest.raises(InputError, match="START:END within 0:9"):
        parse_frames(text, 9)


def test_stage_times_summary():
    times = StageTimes()
    for seconds in (0.001, 0.002, 0.009):
        times.add("a", seconds)
    assert times.summary() == {"a": {"runs": 3, "median_ms": 2.0, "p95_ms": 8.3, "total_s": 0.012}}


def test_a_run_is_known_by_settings_and_contents(tmp_path):
    for name, content in (("one", b"walk"), ("other", b"walk"), ("third", b"jump")):
        (tmp_path / name).write_bytes(content)
    mark = mark_of(tmp_path, {"size": 1}, [tmp_path / "one"])
    assert mark == mark_of(tmp_path, {"size": 1}, [tmp_path / "other"])  # as on another machine
    assert mark != mark_of(tmp_path, {"size": 1}, [tmp_path / "third"])
    assert mark != mark_of(tmp_path, {"size": 2}, [tmp_path / "one"])


@pytest.mark.parametrize("name", ["frames/000001.png", "frames/mine.jpg", "aov/depth/000001.png", "play.mp4"])
def test_a_folder_with_frames_of_others_is_refused_and_kept(tmp_path, name):
    mark, file = mark_of(tmp_path, {}, []), tmp_path / name
    for harmless in ("notes.txt", "frames/cam01/000001.png", "frames/.part.png"):
        (tmp_path / harmless).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / harmless).touch()
    refuse_others(mark)
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(b"mine")
    with pytest.raises(InputError, match=f"--out holds {name}"):
        refuse_others(mark)
    assert file.read_bytes() == b"mine"
    mark.touch()  # another part of the run has claimed it
    refuse_others(mark)
