"""Frames of a video by number: count, rotation and colours."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.images import linear_to_srgb, srgb_to_linear, to_bytes
from rnd_trainer.importing.videos.video_file import VideoFile

av = pytest.importorskip("av")
FRAMES, HEIGHT, WIDTH = 10, 64, 48
STEP = 20  # of 255 from frame to frame
CODED = 3  # of 255: 4:2:0 and rounding


def _grey() -> list[np.ndarray]:
    return [np.full((HEIGHT, WIDTH, 3), STEP * k, np.uint8) for k in range(FRAMES)]


def _write(path: Path, images: list[np.ndarray]) -> Path:
    """Lossless except for 4:2:0."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=25, options={"qp": "0", "preset": "ultrafast"})
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt = "yuv420p"
        for image in images:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode(None))
    return path


def _trimmed(path: Path, out: Path, count: int) -> Path:
    """``path`` without its first ``count`` frames as phones and ffmpeg cut: an edit list hides their packets."""
    with av.open(str(path)) as source, av.open(str(out), "w") as container:
        stream = container.add_stream_from_template(source.streams.video[0])
        for packet in source.demux(video=0):
            if packet.dts is not None:
                packet.pts -= count * packet.duration
                packet.dts -= count * packet.duration
                packet.stream = stream
                container.mux(packet)
    return out


def test_frames_hidden_by_an_edit_list_are_not_counted(tmp_path) -> None:
    film = VideoFile(_trimmed(_write(tmp_path / "whole.mp4", _grey()), tmp_path / "cut.mp4", 3))
    assert list(film.numbers) == list(range(FRAMES - 3))
    for number in (0, 1, 6, 2):
        assert np.abs(film.frame(number).astype(int) - STEP * (number + 3)).max() <= CODED


def test_a_phones_video_is_upright(tmp_path) -> None:
    """Its container rotates it by 90° clockwise: x' = h − y, y' = x."""
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    image[:8, :8] = 240  # at the upper left of what is stored
    path = _write(tmp_path / "phone.mp4", [image] * 2)
    content = bytearray(path.read_bytes())
    matrix = content.index(b"tkhd") + 4 + 40
    one = 1 << 16
    assert struct.unpack_from(">5i", content, matrix) == (one, 0, 0, 0, one)
    struct.pack_into(">9i", content, matrix, 0, one, 0, -one, 0, 0, HEIGHT * one, 0, 1 << 30)
    path.write_bytes(content)
    film = VideoFile(path)
    assert (film.width, film.height) == (HEIGHT, WIDTH)
    shown = film.frame(1)
    assert shown.shape == (WIDTH, HEIGHT, 3) and shown[:8, -8:].min() > 200
    assert shown[:8, :-10].max() < 40 and shown[10:].max() < 40


@pytest.mark.parametrize(("height", "matrix"), [(720, "itu709"), (480, "itu601")])
def test_unnamed_colours_depend_on_the_size(tmp_path, height, matrix) -> None:
    """BT.709 from 720 lines on, BT.601 below."""
    colours = np.zeros((height, 64, 3), np.uint8) + np.uint8([200, 60, 90])
    frame = av.VideoFrame.from_ndarray(colours, format="rgb24").reformat(format="yuv420p", dst_colorspace=matrix)
    path = tmp_path / "hd.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=25, options={"qp": "0", "preset": "ultrafast"})
        stream.height, stream.width, stream.pix_fmt = height, 64, "yuv420p"
        planes = av.VideoFrame.from_ndarray(frame.to_ndarray(), format="yuv420p")
        container.mux(stream.encode(planes))
        container.mux(stream.encode(None))
    with av.open(str(path)) as container:
        assert int(next(container.decode(video=0)).colorspace) == 2  # not named
    assert np.abs(VideoFile(path).frame(0).astype(int) - colours).max() <= CODED


CASES = Path(__file__).parents[2] / "cases/formats"
SQUARES = [(255, 255, 255), (128, 128, 128), (64, 64, 64), (200, 60, 50), (60, 160, 70), (50, 70, 190)]


@pytest.mark.parametrize(("case", "transfer"), [("hlg", "HLG"), ("pq", "PQ")])
def test_hdr_video_is_converted_to_srgb(case, transfer) -> None:
    """10-bit BT.2020 with white at 75 % of HLG (BT.2408), or at 203 cd/m² of PQ."""
    film = VideoFile(CASES / f"{case}.mp4")
    shown = film.frame(0)
    seen = [shown[y, x].astype(int) for y in (32, 96) for x in (32, 96, 160)]
    assert np.abs(np.array(seen) - SQUARES).max() <= CODED
    assert len(film.notes) == 1 and transfer in film.notes[0] and "203 cd/m²" in film.notes[0]


@pytest.mark.parametrize("primaries", [9, 12])
def test_wide_gamut_is_converted(tmp_path, primaries) -> None:
    """A green that BT.709 has, as BT.2020 and Display P3 of an SDR video write it."""
    to_wide = {  # linear BT.709 → linear BT.2020 (BT.2087) and Display P3
        9: [[0.6274, 0.3293, 0.0433], [0.0691, 0.9195, 0.0114], [0.0164, 0.0880, 0.8956]],
        12: [[0.8225, 0.1775, 0], [0.0332, 0.9668, 0], [0.0171, 0.0724, 0.9105]],
    }
    stored = to_bytes(linear_to_srgb(np.array(to_wide[primaries]) @ srgb_to_linear(np.array([60, 160, 70]) / 255)))
    path = tmp_path / "wide.mp4"
    with av.open(str(path), "w") as container:
        options = {"qp": "0", "preset": "ultrafast", "x264-params": f"colorprim={_NAMES[primaries]}:colormatrix=bt709"}
        stream = container.add_stream("libx264", rate=25, options=options)
        stream.height, stream.width, stream.pix_fmt = HEIGHT, WIDTH, "yuv420p"
        flat = av.VideoFrame.from_ndarray(np.zeros((HEIGHT, WIDTH, 3), np.uint8) + stored, format="rgb24")
        yuv = flat.reformat(format="yuv420p", dst_colorspace="itu709").to_ndarray()
        container.mux(stream.encode(av.VideoFrame.from_ndarray(yuv, format="yuv420p")))
        container.mux(stream.encode(None))
    film = VideoFile(path)
    assert np.abs(film.frame(0)[5, 5].astype(int) - [60, 160, 70]).max() <= 2 * CODED
    assert "wide gamut" in film.notes[0]


_NAMES = {9: "bt2020", 12: "smpte432"}


@pytest.mark.parametrize(("transfer", "named"), [("linear", "linear"), ("log100", "logarithmic")])
def test_other_transfer_functions_are_refused_by_name(tmp_path, transfer, named) -> None:
    path = tmp_path / "log.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=25, options={"x264-params": f"transfer={transfer}"})
        stream.height, stream.width, stream.pix_fmt = HEIGHT, WIDTH, "yuv420p"
        image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
        container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode(None))
    with pytest.raises(InputError, match=rf"log\.mp4: transfer function of the video: expected .*, got {named}$"):
        VideoFile(path)


@pytest.mark.parametrize("rows", [(-1, 0, 0, 1), (1, 0, 0, -1), (0, 1, 1, 0), (0, -1, -1, 0), (-1, 0, 0, -1)])
def test_a_display_matrix_mirrors_and_rotates(tmp_path, rows) -> None:
    """a, b, c, d of a track's header: x' = a x + c y, y' = b x + d y (ISO 14496-12)."""
    a, b, c, d = rows
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    image[8:16, 4:12] = 240
    path = _write(tmp_path / "selfie.mp4", [image] * 2)
    content, one = bytearray(path.read_bytes()), 1 << 16
    matrix = content.index(b"tkhd") + 4 + 40
    struct.pack_into(">9i", content, matrix, a * one, b * one, 0, c * one, d * one, 0, 0, 0, 1 << 30)
    path.write_bytes(content)
    shown = VideoFile(path).frame(0)
    y, x = np.mgrid[8:16, 4:12]
    right, down = (a * x + c * y).ravel(), (b * x + d * y).ravel()
    height, width = (HEIGHT, WIDTH) if a else (WIDTH, HEIGHT)
    assert shown.shape == (height, width, 3)
    expected = np.zeros((height, width), bool)
    expected[down + (height - 1) * (down.min() < 0), right + (width - 1) * (right.min() < 0)] = True
    assert (shown[expected] > 200).all() and (shown[~expected] < 60).all()


def test_a_slanted_display_matrix_is_refused(tmp_path) -> None:
    path = _write(tmp_path / "slanted.mp4", _grey())
    content = bytearray(path.read_bytes())
    half = round(0.7071 * (1 << 16))
    numbers = (half, half, 0, -half, half, 0, 0, 0, 1 << 30)
    struct.pack_into(">9i", content, content.index(b"tkhd") + 44, *numbers)
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"slanted.mp4: display matrix of the video: expected quarter rotations"):
        VideoFile(path)
