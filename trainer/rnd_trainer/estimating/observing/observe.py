"""What is seen of one person in a video, from its frames to ``Observations``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import count
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.threads import ahead
from rnd_trainer.estimating.flow import flow_of
from rnd_trainer.estimating.observations import GreyImages, Observations, only_person
from rnd_trainer.estimating.opencv_threads import opencv_on_one_thread
from rnd_trainer.importing.surfaces.masks import dilated

from .detection import Detector
from .hands import HandNetwork, Hands
from .landmarks import LandmarkNetwork, Views
from .masks import refine_masks
from .networks import open_network
from .regions import Floats, Image, Region
from .sides import Merged, merge_views
from .tracking import Frames, Start, find_person, follow, next_other

OnProgress = Callable[[str, int, int], None]
"""called with (phase, done, total)"""

MIN_FRAMES = 20
_WIDER = 1.12  # of the region, in the views without a background
_NEAR, _CLEARANCE = 0.5, 0.01  # of the height: how far others matter, and how far their masks are off
_AROUND = 0.02  # of the person's size: margin of the mask when the background is taken away


class Clip(Frames, Protocol):
    """Frames of a video with their size and rate."""

    @property
    def fps(self) -> float: ...
    @property
    def width(self) -> int: ...
    @property
    def height(self) -> int: ...


@dataclass(frozen=True, eq=False)
class Networks:
    """The networks that see a person."""

    detector: Detector
    landmarks: LandmarkNetwork
    hands: HandNetwork

    @classmethod
    def open(cls) -> Networks:
        """The networks in the user's cache; raises ``InputError`` with the command that fetches missing ones.

        Each runs on one thread: several frames at a time are faster than several threads a frame (38 to 58 ms).
        """
        names = "person_detector", "pose_landmarks", "hand_landmarks"
        detector, landmarks, hands = (open_network(name, threads=1) for name in names)
        return cls(Detector(detector), LandmarkNetwork(landmarks), HandNetwork(hands))


@opencv_on_one_thread()
def observe(
    video: Clip,
    networks: Networks,
    *,
    numbers: Sequence[int] | None = None,
    person: int | None = None,
    on_progress: OnProgress = lambda phase, done, total: None,
) -> Observations:
    """Observe one person in the frames ``numbers`` of ``video``, by default all.

    Args:
        person: which of several people, counted from the left.

    Raises:
        InputError: nobody or several people, or too few frames with the person.
    """
    numbers = list(video.numbers if numbers is None else numbers)
    start = find_person(video, numbers, networks.detector, networks.landmarks, person)
    frames: list[int] = []
    first: list[Views] = []
    soft = GreyImages([], (video.width, video.height))
    for done, (number, views) in enumerate(follow(video, numbers, start, networks.detector, networks.landmarks)):
        if views is not None:
            frames.append(number)
            soft.append(_bytes(views.mask))
            first.append(views.without_mask())
        on_progress("landmarks", done + 1, len(numbers))
    if len(frames) < MIN_FRAMES:
        raise InputError("frames with the person in view", expected=f"at least {MIN_FRAMES}", got=len(frames))
    regions = {number: views.region for number, views in zip(frames, first)}
    others = _others(video, numbers, start, regions, networks, on_progress)
    masks, person_alone, hidden = (GreyImages([], soft.image_size) for _ in range(3))
    second, outside = [], []

    def look_again(k: int, pair: tuple[Image, Image]) -> tuple[Image, Image, Image, Views]:
        image, mask = pair
        mask, behind = _apart(mask, soft[k], [other[k] for other in others])
        alone = _alone(image, np.maximum(mask, behind), first[k].region.size)
        again = networks.landmarks.look_twice(alone, first[k].region.scaled(_WIDER), with_mask=False)
        return mask, behind, only_person(image, mask), again

    refined = refine_masks(lambda k: video.frame(frames[k]), soft, lambda k, n: on_progress("masks", k, n))
    for k, (mask, behind, grey, views) in enumerate(ahead(look_again, count(), refined)):
        masks.append(mask)
        hidden.append(behind)
        person_alone.append(grey)
        second.append(views)
        outside.append(_outside(np.maximum(mask, behind), np.concatenate([first[k].points, views.points])))
    merged = _merged(first, second, np.stack(outside), np.array(frames) / video.fps)
    hands = _hands(video, frames, merged, networks.hands, on_progress)
    rate = video.fps / float(np.median(np.diff(frames)))
    flow = flow_of(lambda k: video.frame(frames[k]), masks, rate, lambda k: on_progress("motion", k, len(frames)))
    return Observations(
        fps=video.fps,
        image_size=(video.width, video.height),
        frames=np.array(frames),
        keypoints_px=merged.points.astype(np.float32),
        confidence=merged.confidence.astype(np.float32),
        spread_px=merged.spread.astype(np.float32),
        keypoints_m=merged.metres.astype(np.float32),
        hands_px=np.stack([hand.points for hand in hands]),
        hands_confidence=np.stack([hand.confidence for hand in hands]),
        masks=masks,
        flow=flow,
        person=person_alone,
        hidden=hidden if others else None,
    )


def _others(
    video: Clip,
    numbers: list[int],
    start: Start,
    regions: dict[int, Region],
    networks: Networks,
    on_progress: OnProgress,
) -> list[GreyImages]:
    """Masks of each who may hide the person, in the frames of ``regions``, the person's; black where they are one."""
    others, tracks = [], [regions]
    while other := next_other(start, tracks):
        masks, track = GreyImages([], (video.width, video.height)), {}
        for done, (number, views) in enumerate(follow(video, numbers, other, networks.detector, networks.landmarks)):
            on_progress("other people", done + 1, len(numbers))
            if number not in regions:
                continue
            mask = np.zeros(masks.shape[1:], np.uint8)
            if views is not None and not views.region.same_person(regions[number]):
                mask, track[number] = _bytes(views.mask), views.region
            masks.append(mask)
        others.append(masks)
        tracks.append({**track, other.frame: other.region})
    return others


def _bytes(mask: NDArray[np.float32]) -> Image:
    return np.round(255 * mask).astype(np.uint8)


def _apart(mask: Image, soft: Image, others: list[Image]) -> tuple[Image, Image]:
    """``mask`` without ``others``, and where near it they may hide the person, 255; ``soft`` is the network's mask.

    What is in both networks' masks is the person's: limbs in front stay whole.
    """
    if not others:
        return mask, np.zeros_like(mask)
    theirs = (np.maximum.reduce(others) > 127) & (soft <= 127)
    mask = np.where(theirs, np.uint8(0), mask)
    near = dilated(mask > 127, _NEAR) & dilated(theirs, _CLEARANCE) & (mask == 0)
    return mask, np.where(near, np.uint8(255), np.uint8(0))


def _merged(first: list[Views], second: list[Views], outside: Floats, seconds: Floats) -> Merged:
    points, metres, confidence = (
        np.stack([np.concatenate([getattr(a, name), getattr(b, name)]) for a, b in zip(first, second)])
        for name in ("points", "metres", "confidence")
    )
    sizes = np.array([views.region.size for views in first])
    return merge_views(points, metres, confidence, outside, sizes, seconds)


def _hands(
    video: Clip, frames: list[int], merged: Merged, network: HandNetwork, on_progress: OnProgress
) -> list[Hands]:
    hands = []
    for one in ahead(network, map(video.frame, frames), merged.points, merged.confidence):
        hands.append(one)
        on_progress("hands", len(hands), len(frames))
    return hands


def _alone(image: Image, mask: Image, size: float) -> Image:
    """``image`` with its mean colour in place of the background, so that nothing there looks like a limb."""
    reach = 2 * max(1, round(_AROUND * size)) + 1
    plain = np.array(cv2.mean(image)[:3], np.float32)
    alone = np.empty_like(image)
    alone[0] = plain
    alone[1:] = alone[0]  # bytes: many times as fast as floats everywhere
    left, top, width, height = cv2.boundingRect(mask)
    rows, columns = (slice(max(a - reach, 0), a + n + reach) for a, n in ((top, height), (left, width)))
    grown = cv2.dilate(mask[rows, columns], cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach, reach)))
    share = cv2.blur(grown, (reach, reach))[..., None] / np.float32(255)
    alone[rows, columns] = image[rows, columns] * share + plain * (1 - share)
    return alone


def _outside(mask: Image, points: Floats) -> NDArray[np.float64]:
    """Distances [V, 33] of ``points`` from the person, pixels; 0 inside."""
    person = (mask > 127).astype(np.uint8)
    if not person.any():
        return np.zeros(points.shape[:2])
    height, width = mask.shape
    columns = np.clip(points[..., 0].astype(int), 0, width - 1)
    rows = np.clip(points[..., 1].astype(int), 0, height - 1)
    beyond = np.hypot(points[..., 0] - columns, points[..., 1] - rows)
    x, y, wide, high = cv2.boundingRect(person)
    left, top = min(x, int(columns.min())), min(y, int(rows.min()))
    right, bottom = max(x + wide, int(columns.max()) + 1), max(y + high, int(rows.max()) + 1)
    columns, rows = columns - left, rows - top
    distance = cv2.distanceTransform(1 - person[top:bottom, left:right], cv2.DIST_L2, 5)
    return np.asarray(distance[rows, columns] + np.maximum(beyond - 1.5, 0), np.float64)
