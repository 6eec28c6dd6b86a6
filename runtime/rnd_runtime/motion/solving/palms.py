"""Where a recording has fingers: the axis across a palm, which shows how a hand is twisted."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.motion.readers.tree import MocapTree

from .directions import Floats, unit

_INDEX, _OTHERS, _THUMB = ("index",), ("pinky", "little", "small", "ring"), ("thumb",)
_THUMB_DOWN = np.radians(25)  # of a thumb's base below the palm's axis
_SHORTEST = 0.05  # of a forearm
_KNUCKLES = 0.2  # of a forearm from the wrist, beyond the bones of the palm, which some rigs have


def palm_axes(tree: MocapTree, positions: Floats, matched: Mapping[str, int]) -> dict[str, tuple[Floats, Floats]]:
    """``solve.Tracks.palms`` of the fingers' first joints below each wrist, given ``positions`` [F, J, 3]."""
    axes = {}
    for side in ("left", "right"):
        if not {f"{side}_wrist", f"{side}_elbow"} <= matched.keys():
            continue
        wrist = matched[f"{side}_wrist"]
        way = np.linalg.norm(positions - positions[:, wrist, None], axis=-1)
        forearm, way = way[:, matched[f"{side}_elbow"]], np.median(way, axis=0)
        far = _KNUCKLES * float(np.median(forearm))
        index, other = (_finger(tree, wrist, names, way > far) for names in (_INDEX, _OTHERS))
        thumb = _finger(tree, wrist, _THUMB, way >= 0)
        forward, down = np.array([0.0, 0, 1]), np.array([0.0, -1, 0])
        candidates = []
        if index is not None and other is not None:
            candidates.append((positions[:, index] - positions[:, other], forward))
        if thumb is not None:
            at_rest = np.cos(_THUMB_DOWN) * forward + np.sin(_THUMB_DOWN) * down
            candidates.append((positions[:, thumb] - positions[:, wrist], at_rest))
        for axis, at_rest in candidates:
            if np.median(np.linalg.norm(axis, axis=-1)) > _SHORTEST * np.median(forearm):
                axes[side] = unit(axis), at_rest
                break
    return axes


def _finger(tree: MocapTree, wrist: int, names: tuple[str, ...], far: NDArray[np.bool_]) -> int | None:
    """The first ``far`` [J] joint below ``wrist`` whose name has one of ``names``, else the first of any."""
    below, found = {wrist}, list[int]()
    for joint, parent in enumerate(tree.parents):
        if parent in below:
            below.add(joint)
            if any(name in tree.names[joint].lower() for name in names):
                found.append(joint)
    return next((joint for joint in found if far[joint]), found[0] if found else None)
