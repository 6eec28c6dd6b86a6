"""Views of the frames of a clip made one skeleton: left and right, then each limb, by the cheapest path over time.

Source: Viterbi 1967.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rnd_trainer.estimating.observations import BLAZEPOSE

from .landmarks import MIRRORED
from .regions import Floats

LEGS = np.array([k for k, name in enumerate(BLAZEPOSE) if k >= BLAZEPOSE.index("left_hip")])
ARMS = np.array([k for k in range(len(BLAZEPOSE)) if k not in LEGS])
"""face and arms: they are swapped together"""
_STATES = ((False, False), (False, True), (True, False), (True, True))  # whether arms and legs are swapped
_VOTE = 3.0  # cost of a labelling that no view has, against one that all have
_TWIST = 1.0  # cost of arms and legs that disagree with their votes differently
_APART = 0.05  # of the person's size: a distance or a frame's motion that costs 1
_RATE = 15.0  # frames per second below which a frame's motion may be larger
_MOST = 4.0  # cost of a point's motion at most: points jump
_OUTSIDE = 0.02  # of the person's size: distance outside of the mask that costs 1
_LIMB_OUTSIDE, _LIMB_ALONE, _LIMB_MOTION = 2.0, 1.0, 0.5


def _points(*names: str) -> NDArray[np.int64]:
    return np.array([BLAZEPOSE.index(name) for name in names])


LIMBS = tuple(
    _points(*(f"{side}_{name}" for name in names))
    for side in ("left", "right")
    for names in (("elbow", "wrist", "pinky", "index", "thumb"), ("knee", "ankle", "heel", "foot_index"))
)
"""points that are taken from the same views"""


class Merged(NamedTuple):
    """One skeleton a frame."""

    points: Floats  # [T, 33, 2] pixels
    metres: Floats  # [T, 33, 3]
    confidence: Floats  # [T, 33]
    spread: Floats  # [T, 33] mean distance of the views from their median, pixels


def merge_views(
    points: Floats, metres: Floats, confidence: Floats, outside: Floats, sizes: Floats, seconds: Floats
) -> Merged:
    """The skeletons of T frames from V views each.

    Args:
        points: [T, V, 33, 2] pixels.
        metres: [T, V, 33, 3].
        confidence: [T, V, 33].
        outside: [T, V, 33] distances of the points outside of the person's mask, pixels.
        sizes: [T] the person's size in pixels.
        seconds: [T] times of the frames.
    """
    count, views = points.shape[:2]
    swapped = np.zeros((count, views, 2), bool)  # of arms, of legs
    for t in range(count):
        for part, members in enumerate((ARMS, LEGS)):
            swapped[t, :, part] = _agreeing(points[t], members)
    flips = swapped ^ _path(points, swapped, sizes, seconds)[:, None]
    seen, deep, sure, out = (
        np.stack([_labelled(array[t], flips[t]) for t in range(count)])
        for array in (points, metres, confidence, outside)
    )
    share = np.maximum(flips.mean(1), 1 - flips.mean(1))  # [T, 2] of the views that agree on a labelling
    agreed = np.where(np.isin(np.arange(points.shape[2]), LEGS), share[:, 1:], share[:, :1])
    middle = np.median(seen, axis=1)
    spread = np.linalg.norm(seen - middle[:, None], axis=-1).mean(1)
    merged = Merged(middle, np.median(deep, axis=1), sure.mean(1) * agreed, spread)
    for limb in LIMBS:
        near = _limb(seen[:, :, limb], sure[:, :, limb], out[:, :, limb], sizes, seconds)
        weight = near / near.sum(1, keepdims=True)
        merged.points[:, limb] = np.einsum("tv,tvjk->tjk", weight, seen[:, :, limb])
        merged.metres[:, limb] = np.einsum("tv,tvjk->tjk", weight, deep[:, :, limb])
        lost = np.exp(-np.einsum("tv,tvj->tj", weight, out[:, :, limb]) / (_OUTSIDE * sizes[:, None]))
        believed = np.einsum("tv,tvj->tj", weight, sure[:, :, limb]) * near.mean(1)[:, None]
        merged.confidence[:, limb] = believed * lost * agreed[:, limb]
    return merged


def _limb(points: Floats, confidence: Floats, outside: Floats, sizes: Floats, seconds: Floats) -> Floats:
    """Which views [T, V] (0 or 1) of a limb agree with the one on the cheapest path over time."""
    apart = np.linalg.norm(points[:, :, None] - points[:, None], axis=-1) / sizes[:, None, None, None]  # [T, V, V, J]
    costs = _LIMB_OUTSIDE * np.minimum(outside / (_OUTSIDE * sizes[:, None, None]), 2).mean(-1)
    costs += (1 - confidence).mean(-1) + _LIMB_ALONE * np.minimum(apart / _APART, 2).mean((2, 3))
    steps = np.linalg.norm(points[1:, None] - points[:-1, :, None], axis=-1)  # [T - 1, V before, V after, J]
    scale = _APART * sizes[1:] * np.maximum(_RATE * np.diff(seconds), 1)
    motion = _LIMB_MOTION * np.minimum(steps / scale[:, None, None, None], _MOST).mean(-1)
    chosen = cheapest_path(costs, motion)
    near = apart[np.arange(len(points)), chosen].mean(-1) < _APART
    near[np.arange(len(points)), chosen] = True
    return near.astype(np.float64)


def cheapest_path(costs: Floats, steps: Floats) -> NDArray[np.int64]:
    """The states [T] of least total cost; ``costs`` [T, S] of states, ``steps`` [T - 1, S, S] from one to the next."""
    total, back = costs[0].copy(), np.zeros(costs.shape, np.int64)
    for t in range(1, len(costs)):
        through = total[:, None] + steps[t - 1]
        back[t] = through.argmin(0)
        total = through.min(0) + costs[t]
    path = np.empty(len(costs), np.int64)
    path[-1] = total.argmin()
    for t in range(len(costs) - 1, 0, -1):
        path[t - 1] = back[t, path[t]]
    return path


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
    steps = np.linalg.norm(skeletons[1:, None] - skeletons[:-1, :, None], axis=-1)  # [T - 1, 4 before, 4 after, 33]
    scale = _APART * sizes[1:] * np.maximum(_RATE * np.diff(seconds), 1)
    motion = 4 * np.minimum(steps / scale[:, None, None, None], _MOST).mean(-1)
    return np.array(_STATES)[cheapest_path(votes, motion)]
