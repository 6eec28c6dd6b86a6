"""Finding people in one image by BlazePose's detector.

Source: Bazarevsky et al. 2020, BlazePose; Liu et al. 2016, SSD (anchors).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rnd_runtime.avatar.inference import run_session

from .regions import Floats, Image, Region

SIDE = 224  # pixels of the network's input
MIN_SCORE = 0.5
_STRIDES = ((8, 2), (16, 2), (32, 6))  # pixels between anchors, anchors at each
_PARTS = (1.0, 0.6)  # of the image's shorter side
_SAME = 0.3  # overlap from which candidates in one square are averaged
_LOW = 0.3  # score of candidates that are averaged with a better one


@dataclass(frozen=True)
class Detection:
    """A person's region, and how sure the detector is, 0…1."""

    region: Region
    score: float


class Detector:
    """People in an image: ``session`` is the network ``person_detector``."""

    def __init__(self, session: Any) -> None:
        self._session = session
        self._anchors = np.concatenate([_anchors(SIDE // stride, count) for stride, count in _STRIDES])

    def __call__(self, image: Image) -> list[Detection]:
        """The people in ``image``, surest first; parts are searched too, as the whole often shows one of several."""
        height, width = image.shape[:2]
        found = self._in_square(image, np.array([width / 2, height / 2]), max(height, width))
        for part in (fraction * min(height, width) for fraction in _PARTS):
            for y in _centres(height, part):
                for x in _centres(width, part):
                    found += self._in_square(image, np.array([x, y]), part)
        return _distinct(sorted(found, key=lambda one: -one.score))

    def _in_square(self, image: Image, centre: Floats, side: float) -> list[Detection]:
        scale = SIDE / side
        matrix = np.array([[scale, 0, SIDE / 2 - scale * centre[0]], [0, scale, SIDE / 2 - scale * centre[1]]])
        factor = max(1, int(side / SIDE))
        small: NDArray[Any] = image
        if factor > 1:
            small = cv2.resize(image, None, fx=1 / factor, fy=1 / factor, interpolation=cv2.INTER_AREA)
            matrix[:, :2] *= [[image.shape[1] / small.shape[1], image.shape[0] / small.shape[0]]]
        pixels = cv2.warpAffine(small, matrix, (SIDE, SIDE), flags=cv2.INTER_LINEAR).astype(np.float32)
        boxes, scores = run_session(self._session, None, {"image": pixels[None] / 127.5 - 1})
        scores = 1 / (1 + np.exp(-np.clip(scores[0, :, 0], -50, 50)))
        likely = np.flatnonzero(scores > _LOW)
        likely = likely[np.argsort(-scores[likely], kind="stable")]
        points = boxes[0, likely, 4:8].reshape(-1, 2, 2) / SIDE + self._anchors[likely][:, None]
        points = (points - 0.5) * side + centre
        return _distinct(_averaged(points, scores[likely]))


def _anchors(cells: int, count: int) -> Floats:
    centres = (np.arange(cells) + 0.5) / cells
    y, x = np.meshgrid(centres, centres, indexing="ij")
    return np.repeat(np.stack([x.ravel(), y.ravel()], 1), count, axis=0)


def _averaged(points: Floats, scores: NDArray[Any]) -> list[Detection]:
    """Detections of candidates ``points`` [N, 2, 2], best first: overlapping ones are averaged by score."""
    regions = [Region.of_body(hips, top) for hips, top in points]
    left, found = list(range(len(regions))), []
    while left and scores[left[0]] >= MIN_SCORE:
        best = left[0]
        same = [k for k in left if regions[best].overlap(regions[k]) > _SAME]
        weights = scores[same] / scores[same].sum()
        hips, top = (points[same] * weights[:, None, None]).sum(0)
        found.append(Detection(Region.of_body(hips, top), float(scores[best])))
        left = [k for k in left if k not in same]
    return found


def _distinct(found: list[Detection]) -> list[Detection]:
    distinct: list[Detection] = []
    for one in found:
        if one.region.size > 0 and not any(one.region.same_person(other.region) for other in distinct):
            distinct.append(one)
    return distinct


def _centres(extent: int, part: float) -> Floats:
    """Centres of overlapping parts along an image's side."""
    count = max(1, int(np.ceil(1.5 * (extent - part) / part)) + 1)
    return np.linspace(part / 2, extent - part / 2, count)
