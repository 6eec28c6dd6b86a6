"""What a skeleton's tree and lengths say about the names of its joints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_SIDES = ("left", "right")
_SPINE = ("spine1", "spine2", "spine3")
_CHAINS = (
    (*_SPINE, "neck", "head"),
    *((f"{side}_hip", f"{side}_knee", f"{side}_ankle", f"{side}_foot") for side in _SIDES),
    *((f"{side}_shoulder", f"{side}_elbow", f"{side}_wrist", f"{side}_hand") for side in _SIDES),
    *((f"{side}_collar", f"{side}_shoulder") for side in _SIDES),
)
# Bones by their first joint, and the range of the first's length over the second's
_RATIOS = ((("hip", "knee"), 0.5, 2.0), (("shoulder", "elbow"), 0.5, 2.0), (("ankle", "knee"), 0.05, 0.7))
_AHEAD = {"hip": "knee", "knee": "ankle", "ankle": "foot", "shoulder": "elbow", "elbow": "wrist"}


@dataclass(frozen=True, eq=False)
class Bones:
    """``parents`` [J], −1 for the root, parents first, and bone vectors ``offsets`` [J, 3] from them."""

    parents: Sequence[int]
    offsets: Floats

    def contradictions(self, found: Mapping[str, int]) -> int:
        """Number of bones of ``found``, indices by SMPL's names, that the tree lacks or that are of unlikely length."""
        wrong = 0
        for chain in _CHAINS:
            present = [found[joint] for joint in chain if joint in found]
            wrong += sum(self._length(a, b) is None for a, b in pairwise(present))
            wrong += bool(present) and chain[0].endswith(("_hip", "_shoulder")) and chain[0] not in found
        for side in _SIDES:
            for bones, low, high in _RATIOS:
                joints = [(f"{side}_{bone}", f"{side}_{_AHEAD[bone]}") for bone in bones]
                if not all(joint in found for pair in joints for joint in pair):
                    continue
                first, second = (self._length(found[a], found[b]) for a, b in joints)
                wrong += first is not None and second is not None and not low * second <= first <= high * second
        return wrong

    def between(self, found: Mapping[str, int]) -> dict[str, int]:
        """Joints that the tree shows between those of ``found``: pelvis, neck, and collars, elbows and knees.

        The pelvis is the joint that carries both legs where that of ``found`` does not; of several joints between
        shoulder and wrist, or hip and ankle, that nearest to the middle is the elbow or the knee.
        """
        joints: dict[str, int] = {}
        hips = [self._above(found[f"{side}_hip"]) for side in _SIDES if f"{side}_hip" in found]
        if len(hips) == 2 and (carries := set(hips[0]) & set(hips[1])) and found.get("pelvis", -1) not in carries:
            joints["pelvis"] = max(carries)
        chest = self._carries_arms(found)
        if "neck" not in found and "head" in found and (chain := self._chain(chest, found["head"])):
            joints["neck"] = chain[0]
        for side in _SIDES:
            for first, joint, last in (("shoulder", "elbow", "wrist"), ("hip", "knee", "ankle")):
                ends = [found.get(f"{side}_{end}", -1) for end in (first, last)]
                if f"{side}_{joint}" not in found and (chain := self._chain(*ends)):
                    joints[f"{side}_{joint}"] = self._middle(chain, ends[1])
            shoulder = found.get(f"{side}_shoulder", -1)
            if f"{side}_collar" not in found and (chain := self._chain(chest, shoulder)):
                joints[f"{side}_collar"] = chain[0]
        return {name: joint for name, joint in joints.items() if name == "pelvis" or joint not in found.values()}

    def spine(self, found: Mapping[str, int]) -> dict[str, int]:
        """The joints between pelvis and neck: the first, the one in the middle and the last that carries the arms.

        Empty where ``found`` has all three in this order, or the tree has fewer than two.
        """
        top = found.get("neck", found.get("head", -1))
        below = set(self._above(found.get("pelvis", 0))) | {found.get("pelvis", 0)}
        chain = [joint for joint in self._above(top)[::-1] if joint not in below] if top >= 0 else []
        if (chest := self._carries_arms(found)) in chain:
            chain = chain[: chain.index(chest) + 1]
        named = [found.get(name, -1) for name in _SPINE]
        if len(chain) < 2 or (-1 not in named and sorted(named) == named):
            return {}
        joints = {"spine1": chain[0], "spine3": chain[-1]}
        return joints | {"spine2": self._middle(chain[1:-1], chain[-1])} if len(chain) > 2 else joints

    def _carries_arms(self, found: Mapping[str, int]) -> int:
        """The last joint below which head and arms are; −1 where they are not known."""
        ends = [found[name] for name in ("head", "left_shoulder", "right_shoulder") if name in found]
        return max(set.intersection(*(set(self._above(end)) for end in ends)), default=-1) if len(ends) == 3 else -1

    def _above(self, joint: int) -> list[int]:
        """Joints above ``joint``, the nearest first."""
        above = []
        while (joint := self.parents[joint]) >= 0:
            above.append(joint)
        return above

    def _chain(self, first: int, last: int) -> list[int]:
        """The joints between two; none where one is −1 or the tree does not lead from ``first`` to ``last``."""
        above = self._above(last) if min(first, last) >= 0 else []
        return above[: above.index(first)][::-1] if first in above else []

    def _middle(self, chain: Sequence[int], last: int) -> int:
        """The joint of ``chain`` that divides the way from the joint above it to ``last`` most evenly."""
        lengths = np.cumsum([float(np.linalg.norm(self.offsets[joint])) for joint in (*chain, last)])
        return chain[int(np.abs(lengths[:-1] - lengths[-1] / 2).argmin())]

    def _length(self, above: int, below: int) -> float | None:
        """Length of the chain from one joint to another; None where it does not lead there."""
        length, joint = 0.0, below
        while joint > above:
            length += float(np.linalg.norm(self.offsets[joint]))
            joint = self.parents[joint]
        return length if joint == above and below != above else None
