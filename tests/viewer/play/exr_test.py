"""Frames for compositors: EXR layers and attributes, split light, motion, parts, ProRes with alpha."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import OpenImageIO as oiio
import pytest

from rnd_runtime.avatar.avatar import Avatar
from rnd_runtime.core.camera import Camera
from rnd_runtime.motion.motion import load_motion
from rnd_runtime.playback.aov import parse_aovs
from rnd_runtime.playback.cryptomatte import RANKS, attributes, identifier, layers, murmur3
from rnd_runtime.playback.frame import FrameRenderer, RenderedFrame
from rnd_runtime.playback.framing import CameraOptions, frame_motion, front_path
from rnd_runtime.playback.scene import Person
from rnd_runtime.shading.shader import Shader
from rnd_viewer.inputs.lights import chosen_light
from rnd_viewer.play.exr import CHROMATICITIES, ExrWriter, camera_matrices
from rnd_viewer.play.given import GivenFeatures
from rnd_viewer.play.video import clip_writer
from support.tiny import ASSETS

NAMES = "albedo,depth,diffuse,specular,shadow,motion,parts"
FRAME, STEP = 4, 5  # of a run that shows every fifth frame


@pytest.fixture(scope="module")
def scene():
    """A renderer of the embedded avatar, its walk, and a camera."""
    avatar = Avatar.load(ASSETS / "avatar.onnx", threads=1)
    walk = load_motion(ASSETS / "walk.npz", avatar.skeleton)
    camera = front_path(frame_motion(avatar.skeleton, walk), CameraOptions(224, 224))(0, 0.0)
    light = chosen_light(avatar, ASSETS / "sky.exr", up="y", yaw=0, exposure=0)
    return FrameRenderer(avatar, light), walk, camera


@pytest.fixture(scope="module")
def frame(scene) -> RenderedFrame:
    renderer, walk, camera = scene
    aovs = parse_aovs(NAMES)
    encoded = renderer.avatar.encode(walk, FRAME * STEP / walk.fps)
    features = GivenFeatures(Person(renderer.avatar, walk), walk.fps / STEP, 26, lambda k, t: camera, aovs)
    return renderer.draw(encoded, camera, aovs=aovs, given=features.of(FRAME, encoded, camera))


def test_light_is_split_without_loss(frame, scene):
    renderer, walk, camera = scene
    split = frame.aovs
    np.testing.assert_allclose(split["diffuse"] + split["specular"], frame.radiance, atol=1e-5)
    assert split["specular"].min() > -1e-6 and split["diffuse"].min() > -1e-6
    assert 0.02 < split["specular"].mean() / split["diffuse"].mean() < 0.5

    class Bright(Shader):
        def sunlit(self, *arguments):
            return np.ones_like(super().sunlit(*arguments))

    bright = FrameRenderer(renderer.avatar, Bright(renderer.light), camera).render(walk, FRAME * STEP / walk.fps)
    np.testing.assert_allclose(frame.radiance + split["shadow"], bright.radiance, atol=1e-5)
    assert split["shadow"].max() > 0.1


def test_motion_leads_to_the_next_frame(frame, scene):
    """The albedo of the next frame, taken back by the motion, is this frame's."""
    renderer, walk, camera = scene
    following = renderer.render(walk, (FRAME + 1) * STEP / walk.fps, camera, aovs=("albedo",))
    rows, columns = np.nonzero(frame.alpha > 0.99)
    u, v = frame.aovs["motion"][rows, columns].T
    assert np.hypot(u, v).max() > 3  # px
    moved = np.clip(np.rint(rows - v).astype(int), 0, 223), np.clip(np.rint(columns + u).astype(int), 0, 223)
    here = frame.aovs["albedo"][rows, columns]
    carried = np.abs(following.aovs["albedo"][moved] - here).mean()
    still = np.abs(following.aovs["albedo"][rows, columns] - here).mean()
    assert carried < 0.6 * still


def test_a_camera_that_moves_gives_motion_too(scene):
    """A camera that shifts its principal point by five pixels."""
    renderer, walk, camera = scene
    shifted = replace(camera, K=camera.K + np.array([[0, 0, 5.0], [0, 0, 0], [0, 0, 0]]))
    person = Person(renderer.avatar, walk)
    features = GivenFeatures(person, walk.fps, walk.frame_count, lambda k, t: [camera, shifted][k > FRAME], ("motion",))
    still = replace(features, camera_at=lambda k, t: camera)
    encoded = renderer.avatar.encode(walk, FRAME / walk.fps)
    moves, stays = (each.of(FRAME, encoded, camera)["motion"] for each in (features, still))
    np.testing.assert_allclose(moves - stays, np.tile([5, 0], (len(moves), 1)), atol=1e-3)
    last = walk.frame_count - 1
    end = renderer.avatar.encode(walk, last / walk.fps)
    assert np.abs(still.of(last, end, camera)["motion"]).max() == 0


def test_parts_cover_the_body(frame, scene):
    renderer, *_ = scene
    coverage, names = frame.aovs["parts"], renderer.avatar.skeleton.names
    np.testing.assert_allclose(coverage.sum(axis=2), frame.alpha, atol=1e-5)
    packed = layers(coverage, names)
    assert packed.shape[2] == 2 * RANKS
    assert (np.diff(packed[..., 1::2], axis=2) <= 0).all()  # the largest first
    rows, _ = np.nonzero(packed[..., 0] == identifier("head"))
    feet, _ = np.nonzero(packed[..., 0] == identifier("left_ankle"))
    assert rows.max() < feet.min()


def test_hashes_are_murmurs():
    """Values of its reference implementation."""
    known = {"hello": 0x248BFA47, "hello, world": 0x149BBB7F, "The quick brown fox jumps over the lazy dog": 0x2E4FF723}
    assert {text: murmur3(text) for text in known} == known and murmur3("") == 0
    assert np.isfinite([identifier(str(k)) for k in range(20000)]).all()


@pytest.mark.parametrize("space", ["rec709", "acescg"])
@pytest.mark.parametrize("half", [False, True])
def test_an_exr_says_what_it_holds(frame, scene, tmp_path, space, half):
    renderer, _, camera = scene
    names = renderer.avatar.skeleton.names
    ExrWriter(23.976, half, space, names).write(tmp_path / "a.exr", frame, camera)
    image = oiio.ImageBuf(str(tmp_path / "a.exr"))
    spec, pixels = image.spec(), image.get_pixels("float")
    at = {name: pixels[..., k] for k, name in enumerate(spec.channelnames)}
    kinds = {n: str(spec.channelformat(k)) for k, n in enumerate(spec.channelnames)}
    assert {kinds[name] for name in ("R", "A", "albedo.G", "diffuse.B")} == {"half" if half else "float"}
    assert {kinds[name] for name in ("Z", "forward.u", "CryptoPart00.R")} == {"float"}
    np.testing.assert_allclose(spec.getattribute("chromaticities"), CHROMATICITIES[space], atol=1e-6)
    rate = spec.getattribute("FramesPerSecond")
    assert rate[0] / rate[1] == pytest.approx(24000 / 1001, rel=1e-6)
    for key, value in attributes(names).items():
        assert spec.getattribute(key) == value
    manifest = json.loads(next(v for k, v in attributes(names).items() if k.endswith("manifest")))
    assert int(manifest["head"], 16) == int(np.array(identifier("head")).view(np.uint32))
    tolerance = {"rtol": 1e-3, "atol": 1e-4} if half else {"atol": 1e-6}
    rgb = np.stack([at[c] for c in "RGB"], axis=-1)
    if space == "rec709":
        np.testing.assert_allclose(rgb, frame.radiance, **tolerance)
    else:  # the luminance Y of both spaces' XYZ, and a grey that stays grey
        y709, y_ap1 = np.array([0.2126, 0.7152, 0.0722]), np.array([0.2722287, 0.6740818, 0.0536895])
        np.testing.assert_allclose(rgb @ y_ap1, frame.radiance @ y709, rtol=0.02, atol=2e-3)
        np.testing.assert_allclose(np.ones(3) @ ExrWriter(30, space=space)._matrix, 1, atol=1e-3)


def test_the_cameras_matrices_are_openexrs():
    camera = Camera.look_at([1, 2, 4], [0.1, 0.9, 0], width=640, height=360, fov_y=0.7)
    to_camera, to_ndc = camera_matrices(camera)
    point = np.array([0.3, 1.4, 0.2, 1])
    seen = camera.world_to_camera @ point
    np.testing.assert_allclose(point @ to_camera, seen * [1, -1, 1, 1], atol=1e-12)
    pixel = camera.K @ seen[:3] / seen[2]
    x, y, _, w = point @ to_ndc
    np.testing.assert_allclose([x / w * 640, y / w * 360], pixel[:2], atol=1e-9)


def test_prores_keeps_alpha(tmp_path):
    av = pytest.importorskip("av")
    image = np.zeros((64, 96, 4), np.uint8)
    image[..., :3] = (200, 60, 50)
    image[..., 3] = np.linspace(0, 255, 96).astype(np.uint8)
    for name in ("a", "b"):
        with clip_writer(tmp_path / f"{name}.mov", fps=24) as append:
            append(image)
            append(image)
    assert (tmp_path / "a.mov").read_bytes() == (tmp_path / "b.mov").read_bytes()
    with av.open(str(tmp_path / "a.mov")) as container:
        stream = container.streams.video[0]
        assert stream.codec_context.name == "prores" and stream.average_rate == 24
        frames = list(container.decode(stream))
    assert len(frames) == 2 and frames[0].format.name.startswith("yuva444p")
    depth = int(frames[0].format.name.removeprefix("yuva444p").removesuffix("le")) - 8
    planes = [
        np.frombuffer(bytes(p), "<u2").reshape(-1, p.line_size // 2)[:64, :96] / 2.0**depth for p in frames[0].planes
    ]
    luma = (planes[0] - 16) / 219
    red = 255 * (luma + 1.5748 * (planes[2] - 128) / 224)
    blue = 255 * (luma + 1.8556 * (planes[1] - 128) / 224)
    assert abs(red - 200).max() < 3 and abs(blue - 50).max() < 3
    assert abs(planes[3] * 255 / (1023 / 4) - image[..., 3]).max() < 2
