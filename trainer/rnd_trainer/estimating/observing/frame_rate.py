"""Videos of variable rate: frames are taken at even times."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .regions import Image

_UNEVEN = 0.25  # of the usual gap: a gap that differs by more is uneven
_OFTEN = 0.02  # share of the gaps


@dataclass(frozen=True, eq=False)
class Regular:
    """A video whose frames are those shown at ``start + k / fps``.

    Attributes:
        shown: [N] the video's own frame number at each time.
        numbers: times k at which a frame appears that was not shown before.
    """

    video: Any
    fps: float
    shown: NDArray[np.int64]
    numbers: list[int]

    def __getattr__(self, name: str) -> Any:
        return getattr(object.__getattribute__(self, "video"), name)

    def frame(self, number: int) -> Image:
        image: Image = self.video.frame(int(self.shown[number]))
        return image


def regular(video: Any) -> Any:
    """``video``, or a ``Regular`` one where the times of its frames are uneven."""
    times = frame_times(video.path, len(video.numbers)) if Path(video.path).is_file() else None
    if times is None or len(times) < 3:
        return video
    gaps = np.diff(times)
    usual = float(np.median(gaps))
    if usual <= 0 or np.mean(np.abs(gaps - usual) > _UNEVEN * usual) <= _OFTEN:
        return video
    at = times[0] + usual * np.arange(int(np.floor((times[-1] - times[0]) / usual + 0.5)) + 1)
    shown = np.clip(np.searchsorted(times, at + usual / 4) - 1, 0, len(times) - 1)
    new = np.flatnonzero(np.diff(shown, prepend=-1) > 0)
    return Regular(video, 1 / usual, shown, new.tolist())


def frame_times(path: Path, count: int) -> NDArray[np.float64] | None:
    """Times [count] of a video's frames, s, ascending; None where the file does not tell them."""
    import av

    with av.open(str(path), metadata_errors="replace") as container:
        stream = container.streams.video[0]
        times = sorted(
            float(packet.pts * stream.time_base) for packet in container.demux(stream) if packet.pts is not None
        )
    return np.array(times) if len(times) == count and np.all(np.diff(times) > 0) else None
