"""21 points of each hand by MediaPipe's hand network, in regions that the body's points give.

Source: Zhang et al. 2020, MediaPipe Hands.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.avatar.inference import run_session
from rnd_trainer.estimating.observations import BLAZEPOSE, HAND_POINTS

from .regions import Floats, Image, Region, Shrunk, moved

SIDE = 224  # pixels of the network's input
MIN_PIXELS = 24.0
"""side of a hand's region in the image below which nothing is seen"""
MIN_SCORE = 0.5
_FROM_BODY = 4.4  # side of the first region in distances from the wrist to the knuckles
_FROM_ARM = 0.35  # least such distance in lengths of the forearm: hands that point at the camera
_FROM_HAND = 2.0  # side of the second region in the extent of the points
_FAR = 0.5  # of the region's side: a wrist so far from the body's is another hand's
_WRIST, _INDEX, _MIDDLE, _RING = 0, 5, 9, 13  # of the 21: the wrist and the bases of fingers


class Hands(NamedTuple):
    """Left and right hand of one frame."""

    points: NDArray[np.float32]  # [2, 21, 2] pixels, NaN where not seen
    confidence: NDArray[np.float32]  # [2] 0…1


class HandNetwork:
    """Points of the hands: ``session`` is the network ``hand_landmarks``."""

    def __init__(self, session: Any) -> None:
        self._session = session

    def __call__(self, image: Image, body: Floats, confidence: Floats) -> Hands:
        """Both hands of the person whose ``body`` [33, 2] and ``confidence`` [33] are known."""
        hands = Hands(np.full((2, HAND_POINTS, 2), np.nan, np.float32), np.zeros(2, np.float32))
        for k, side in enumerate(("left", "right")):
            elbow, wrist, index, pinky = (BLAZEPOSE.index(f"{side}_{n}") for n in ("elbow", "wrist", "index", "pinky"))
            if confidence[[wrist, index, pinky]].min() < MIN_SCORE / 2:
                continue
            region = _from_body(body[elbow], body[wrist], (body[index] + body[pinky]) / 2)
            for _ in range(2):
                height, width = image.shape[:2]
                inside = 0 <= region.x < width and 0 <= region.y < height
                if not (inside and MIN_PIXELS <= region.size <= 2 * max(width, height)):
                    break
                points, score = self._look(image, region)
                if score < MIN_SCORE / 2:
                    break
                apart = np.linalg.norm(points[_WRIST] - body[wrist])
                if score >= MIN_SCORE and apart < _FAR * region.size:
                    hands.points[k], hands.confidence[k] = points, score
                region = _from_hand(points)
        return hands

    def _look(self, image: Image, region: Region) -> tuple[Floats, float]:
        """Points [21, 2] in pixels, and how likely there is a hand."""
        pixels = Shrunk(image, region.size, SIDE).crop(region, SIDE)
        outputs = run_session(self._session, None, {"image": pixels[None]})
        points = outputs[0].reshape(HAND_POINTS, 3)[:, :2].astype(np.float64)
        return moved(points, region.to_image(SIDE)), float(outputs[1].reshape(-1)[0])


def _from_body(elbow: Floats, wrist: Floats, knuckles: Floats) -> Region:
    along = knuckles - wrist
    length = max(float(np.linalg.norm(along)), _FROM_ARM * float(np.linalg.norm(wrist - elbow)))
    x, y = wrist + along
    return Region(float(x), float(y), _FROM_BODY * length, float(np.arctan2(along[0], -along[1])))


def _from_hand(points: Floats) -> Region:
    along = 0.5 * points[_MIDDLE] + 0.25 * (points[_INDEX] + points[_RING]) - points[_WRIST]
    rotation = float(np.arctan2(along[0], -along[1]))
    cosine, sine = np.cos(rotation), np.sin(rotation)
    turned = points @ np.array([[cosine, -sine], [sine, cosine]])
    low, high = turned.min(0), turned.max(0)
    centre = np.array([[cosine, -sine], [sine, cosine]]) @ ((low + high) / 2)
    return Region(float(centre[0]), float(centre[1]), _FROM_HAND * float((high - low).max()), rotation)
