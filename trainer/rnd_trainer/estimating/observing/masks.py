"""Soft masks of the person: the network's, sharpened by the background of a static camera and by the image's edges.

Source: He et al. 2013, Guided image filtering; Qian and Sezan 1992, Video background replacement (known background).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import repeat
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.arrays import spaced_indices
from rnd_runtime.core.threads import ahead
from rnd_trainer.importing.surfaces.masks import (
    Floats32,
    bounding_box,
    colour_around,
    dilated,
    large_parts,
    mask_height,
    share_of_person,
)

from .regions import Image

MAX_SIDE = 800
"""pixels of the person's height at which masks are made; larger ones are enlarged from it"""
_CLEARANCES = (0.04, 0.006)  # of the person's height around the mask, hidden in each round of the background
_FRAMES, _MAX_BYTES = 40, 600 << 20
_MIN_SEEN = 3  # frames that show a pixel of the background
_MIN_NOISE, _MAX_NOISE = 3.5, 12.0  # 8-bit steps of a static camera; beside a person codecs err by more
_EDGE_NOISE = 0.35  # of a step to the neighbour: codecs and sway move edges
_DIFFERENCE = 5.0  # half squared deviations from which a pixel is rather the person's
_EVIDENCE = (-4.0, 8.0)  # log odds that a pixel's difference from the background can give
_SHADOW = 0.15  # what remains of the evidence where the difference is a shadow's
_TRUST = 0.5  # of the network's log odds beside the background's
_FAR = (0.02, 0.05)  # of the height: distances from the network's mask at which the person becomes unlikely
_RADIUS, _REGULARITY = 1, 1e-3  # of the guided filter, pixels and variance
_BLIND_RADIUS, _BLIND_REGULARITY = 3, 1e-4  # without a background
_COLOUR_REACH = 2.5  # pixels over which the person's colour is taken to the outline
_MIN_CONTRAST = 8.0  # deviations between person and background from which their mixture is measured


@dataclass(frozen=True, eq=False)
class Background:
    """A static camera's background: colour [H, W, 3], where it was seen, its deviation [H, W] in 8-bit steps."""

    colour: Floats32
    seen: NDArray[np.bool_]
    noise: Floats32


class Soft(Protocol):
    """Masks by index."""

    def __len__(self) -> int: ...
    def __iter__(self) -> Iterator[Image]: ...
    def __getitem__(self, index: int, /) -> Image: ...


def refine_masks(
    frame: Callable[[int], Image], soft: Soft, on_progress: Callable[[int, int], None] = lambda done, total: None
) -> Iterator[tuple[Image, Image]]:
    """Yield each of the images that ``frame`` gives by index, and its mask [H, W] uint8; ``soft`` are a network's.

    Frames whose mask is empty stay empty.
    """
    heights = [mask_height(mask > 127) for mask in soft if (mask > 127).any()]
    scale = min(1.0, MAX_SIDE / max(heights, default=1))
    background = _learn_background(frame, soft, scale)

    def refined(image: Image, mask: Image) -> tuple[Image, Image]:
        small = _matte(_resized(image, scale), _resized(mask, scale), background)
        return image, small if scale == 1 else _resized(small, (mask.shape[1], mask.shape[0]))

    for done, pair in enumerate(ahead(refined, map(frame, range(len(soft))), soft)):
        yield pair
        on_progress(done + 1, len(soft))


def _learn_background(frame: Callable[[int], Image], soft: Soft, scale: float) -> Background | None:
    """The background, or None of a moving camera; in rounds, the later ones with the person's own outline."""
    if len(soft) < _MIN_SEEN:
        return None
    first = _resized(frame(0), scale)
    count = int(np.clip(_MAX_BYTES // (first.size + 1), _MIN_SEEN, min(_FRAMES, len(soft))))
    chosen = spaced_indices(len(soft), count)
    images = np.stack(list(ahead(partial(_resized, to=scale), (frame(int(k)) for k in chosen))))
    network = [_resized(soft[int(k)], scale) for k in chosen]
    masks, background = [mask > 76 for mask in network], None
    colour, noise = np.zeros(images.shape[1:], np.float32), np.zeros(images.shape[1:3], np.float32)
    before = np.ones(images.shape[:3], np.bool_)
    for clearance in _CLEARANCES:
        if background is not None:
            masks = [mask > 127 for mask in ahead(_matte, images, network, repeat(background))]
        hidden = np.stack(list(ahead(partial(dilated, share=clearance), masks)))
        _learn(images, hidden, (hidden != before).any(0), colour, noise)
        before = hidden
        background = _background(colour, noise, (~hidden).sum(0) >= _MIN_SEEN)
        if background is None:
            return None
    return background


def _learn(
    images: NDArray[np.uint8], hidden: NDArray[np.bool_], where: NDArray[np.bool_], colour: Floats32, noise: Floats32
) -> None:
    """Put the median and the deviation over the frames in which a pixel is not hidden into ``colour`` and ``noise``."""
    shows = (~hidden).sum(0)
    colour[where] = 0
    where = where & (shows >= _MIN_SEEN)

    def learn(row: int) -> None:
        columns = where[row]
        count = shows[row, columns, None]
        shown = np.where(hidden[:, row, columns, None], np.float32(np.inf), images[:, row, columns])
        shown = np.ascontiguousarray(np.moveaxis(shown, 0, -1))
        colour[row, columns] = middle = _middle(shown, count)
        noise[row, columns] = 1.48 * _middle(np.abs(shown - middle[..., None]), count).max(-1)

    deque(ahead(learn, np.flatnonzero(where.any(1)).tolist()), maxlen=0)


def _background(colour: Floats32, noise: Floats32, seen: NDArray[np.bool_]) -> Background | None:
    """What was seen of a background, or None where it moves."""
    if not seen.any():
        return None
    usual = float(np.median(noise[seen]))
    if usual > _MAX_NOISE:
        return None
    smooth = cv2.blur(np.where(seen, noise, np.float32(usual)), (5, 5))
    return Background(colour, seen, np.maximum(smooth, max(usual, _MIN_NOISE)).astype(np.float32))


def _middle(values: Floats32, count: NDArray[np.int64]) -> Floats32:
    """Medians [N, C] of the ``count`` [N, 1] finite ones of ``values`` [N, C, F]; ``np.nanmedian`` is far slower."""
    ranked = np.sort(values, axis=-1)
    low, high = (np.take_along_axis(ranked, k[..., None], -1)[..., 0] for k in ((count - 1) // 2, count // 2))
    return np.asarray((low + high) / 2, np.float32)


def _matte(image: Image, soft: Image, background: Background | None) -> Image:
    """The mask [H, W] of one image; ``soft`` is the network's."""
    result = np.zeros_like(soft)
    inside = soft > 127
    if not inside.any():
        return result
    window = bounding_box(inside, 2 * _FAR[1])
    pixels, likely = image[window].astype(np.float32), np.asarray(soft[window] / 255, np.float32)
    near = None
    if background is not None:
        near = Background(background.colour[window], background.seen[window], background.noise[window])
    odds = _network_odds(likely, mask_height(inside), 1.0 if near is None else _TRUST)
    radius, regularity = _BLIND_RADIUS, _BLIND_REGULARITY
    if near is not None:
        odds += _difference_odds(pixels, near)
        radius, regularity = _RADIUS, _REGULARITY
    person = (1 / (1 + np.exp(-odds))).astype(np.float32)
    filtered = cv2.ximgproc.guidedFilter(pixels / 255, person, radius, regularity)
    alpha = np.clip((filtered - 0.15) / 0.7, 0, 1).astype(np.float32)  # the filter blurs both sides of the edge
    if near is not None:
        alpha = _mixed(alpha, pixels, near)
    parts = large_parts(alpha > 0.5)
    alpha = np.where(dilated(parts, 0.005), alpha, 0)
    result[window] = np.round(255 * alpha)
    return result


def _network_odds(likely: Floats32, height: int, trust: float) -> Floats32:
    odds = trust * np.clip(np.log((likely + 0.01) / (1.01 - likely)), -4, 4)
    outside = cv2.distanceTransform((likely < 0.5).astype(np.uint8), cv2.DIST_L2, 5) / height
    near, far = _FAR
    return np.asarray(odds - 8 * np.clip((outside - near) / (far - near), 0, 1), np.float32)


def _deviation(background: Background) -> Floats32:
    grey = cv2.transform(background.colour, np.full((1, 3), 1 / 3))
    across, down = cv2.Sobel(grey, cv2.CV_32F, 1, 0, scale=0.125), cv2.Sobel(grey, cv2.CV_32F, 0, 1, scale=0.125)
    return np.sqrt(background.noise**2 + _EDGE_NOISE**2 * (across**2 + down**2))


def _difference_odds(pixels: Floats32, background: Background) -> Floats32:
    """Log odds of the person by the difference from the background; little where it is a shadow's."""
    blurred = cv2.GaussianBlur(pixels - background.colour, (0, 0), 0.6)
    squared = np.vecdot(blurred, blurred) / _deviation(background) ** 2
    odds = np.clip(0.5 * squared - _DIFFERENCE, *_EVIDENCE)
    red, green, blue = cv2.split((pixels + 1) / (background.colour + 1))
    most, least = cv2.max(cv2.max(red, green), blue), cv2.min(cv2.min(red, green), blue)
    shadow = (most < 1.05) & (least > 0.5) & (most - least < 0.1)
    odds[shadow & (odds > 0)] *= _SHADOW
    odds[~background.seen] = 0
    return odds


def _mixed(alpha: Floats32, pixels: Floats32, background: Background) -> Floats32:
    """``alpha`` with the outline's pixels measured as mixtures of the person's colour nearby and the background's."""
    sure = cv2.erode((alpha > 0.95).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    person, weight = colour_around(pixels, sure, _COLOUR_REACH)
    edge = cv2.dilate((np.abs(alpha - 0.5) < 0.45).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    edge &= background.seen & (weight > 0.02)
    person, behind = person[edge], background.colour[edge]
    across = person - behind
    contrast = np.vecdot(across, across)
    share = np.clip(share_of_person(pixels[edge], person, behind), 0, 1)
    trust = contrast / (contrast + (_MIN_CONTRAST * _deviation(background)[edge]) ** 2)
    mixed = alpha.copy()
    mixed[edge] = (1 - trust) * alpha[edge] + trust * share
    return mixed


def _resized(pixels: Image, to: float | tuple[int, int]) -> Image:
    if isinstance(to, tuple):
        return cv2.resize(pixels, to, interpolation=cv2.INTER_LINEAR)
    if to == 1:
        return pixels
    return cv2.resize(pixels, None, fx=to, fy=to, interpolation=cv2.INTER_AREA)
