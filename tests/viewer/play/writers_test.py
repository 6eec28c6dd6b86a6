"""What the player writes: clips' colours through decoders, PNG alpha, EXR layers, the pictures of AOVs."""

from __future__ import annotations

import dataclasses
import sys

import av
import numpy as np
import pytest
from PIL import Image

from rnd_runtime.core.camera import Camera
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.images import linear_to_srgb, read_header, read_image, to_bytes
from rnd_runtime.playback.aov import aov_image, aov_values
from rnd_runtime.playback.frame import RenderedFrame
from rnd_viewer.play.timing import StageTimes
from rnd_viewer.play.video import clip_notes, clip_writer, rgb_to_yuv420
from rnd_viewer.play.writers import frame_writer, parse_formats

PATCH = 24  # pixels; the middle of a patch is far enough from its neighbours' chroma
DECODED_WEBP = 8  # of 255, inside a patch whose neighbours are of any colour: quality 85 and halved chroma
DECODED = 3  # of 255: two roundings to limited range (each ±0.5 · 255/219) and x264 at CRF 18
REACH = (2.0, 4.0)
CAMERA = Camera.look_at([0, 1, 3], [0, 1, 0], width=11, height=4, fov_y=0.6)


def _flat(colour, height=4, width=6) -> np.ndarray:
    return np.broadcast_to(np.array(colour, np.uint8), (height, width, 3)).copy()


@pytest.mark.parametrize(
    ("rgb", "ycbcr"),
    [  # 8-bit BT.709 bars at 100 %, as printed in broadcast tables
        ((255, 255, 255), (235, 128, 128)),
        ((0, 0, 0), (16, 128, 128)),
        ((255, 0, 0), (63, 102, 240)),
        ((0, 255, 0), (173, 42, 26)),
        ((0, 0, 255), (32, 240, 118)),
        ((255, 255, 0), (219, 16, 138)),
    ],
)
def test_primaries_have_the_code_values_of_bt709(rgb, ycbcr):
    planes = rgb_to_yuv420(_flat(rgb)).ravel()
    assert set(planes[:24]) == {ycbcr[0]}
    assert set(planes[24:30]) == {ycbcr[1]}
    assert set(planes[30:]) == {ycbcr[2]}


def test_chroma_sits_on_the_left_column_of_each_pair():
    """Along a ramp of blue, the filtered chroma of a pair is that of its even column, not of its middle."""
    ramp = np.zeros((2, 20, 3), np.uint8)
    ramp[..., 2] = 10 + 12 * np.arange(20)
    blue = ramp[0, ::2, 2] / 255
    expected = 128 + 224 * (1 - 0.0722) / 1.8556 * blue
    chroma = rgb_to_yuv420(ramp).ravel()[40:50]
    assert np.abs(chroma[1:] - expected[1:]).max() <= 0.5  # half a step is rounding; the middle would be 2.6 off


def test_mp4_gives_back_the_colours(tmp_path):
    colours = np.random.default_rng(3).integers(0, 256, (5, 5, 3), np.uint8)
    colours[0, :3] = [[255, 0, 0], [0, 255, 0], [0, 0, 255]]
    image = colours.repeat(PATCH, axis=0).repeat(PATCH, axis=1)[:-1]  # odd height
    with clip_writer(tmp_path / "a.mp4", fps=29.97) as append:
        for _ in range(3):
            append(image)
    with av.open(str(tmp_path / "a.mp4")) as container:
        stream = container.streams.video[0]
        assert float(stream.average_rate) == 29.97
        tags = (stream.codec_context.color_primaries, stream.codec_context.color_trc)
        assert (*tags, stream.codec_context.colorspace, stream.codec_context.color_range) == (1, 13, 1, 1)
        frames = list(container.decode(video=0))
    assert len(frames) == 3
    for frame in frames:
        decoded = frame.to_ndarray(format="rgb24").astype(int)
        assert decoded.shape == (5 * PATCH, 5 * PATCH, 3)  # padded to even
        middles = decoded.reshape(5, PATCH, 5, PATCH, 3)[:, 8:-8, :, 8:-8]
        difference = np.abs(middles - colours[:, None, :, None])
        assert difference.max() <= DECODED


def test_webp_moves_forever_in_its_colours_and_is_transparent(tmp_path):
    """Lossy colour, by patches; alpha to the last bit; as a browser's own library reads it."""
    rng = np.random.default_rng(4)
    colours, alphas = (rng.integers(0, 256, (3, 5, 5, 3), np.uint8), rng.integers(64, 256, (3, 5, 5, 1), np.uint8))
    images = np.concatenate([colours, alphas], -1).repeat(PATCH, axis=1).repeat(PATCH, axis=2)[:, :-1]
    contents = set()
    for _ in range(3):
        with clip_writer(tmp_path / "a.webp", fps=20) as append:
            for image in images:
                append(image)
        contents.add((tmp_path / "a.webp").read_bytes())
    assert len(contents) == 1
    with Image.open(tmp_path / "a.webp") as clip:
        assert (clip.n_frames, clip.info["loop"], clip.size) == (3, 0, (5 * PATCH, 5 * PATCH - 1))
        for number, image in enumerate(images):
            clip.seek(number)
            decoded = np.asarray(clip.convert("RGBA")).astype(int)
            assert clip.info["duration"] == 50
            np.testing.assert_array_equal(decoded[..., 3], image[..., 3])
            middle = (slice(8, None, PATCH), slice(8, None, PATCH))
            assert np.abs(decoded[middle][..., :3] - image[middle][..., :3]).max() <= DECODED_WEBP


def test_webm_is_transparent_in_its_colours(tmp_path):
    """By libvpx, as browsers do: ffmpeg's own VP9 decoder leaves the alpha out."""
    rng = np.random.default_rng(4)
    colours, alphas = rng.integers(0, 256, (5, 5, 3), np.uint8), rng.integers(64, 256, (5, 5, 1), np.uint8)
    image = np.concatenate([colours, alphas], -1).repeat(PATCH, axis=0).repeat(PATCH, axis=1)[:-1]
    contents = set()
    for name in "ab":
        with clip_writer(tmp_path / f"{name}.webm", fps=30) as append:
            for _ in range(3):
                append(image)
        contents.add((tmp_path / f"{name}.webm").read_bytes())
    assert len(contents) == 1
    with av.open(str(tmp_path / "a.webm")) as container:
        decoder = av.CodecContext.create("libvpx-vp9", "r")
        frames = [frame for packet in container.demux(video=0) for frame in decoder.decode(packet)]
    assert len(frames) == 3 and frames[0].format.name == "yuva420p"
    for frame in frames:
        frame.colorspace = 1  # libvpx does not tell
        decoded = frame.to_ndarray(format="rgba")[8::PATCH, 8::PATCH].astype(int)
        assert np.abs(decoded - image[8::PATCH, 8::PATCH]).max() <= DECODED_WEBP


@pytest.mark.parametrize(("fps", "every"), [(30, 1), (90, 1), (100, 2), (120, 2), (240, 3), (1200, 14)])
def test_webp_has_no_frame_that_browsers_hold_for_ten_times_as_long(tmp_path, fps, every):
    """Chromium, Firefox and Safari show one of 10 ms or less for 100."""
    frames = [_flat(3 * (67 * number % 256,), 16, 16) for number in range(60)]
    with clip_writer(tmp_path / "a.webp", fps=fps) as append:
        for frame in frames:
            append(frame)
    durations = []
    with Image.open(tmp_path / "a.webp") as clip:
        for number in range(clip.n_frames):
            clip.seek(number)
            shown = np.asarray(clip.convert("RGB")).astype(int)
            durations.append(clip.info["duration"])
            assert np.abs(shown[8, 8] - frames[number * every][8, 8]).max() <= DECODED_WEBP
    assert len(durations) == len(frames[::every]) and min(durations) > 10
    assert sum(durations) == pytest.approx(1000 * len(durations) * every / fps, abs=1.5)
    assert len(clip_notes(("png", "webp"), fps)) == (every > 1) and clip_notes(("mp4",), fps) == []


def test_webp_over_a_background_is_opaque(tmp_path, frame):
    _write(tmp_path, dataclasses.replace(frame, background=np.ones(3, np.float32)), ("webp",))
    with Image.open(tmp_path / "play.webp") as clip:
        assert np.asarray(clip.convert("RGBA"))[..., 3].min() == 255


def test_mp4_of_the_same_frames_has_the_same_bytes(tmp_path):
    """Small and in motion: there x264's macroblock tree gave a different file every second time."""
    rows, columns = np.mgrid[:48, :48]
    frames = []
    for k in range(20):  # a shaded ball crosses the black picture
        x, y = columns - 8 - 1.6 * k, rows - 24 - 8 * np.sin(k / 3)
        height = np.sqrt(np.maximum(100 - x * x - y * y, 0))
        frames.append((height[..., None] * np.array([25, 18, 9]) + (height > 0)[..., None] * 4).astype(np.uint8))
    contents = set()
    for _ in range(40):
        scattered = [np.random.default_rng(k).random(1000 * k) for k in range(9)]  # memory is not where it was
        with clip_writer(tmp_path / "a.mp4", fps=30) as append:
            for frame in frames:
                append(frame)
        contents.add((tmp_path / "a.mp4").read_bytes())
        del scattered
    assert len(contents) == 1


def test_interrupted_mp4_leaves_nothing_and_spares_what_was_there(tmp_path):
    (tmp_path / "a.mp4").write_bytes(b"before")
    with pytest.raises(KeyboardInterrupt), clip_writer(tmp_path / "a.mp4", fps=30) as append:
        append(_flat((1, 2, 3), 32, 32))
        raise KeyboardInterrupt
    assert [file.name for file in tmp_path.iterdir()] == ["a.mp4"]
    assert (tmp_path / "a.mp4").read_bytes() == b"before"


def test_missing_pyav_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(InputError, match=r"rnd-avatar\[video\]"):
        parse_formats("png,mp4")


def test_formats():
    assert parse_formats("mp4,png") == ("png", "mp4")
    assert parse_formats(None) == ("png", "mp4")
    assert parse_formats("webp,png") == ("png", "webp")
    for text in ("gif", "png,tiff", ""):
        with pytest.raises(InputError, match="png,exr,mp4,mov,webm,webp"):
            parse_formats(text)


@pytest.fixture
def frame() -> RenderedFrame:
    """A ramp of coverage from 0 to 1 over 11 columns of one colour, and a normal that faces us."""
    alpha = np.tile(np.linspace(0, 1, 11, dtype=np.float32), (4, 1))
    radiance = alpha[..., None] * np.array([0.18, 0.5, 2.0], np.float32)
    normal = alpha[..., None] * np.array([0, 0, -1], np.float32)
    depth = alpha[..., None] * np.float32(2.5)
    aovs = {
        name: aov_values(name, value, alpha)
        for name, value in (("albedo", radiance / 4), ("normal", normal), ("depth", depth))
    }
    return RenderedFrame(radiance, alpha, aovs)


def _write(tmp_path, frame: RenderedFrame, formats: tuple[str, ...]) -> set[str]:
    with frame_writer(tmp_path, formats, fps=30, times=StageTimes()) as write:
        write(7, frame, REACH, CAMERA)
    return {str(file.relative_to(tmp_path)) for file in tmp_path.rglob("*") if file.is_file()}


def test_every_format_has_its_place(tmp_path, frame):
    aovs = {f"aov/{name}/000007.png" for name in ("albedo", "normal", "depth")}
    assert _write(tmp_path / "p", frame, ("png",)) == {"frames/000007.png"} | aovs
    assert _write(tmp_path / "e", frame, ("exr",)) == {"frames_exr/000007.exr"}
    assert _write(tmp_path / "m", frame, ("mp4",)) == {"play.mp4"} | aovs
    assert _write(tmp_path / "w", frame, ("webp",)) == {"play.webp"} | aovs
    everything = {"frames/000007.png", "frames_exr/000007.exr", "play.mp4", "play.mov", "play.webp"} | aovs
    assert _write(tmp_path / "a", frame, ("png", "exr", "mp4", "mov", "webp")) == everything


def test_png_without_background_has_straight_alpha(tmp_path, frame):
    _write(tmp_path, frame, ("png",))
    image = read_image(tmp_path / "frames/000007.png")
    assert image.shape == (4, 11, 4)
    np.testing.assert_array_equal(image[0, 1:, :3], np.tile([118, 188, 255], (10, 1)))  # the same at any coverage
    np.testing.assert_array_equal(image[0, :, 3], to_bytes(np.linspace(0, 1, 11)))


def test_exr_keeps_linear_premultiplied_values_in_named_layers(tmp_path, frame):
    _write(tmp_path, frame, ("exr",))
    file = tmp_path / "frames_exr/000007.exr"
    names = read_header(file).channels
    layers = dict(zip(names, np.moveaxis(read_image(file), -1, 0)))
    assert set(names) == {
        *("R", "G", "B", "A", "Z", "albedo.R", "albedo.G", "albedo.B", "normal.X", "normal.Y", "normal.Z")
    }
    np.testing.assert_array_equal(np.dstack([layers["R"], layers["G"], layers["B"]]), frame.radiance)
    np.testing.assert_array_equal(layers["A"], frame.alpha)
    np.testing.assert_array_equal(layers["albedo.B"], frame.radiance[..., 2] / 4)
    covered = frame.alpha >= 0.05
    np.testing.assert_allclose(layers["Z"], np.where(covered, 2.5, 0), rtol=1e-6)
    np.testing.assert_allclose(layers["normal.Z"], np.where(covered, -1, 0), rtol=1e-6)


def test_background_is_laid_under_in_linear_light(tmp_path, frame):
    over = RenderedFrame(frame.radiance, frame.alpha, background=np.array([0.4, 0.4, 0.4], np.float32))
    _write(tmp_path, over, ("png", "exr"))
    expected = frame.radiance + (1 - frame.alpha[..., None]) * np.float32(0.4)
    exr = read_image(tmp_path / "frames_exr/000007.exr")
    np.testing.assert_array_equal(exr[..., :3], expected)
    assert (exr[..., 3] == 1).all()
    png = read_image(tmp_path / "frames/000007.png")
    np.testing.assert_array_equal(png, to_bytes(linear_to_srgb(expected)))


def test_aov_pictures(frame):
    pictures = {name: aov_image(name, frame.aovs[name], frame.alpha, REACH)[0] for name in frame.aovs}
    np.testing.assert_array_equal(pictures["albedo"], to_bytes(linear_to_srgb(frame.radiance[0] / 4)))
    np.testing.assert_array_equal(pictures["normal"][1:], np.tile([128, 128, 0], (10, 1)))
    assert (pictures["depth"][1:] == to_bytes((4 - 2.5) / 2)).all()
    assert not pictures["normal"][0].any() and not pictures["depth"][0].any()
