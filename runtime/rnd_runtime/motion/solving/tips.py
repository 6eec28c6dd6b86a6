"""Where heads, hands and feet end: BVH's end sites, and joints below the last that is known.

Some programs write an end site that says nothing: along the bone's own Y, whatever that is. One counts only where a
person's may be, and not where all are along an axis that bones are not along.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from rnd_runtime.motion.readers.tree import MocapTree

from .directions import Floats, unit

_NEXT = {"ankle": "foot", "wrist": "hand", "neck": "head"}
# Joint above, and angles between its bone and the way to the tip: of necks, forearms, and shins, which feet stand off
_BEFORE = {"neck": ("spine3", "spine2", "spine1"), "wrist": ("*_elbow",), "ankle": ("*_knee",)}
_ANGLES = {"neck": (0.0, 60.0), "wrist": (0.0, 60.0), "ankle": (40.0, 140.0)}
_SHORTEST = 0.03  # of a leg
_SEVERAL, _ALONG = 3, np.cos(np.radians(5))


def find_tips(tree: MocapTree, positions: Floats, rotations: Floats, matched: Mapping[str, int]) -> dict[str, Floats]:
    """Positions [F, 3] of tips by our joint above each, given joints' ``positions`` [F, J, 3] and ``rotations``.

    A joint without ``matched`` ones below has one where it has an end site, or a single joint below.
    """
    above = set[int]()
    for joint in matched.values():
        while (joint := tree.parents[joint]) >= 0:
            above.add(joint)
    found, ends = {}, {} if _one_axis(tree) else tree.ends
    for name, joint in matched.items():
        if joint in above:
            continue
        below = [child for child, parent in enumerate(tree.parents) if parent == joint]
        offset = ends.get(joint) if not below else tree.offsets[below[0]] if len(below) == 1 else None
        if offset is not None:
            found[name] = positions[:, joint] + rotations[:, joint] @ offset
    return found


def _one_axis(tree: MocapTree) -> bool:
    """Whether all of several end sites are along one axis, and most bones of ``tree`` are not."""
    ends = [unit(end) for end in tree.ends.values() if np.any(end)]
    if len(ends) < _SEVERAL or min(float(end @ ends[0]) for end in ends) < _ALONG:
        return False
    bones = unit(tree.offsets[np.any(tree.offsets, axis=-1)])
    return bool(np.median(bones @ ends[0]) < _ALONG)


def with_tips(points: Mapping[str, Floats], tips: Mapping[str, Floats]) -> dict[str, Floats]:
    """``points`` [F, 3] by joint; where feet, hands or a head are missing, the tip at their place stands in."""
    joints = dict(points)
    for name, tip in tips.items():
        side, _, part = name.rpartition("_")
        missing = f"{side}_{_NEXT[part]}" if side and part in _NEXT else _NEXT.get(name, "")
        if not missing or missing in points:
            continue
        before = (above.replace("*", side) for above in _BEFORE[part])
        start = next((points[above] for above in before if above in points), None)
        if start is None:
            continue
        cosine = float(np.median((unit(points[name] - start) * unit(tip - points[name])).sum(-1)))
        low, high = _ANGLES[part]
        if low <= np.degrees(np.arccos(np.clip(cosine, -1, 1))) <= high:
            joints[missing] = tip
    return joints


def tip_at_rest(name: str, rest: Mapping[str, Floats]) -> Floats | None:
    """Direction [3] from the joint ``name`` to its tip at ``rest``: heads upwards, toes level, hands on; else None."""
    side, _, part = name.partition("_")
    if name == "head":
        return np.array([0.0, 1, 0])
    before = {"foot": f"{side}_ankle", "hand": f"{side}_wrist", "wrist": f"{side}_elbow"}.get(part)
    if before is None or before not in rest:
        return None
    return unit((rest[name] - rest[before]) * ([1, 0, 1] if part == "foot" else [1, 1, 1]))


def long_enough(way: Floats, leg: float) -> bool:
    """Whether ``way`` [F, 3] to a tip has a direction."""
    return bool(np.median(np.linalg.norm(way, axis=-1)) > _SHORTEST * leg)
