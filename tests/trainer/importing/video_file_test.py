"""Frames of a video by number: count, rotation and colours."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from rnd_trainer.importing.video_file import VideoFile

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
