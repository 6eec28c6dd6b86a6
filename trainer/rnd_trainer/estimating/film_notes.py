"""What could have been filmed better, and what cannot be used at all."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.errors import InputError

from .observations import BLAZEPOSE, Observations

Image = NDArray[np.uint8]
Bools = NDArray[np.bool_]

_DARK, _VERY_DARK = 45.0, 12.0  # mean 8-bit value of the person
_SMALL = 400  # pixels of the person's height: finer texture than that is not learned
_FEW = 8  # frames that show a side of the person
_SECTORS = {"front": 0.0, "left side": 90.0, "back": 180.0, "right side": -90.0}
"""sides of the person that face the camera, degrees of the chest's direction about the vertical"""
_SAMPLES = 12
_MARGIN = 1.0  # pixels


def _index(*names: str) -> NDArray[np.int64]:
    return np.array([BLAZEPOSE.index(name) for name in names])


_HEAD = _index("nose", "left_ear", "right_ear")
_HIPS = _index("left_hip", "right_hip")
_FEET = _index("left_ankle", "right_ankle", "left_foot_index", "right_foot_index")
_HANDS = _index("left_wrist", "right_wrist", "left_index", "right_index")


def outside(seen: Observations, points: NDArray[np.int64]) -> Bools:
    """Frames [T] in which one of ``points`` is beyond the image."""
    width, height = seen.image_size
    pixels = seen.keypoints_px[:, points]
    inside = (pixels > -_MARGIN).all(-1) & (pixels[..., 0] < width + _MARGIN) & (pixels[..., 1] < height + _MARGIN)
    return np.asarray(~inside.all(-1))


def cut_off(seen: Observations) -> Bools:
    """Frames [T] in which head, hands or feet are beyond the image."""
    return outside(seen, np.concatenate([_HEAD, _HANDS, _FEET]))


def refuse_unusable(seen: Observations, frame: Callable[[int], Image]) -> None:
    """Raise ``InputError`` where the person is not in full view in most frames, or stands in darkness.

    Args:
        frame: the image of a frame's number.
    """
    count = len(seen)
    parts = {"hips": _HIPS, "head": _HEAD, "feet": _FEET}
    for name, points in parts.items():
        missing = int(outside(seen, points).sum())
        if missing > count / 2:
            shown = "head and shoulders alone" if name == "hips" else f"{name} beyond the image"
            got = f"{shown} in {missing} of {count} frames"
            raise InputError("person", expected="in full view", got=got, hint="step back from the camera")
    brightness = _brightness(seen, frame)
    if brightness < _VERY_DARK:
        raise InputError("person", expected="in light", got=f"a mean of {brightness:.0f} of 255")


def film_notes(seen: Observations, facing_deg: NDArray[np.float64], frame: Callable[[int], Image]) -> list[str]:
    """Sentences on what to film better.

    Args:
        facing_deg: [T] direction of the person's chest about the vertical, 0 towards the camera, 90 where the camera
            sees the left side.
        frame: the image of a frame's number.
    """
    notes = []
    few = {name: int(_faces(facing_deg, at).sum()) for name, at in _SECTORS.items()}
    for name, frames in few.items():
        if frames < _FEW:
            times = "never seen" if frames == 0 else f"seen in {frames} frames"
            notes.append(f"your {name} was {times}: turn round once, slowly")
    for name, points in {"head": _HEAD, "hands": _HANDS, "feet": _FEET}.items():
        missing = int(outside(seen, points).sum())
        if missing:
            notes.append(f"your {name} left the image in {missing} of {len(seen)} frames: step back")
    height = _height(seen)
    if height < _SMALL:
        notes.append(f"you are {height} pixels tall: come closer, or film upright and in 1080p")
    brightness = _brightness(seen, frame)
    if brightness < _DARK:
        notes.append(f"the light is low (a mean of {brightness:.0f} of 255): film in daylight")
    if (hands := float((seen.hands_confidence > 0).mean())) < 0.3:
        notes.append(f"your hands were seen in {hands:.0%} of the frames: relaxed hands are assumed elsewhere")
    return notes


def _faces(facing_deg: NDArray[np.float64], at: float) -> Bools:
    return np.asarray(np.abs((facing_deg - at + 180) % 360 - 180) <= 45)


def _height(seen: Observations) -> int:
    heights = [
        np.ptp(np.flatnonzero((seen.masks[k] > 127).any(1))) + 1 for k in _sampled(seen) if seen.masks[k].max() > 127
    ]
    return int(np.median(heights)) if heights else 0


def _brightness(seen: Observations, frame: Callable[[int], Image]) -> float:
    values = []
    for k in _sampled(seen):
        mask = seen.masks[k] > 127
        if mask.any():
            values.append(float(frame(int(seen.frames[k]))[mask].mean()))
    return float(np.median(values)) if values else 0.0


def _sampled(seen: Observations) -> list[int]:
    return sorted({round(k) for k in np.linspace(0, len(seen) - 1, _SAMPLES)})
