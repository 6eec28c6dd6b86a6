"""33 points and a mask of a person in one image, by several views of BlazePose's landmark network.

Source: Grishchenko et al. 2022, BlazePose GHUM Holistic.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.avatar.inference import run_session
from rnd_trainer.estimating.observations import BLAZEPOSE

from .regions import Floats, Image, Region, Shrunk, moved, uncrop

SIDE = 256  # pixels of the network's input
POINTS = len(BLAZEPOSE)
_HEAT_SIDE, _HEAT_REACH, _MIN_HEAT = 64, 4, 0.5  # heat maps: side, cells around a point, least probability


def _mirrored() -> NDArray[np.int64]:
    names = list(BLAZEPOSE)
    other = {"left": "right", "right": "left"}
    swapped = ["_".join(other.get(word, word) for word in name.split("_")) for name in names]
    return np.array([names.index(name) for name in swapped])


MIRRORED = _mirrored()
"""index of the point on the person's other side"""


@dataclass(frozen=True, eq=False)
class View:
    """What one pass of the network sees.

    Attributes:
        points: [33, 2] pixels.
        metres: [33, 3] from the middle of the hips, camera axes.
        confidence: [33] 0…1.
        score: that there is a person, 0…1.
        next_region: where the person is looked for next.
    """

    points: Floats
    metres: Floats
    confidence: Floats
    score: float
    next_region: Region
    mask: NDArray[np.float32]  # [256, 256] in the crop, 0…1
    to_image: Floats  # [2, 3]


@dataclass(frozen=True, eq=False)
class Views:
    """Views of one image: arrays over the V views, and the mean of their masks [H, W] in 0…1, or none, [0, 0]."""

    points: Floats  # [V, 33, 2]
    metres: Floats  # [V, 33, 3]
    confidence: Floats  # [V, 33]
    score: float
    mask: NDArray[np.float32]
    region: Region

    def without_mask(self) -> Views:
        """The same with a mask of no pixels: many frames' masks fill the memory."""
        return replace(self, mask=np.zeros((0, 0), np.float32))


class LandmarkNetwork:
    """Points of the person in a region: ``session`` is the network ``pose_landmarks``."""

    def __init__(self, session: Any) -> None:
        self._session = session

    def look(self, image: Shrunk, region: Region, *, mirrored: bool = False) -> View:
        """One view of ``region``; ``mirrored`` shows the network its mirror image."""
        pixels = image.crop(region, SIDE)
        if mirrored:
            pixels = pixels[:, ::-1]
        outputs = run_session(self._session, None, {"image": np.ascontiguousarray(pixels[None])})
        rows = outputs[0].reshape(-1, 5).astype(np.float64)
        rows[:, :2] = _sharpened(rows[:, :2], outputs[3][0])
        metres, mask = outputs[4].reshape(-1, 3).astype(np.float64), _sigmoid(outputs[2][0, ..., 0])
        if mirrored:
            rows[:, 0] = SIDE - rows[:, 0]
            metres[:, 0] *= -1
            rows[:POINTS], metres[:POINTS] = rows[MIRRORED], metres[MIRRORED]
            mask = mask[:, ::-1]
        to_image = region.to_image(SIDE)
        points = moved(rows[:, :2], to_image)
        cosine, sine = np.cos(region.rotation), np.sin(region.rotation)
        metres[:, :2] = metres[:, :2] @ np.array([[cosine, sine], [-sine, cosine]])
        return View(
            points=points[:POINTS],
            metres=metres[:POINTS],
            confidence=_sigmoid(rows[:POINTS, 3]) * _sigmoid(rows[:POINTS, 4]),
            score=float(outputs[1].reshape(-1)[0]),
            next_region=Region.of_body(points[POINTS], points[POINTS + 1]),
            mask=np.ascontiguousarray(mask, np.float32),
            to_image=to_image,
        )

    def look_twice(self, image: Image, region: Region, first: View | None = None, *, with_mask: bool = True) -> Views:
        """Two views of ``region``, as is and mirrored; ``first`` is the former where it has been taken."""
        shrunk = Shrunk(image, region.size, SIDE)
        plain = first or self.look(shrunk, region)
        views = [plain, self.look(shrunk, region, mirrored=True)]
        mask = np.zeros((0, 0), np.float32)
        if with_mask:
            size = image.shape[1], image.shape[0]
            one, other = (uncrop(view.mask, view.to_image, size) for view in views)
            mask = np.asarray((one + other) / 2, np.float32)
        return Views(
            points=np.stack([view.points for view in views]),
            metres=np.stack([view.metres for view in views]),
            confidence=np.stack([view.confidence for view in views]),
            score=float(np.mean([view.score for view in views])),
            mask=mask,
            region=region,
        )


def _sharpened(points: Floats, heat: NDArray[np.float32]) -> Floats:
    """``points`` [39, 2] in the crop, moved to the centre of heat [64, 64, 39] around them where there is some."""
    sharpened, step = points.copy(), SIDE / _HEAT_SIDE
    for joint, (x, y) in enumerate(points):
        column, row = int(x / step), int(y / step)
        if not (0 <= column < _HEAT_SIDE and 0 <= row < _HEAT_SIDE):
            continue
        top, left = max(row - _HEAT_REACH, 0), max(column - _HEAT_REACH, 0)
        near = _sigmoid(heat[top : row + _HEAT_REACH + 1, left : column + _HEAT_REACH + 1, joint])
        if near.max() >= _MIN_HEAT:
            rows, columns = np.indices(near.shape)
            total = near.sum()
            sharpened[joint] = (columns * near).sum() / total + left, (rows * near).sum() / total + top
            sharpened[joint] *= step
    return sharpened


def _sigmoid(logits: NDArray[Any]) -> NDArray[Any]:
    return 1 / (1 + np.exp(-np.clip(logits, -50, 50)))
