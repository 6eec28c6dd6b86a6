"""Left and right through a clip: views of a frame are made to agree, then a path over time is found.

Source: Viterbi 1967.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..observations import BLAZEPOSE
from .landmarks import MIRRORED
from .regions import Floats

LEGS = np.array([k for k, name in enumerate(BLAZEPOSE) if k >= BLAZEPOSE.index("left_hip")])
ARMS = np.array([k for k in range(len(BLAZEPOSE)) if k not in LEGS])
"""face and arms: they are swapped together"""
_STATES = ((False, False), (False, True), (True, False), (True, True))  # whether arms and legs are swapped
_VOTE = 3.0  # cost of a labelling that no view has, against one that all have
_TWIST = 1.0  # cost of arms and legs that disagree with their votes differently
_MOTION = 0.05  # of the person's size a second: motion that costs 1 for a point
_MOST = 4.0  # cost of a point's motion at most: points jump


class Merged(NamedTuple):
    """One skeleton a frame."""

    points: Floats  # [T, 33, 2] pixels
    metres: Floats  # [T, 33, 3]
    confidence: Floats  # [T, 33]
    spread: Floats  # [T, 33] mean distance of the views from their median, pixels


def merge_views(points: Floats, metres: Floats, confidence: Floats, sizes: Floats, seconds: Floats) -> Merged:
    """The skeletons of T frames from V views each.

    Args:
        points: [T, V, 33, 2] pixels.
        metres: [T, V, 33, 3].
        confidence: [T, V, 33].
        sizes: [T] the person's size in pixels.
        seconds: [T] times of the frames.
    """
    count, views = points.shape[:2]
    swapped = np.zeros((count, views, 2), bool)  # of arms, of legs
    for t in range(count):
        for part, members in enumerate((ARMS, LEGS)):
            swapped[t, :, part] = _agreeing(points[t], members)
    path = _path(points, swapped, sizes, seconds)
    merged = Merged(*(np.empty((count, *array.shape[2:])) for array in (points, metres, confidence, confidence)))
    for t in range(count):
        flips = swapped[t] ^ path[t]
        seen = _labelled(points[t], flips)
        merged.points[t] = np.median(seen, axis=0)
        merged.metres[t] = np.median(_labelled(metres[t], flips), axis=0)
        merged.spread[t] = np.linalg.norm(seen - merged.points[t], axis=-1).mean(0)
        share = np.maximum(flips.mean(0), 1 - flips.mean(0))
        merged.confidence[t] = _labelled(confidence[t], flips).mean(0)
        for part, members in enumerate((ARMS, LEGS)):
            merged.confidence[t, members] *= share[part]
    return merged


def _agreeing(points: Floats, members: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which views [V] to swap so that all agree on ``members``; of the two ways, the one with fewer swaps."""
    flips = np.zeros(len(points), bool)
    reference = points[0]
    for _ in range(3):
        apart = [_distance(view, reference, members) for view in points]
        apart_swapped = [_distance(view[MIRRORED], reference, members) for view in points]
        flips = np.array(apart_swapped) < np.array(apart)
        reference = np.median(np.where(flips[:, None, None], points[:, MIRRORED], points), axis=0)
    return ~flips if flips.sum() > len(flips) / 2 else flips


def _distance(a: Floats, b: Floats, members: NDArray[np.int64]) -> float:
    return float(np.linalg.norm(a[members] - b[members], axis=-1).sum())


def _labelled(values: Floats, flips: NDArray[np.bool_]) -> Floats:
    """``values`` [V, 33, …] with the arms and legs of each view swapped as ``flips`` [V, 2] says."""
    result = values.copy()
    for part, members in enumerate((ARMS, LEGS)):
        chosen = np.flatnonzero(flips[:, part])
        result[np.ix_(chosen, members)] = values[np.ix_(chosen, MIRRORED[members])]
    return result


def _path(points: Floats, swapped: NDArray[np.bool_], sizes: Floats, seconds: Floats) -> NDArray[np.bool_]:
    """Whether arms and legs [T, 2] of the agreed views are to be swapped, by the cheapest path."""
    count = len(points)
    skeletons = np.empty((count, len(_STATES), *points.shape[2:]))
    votes = np.empty((count, len(_STATES)))
    for t in range(count):
        against = swapped[t].mean(0)  # share of views that have the other labelling
        for k, state in enumerate(_STATES):
            flips = swapped[t] ^ np.array(state)
            skeletons[t, k] = np.median(_labelled(points[t], flips), axis=0)
            votes[t, k] = _VOTE * sum(1 - 2 * share if flip else 0.0 for flip, share in zip(state, against))
            votes[t, k] += _TWIST * (state[0] != state[1])
    cost, back = votes[0].copy(), np.zeros((count, len(_STATES)), int)
    for t in range(1, count):
        scale = _MOTION * sizes[t] * max(seconds[t] - seconds[t - 1], 1e-3) * 10
        steps = np.linalg.norm(skeletons[t][None] - skeletons[t - 1][:, None], axis=-1) / scale
        total = cost[:, None] + np.minimum(steps, _MOST).mean(-1) * 4
        back[t] = total.argmin(0)
        cost = total.min(0) + votes[t]
    states = np.empty(count, int)
    states[-1] = cost.argmin()
    for t in range(count - 1, 0, -1):
        states[t - 1] = back[t, states[t]]
    return np.array(_STATES)[states]
