"""How the image of the person moves between frames."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.threads import ahead

Image = NDArray[np.uint8]
Masked = tuple[Image, Image]
"""grey levels [H, W] and the person's mask [H, W]"""
Floats32 = NDArray[np.float32]

CELLS = 128
"""cells of the grid over the person, along each side"""
SECONDS = (1 / 15, 2 / 15)
"""times over which flow is measured; in shorter ones its errors are as large as the motion"""
MAX_GAP = 8
"""frames, at most; the fit's equations grow with its square"""
SIDE = 512  # px of the longer side of the images compared
ZOOM = 2.0  # of small people, at most
_MARGIN = 0.04  # of the person's longer side, around it
_GAP = 0.003  # of that side: forwards and back may differ by it,
_GAP_SHARE = 0.05  # and by this share of the way
TEXTURE = 1.5  # least root-mean-square slope along any direction, grey levels a pixel; less is guessed
_WINDOW = 4.0  # px, deviation of the window in which texture is measured
_MAX_ERROR = 1.0  # px, after refinement
LUCAS_KANADE: dict[str, Any] = {
    "winSize": (9, 9),
    "maxLevel": 0,
    "criteria": (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.01),
}


@dataclass(frozen=True, eq=False)
class Flow:
    """Optical flow of a person from each of T frames to the one ``gap`` frames later.

    Attributes:
        boxes: [T − gap, 4] left, top, right, bottom, pixels; the grid of cells covers them.
        displacement: [T − gap, CELLS, CELLS, 2] float16 px, of what is at a cell's centre; NaN where it is unknown.
    """

    gap: int
    boxes: NDArray[np.float64]
    displacement: NDArray[np.float16]

    def at(self, frame: int, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """Displacements [P, 2] px of what ``frame`` shows at ``pixels`` [P, 2]; NaN where unknown."""
        box = self.boxes[frame]
        cells = (pixels - box[:2]) / (box[2:] - box[:2]) * CELLS - 0.5
        moved = cv2.remap(
            self.displacement[frame].astype(np.float32),
            cells.astype(np.float32)[:, None],
            None,
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=(np.nan, np.nan),
        )
        return moved[:, 0].astype(np.float64)


def flow_of(
    frame: Callable[[int], Image],
    masks: Iterable[Image],
    rate: float,
    on_frame: Callable[[int], None] = lambda number: None,
) -> tuple[Flow, ...]:
    """Flows over ``SECONDS`` each, as far as frames are that close.

    Args:
        frame: image [H, W, 3], RGB, of number 0…T − 1.
        masks: of the person, T × [H, W].
        rate: frames a second.
        on_frame: called with how many are done.
    """
    gaps = sorted({min(max(1, round(seconds * rate)), MAX_GAP) for seconds in SECONDS})

    def pairs() -> Iterator[tuple[int, Masked, Masked]]:
        before: deque[Masked] = deque(maxlen=gaps[-1])
        for k, mask in enumerate(masks):
            here = np.asarray(cv2.cvtColor(frame(k), cv2.COLOR_RGB2GRAY), np.uint8), mask
            yield from ((gap, before[-gap], here) for gap in gaps if gap <= len(before))
            before.append(here)
            on_frame(k + 1)

    flows: dict[int, list[tuple[NDArray[np.float64], Floats32]]] = {gap: [] for gap in gaps}
    for gap, flow in ahead(lambda pair: (pair[0], _between(*pair[1:])), pairs()):
        flows[gap].append(flow)
    return tuple(
        Flow(
            gap,
            np.array([box for box, _ in found]).reshape(-1, 4),
            np.array([moved for _, moved in found], np.float16).reshape(-1, CELLS, CELLS, 2),
        )
        for gap, found in flows.items()
    )


def _between(first: Masked, second: Masked) -> tuple[NDArray[np.float64], Floats32]:
    """Box [4] and displacement [CELLS, CELLS, 2] from one (grey image, mask) to another."""
    height, width = first[0].shape
    x, y, wide, high = cv2.boundingRect((np.maximum(first[1], second[1]) > 127).astype(np.uint8))
    if not wide:
        return np.array([0.0, 0, width, height]), np.full((CELLS, CELLS, 2), np.nan, np.float32)
    side = max(wide, high)
    margin = round(_MARGIN * side)
    left, top = max(x - margin, 0), max(y - margin, 0)
    right, bottom = min(x + wide + margin, width), min(y + high + margin, height)
    scale = min(ZOOM, SIDE / max(right - left, bottom - top))
    size = max(1, round((right - left) * scale)), max(1, round((bottom - top) * scale))
    parts = [
        cv2.resize(image[top:bottom, left:right], size, interpolation=cv2.INTER_AREA)
        for pair in (first, second)
        for image in pair
    ]
    grey, mask, next_grey, next_mask = parts
    method = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
    there, back = method.calc(grey, next_grey, None), method.calc(next_grey, grey, None)
    place = np.stack(np.meshgrid(*(np.arange(n, dtype=np.float32) for n in size)), -1)
    allowed = _GAP * side * scale
    gap = np.linalg.norm(there + _moved(back, place + there), axis=-1)
    known = (mask > 127) & (_moved(next_mask, place + there) > 127) & (texture(grey) > TEXTURE / max(scale, 1))
    known &= gap < allowed + _GAP_SHARE * np.linalg.norm(there, axis=-1)
    columns, rows = (np.minimum(((np.arange(CELLS) + 0.5) / CELLS * n).astype(int), n - 1) for n in size)
    cells = np.ix_(rows, columns)
    displacement = np.full((CELLS, CELLS, 2), np.nan, np.float32)
    here = known[cells]
    displacement[here] = _refined(grey, next_grey, place[cells][here], there[cells][here], allowed)
    box = np.array([left, top, right, bottom], np.float64)
    return box, np.asarray(displacement * ((box[2:] - box[:2]) / size), np.float32)


def _refined(first: Image, second: Image, points: Floats32, moved: Floats32, allowed: float) -> Floats32:
    """``moved`` [P, 2] px of ``points`` [P, 2] anew, from a small window alone; NaN where going back ends elsewhere.

    Dense flow is smooth, and so is dragged along by a background that stands still.
    """
    if not len(points):
        return moved
    ends, gap = tracked(first, second, points, points + moved, **LUCAS_KANADE)
    way = ends - points
    good = gap < np.minimum(allowed + _GAP_SHARE * np.linalg.norm(way, axis=1), _MAX_ERROR)
    return np.asarray(np.where(good[:, None], way, np.nan), np.float32)


def tracked(
    first: Image, second: Image, points: Floats32, guess: Floats32, **options: Any
) -> tuple[Floats32, Floats32]:
    """Where ``points`` [P, 2] px of ``first`` are in ``second``, near ``guess``, by Lucas and Kanade 1981.

    Args:
        options: of OpenCV's ``calcOpticalFlowPyrLK``.

    Returns:
        The points there; how far from their start they end if followed back, px, infinite where they are lost.
    """
    options["flags"] = cv2.OPTFLOW_USE_INITIAL_FLOW
    start = points[:, None]
    there, found, _ = cv2.calcOpticalFlowPyrLK(first, second, start, guess[:, None].copy(), **options)
    back, returned, _ = cv2.calcOpticalFlowPyrLK(second, first, there, start.copy(), **options)
    gap = np.linalg.norm(back - start, axis=-1)
    gap[(found == 0) | (returned == 0)] = np.inf
    return there[:, 0], gap[:, 0]


def _moved(image: NDArray[Any], place: Floats32) -> NDArray[Any]:
    """``image`` at ``place`` [h, w, 2] px; far values outside."""
    border = (1e3, 1e3) if image.ndim == 3 else (0,)
    return cv2.remap(image, place, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=border)


def texture(grey: Image) -> Floats32:
    """Root of the structure tensor's smaller eigenvalue, grey levels a pixel."""
    x, y = (cv2.Sobel(grey, cv2.CV_32F, *order) / 8 for order in ((1, 0), (0, 1)))
    xx, xy, yy = (cv2.GaussianBlur(product, (0, 0), _WINDOW) for product in (x * x, x * y, y * y))
    mean, half = (xx + yy) / 2, (xx - yy) / 2
    return np.asarray(np.sqrt(np.maximum(mean - np.hypot(half, xy), 0)))
