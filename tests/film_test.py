"""Frames of a video by number: as many as are shown, upright, in the colours that their stream means."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rnd_trainer.importing.frames import Film

av = pytest.importorskip("av")
FRAMES, HEIGHT, WIDTH = 10, 64, 48
STEP = 20  # of 255 from frame to frame
CODED = 3  # of 255: 4:2:0 and rounding


def _grey() -> list[np.ndarray]:
    return [np.full((HEIGHT, WIDTH, 3), STEP * k, np.uint8) for k in range(FRAMES)]


def _write(path: Path, images: list[np.ndarray], **codec: object) -> Path:
    """Lossless but for its 4:2:0; ``codec``: attributes of its stream's."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=25, options={"qp": "0", "preset": "ultrafast"})
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt = "yuv420p"
        for name, value in codec.items():
            setattr(stream.codec_context, name, value)
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


def test_frames_that_a_cut_hides_are_not_counted(tmp_path) -> None:
    film = Film(_trimmed(_write(tmp_path / "whole.mp4", _grey()), tmp_path / "cut.mp4", 3))
    assert film.count == FRAMES - 3 and list(film.numbers) == list(range(FRAMES - 3))
    for number in (0, 1, 6, 2):
        assert np.abs(film.frame(number).astype(int) - STEP * (number + 3)).max() <= CODED
