"""What a skeleton's tree and lengths say about the names of its joints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_SPINE = ("spine1", "spine2", "spine3")
_CHAINS = (
    (*_SPINE, "neck", "head"),
    *((f"{side}_hip", f"{side}_knee", f"{side}_ankle", f"{side}_foot") for side in ("left", "right")),
    *((f"{side}_shoulder", f"{side}_elbow", f"{side}_wrist", f"{side}_hand") for side in ("left", "right")),
    *((f"{side}_collar", f"{side}_shoulder") for side in ("left", "right")),
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
        for side in ("left", "right"):
            for bones, low, high in _RATIOS:
                joints = [(f"{side}_{bone}", f"{side}_{_AHEAD[bone]}") for bone in bones]
                if not all(joint in found for pair in joints for joint in pair):
                    continue
                first, second = (self._length(found[a], found[b]) for a, b in joints)
                wrong += first is not None and second is not None and not low * second <= first <= high * second
        return wrong

    def spine(self, found: Mapping[str, int]) -> dict[str, int]:
        """The joints between pelvis and neck: the first, the one in the middle and the last that carries the arms.

        Empty where ``found`` has all three in this order, or the tree has fewer than two.
        """
        chain: list[int] = []
        top = found.get("neck", found.get("head", -1))
        joint = self.parents[top] if top >= 0 else -1
        while joint > found.get("pelvis", 0):
            chain.insert(0, joint)
            joint = self.parents[joint]
        named = [found.get(name, -1) for name in _SPINE]
        if len(chain) < 2 or joint != found.get("pelvis", 0) or (-1 not in named and sorted(named) == named):
            return {}
        heights = np.cumsum([0.0] + [float(np.linalg.norm(self.offsets[joint])) for joint in chain[1:]])
        middle = int(np.abs(heights[1:-1] - heights[-1] / 2).argmin()) + 1 if len(chain) > 2 else None
        joints = {"spine1": chain[0], "spine3": chain[-1]}
        return joints if middle is None else joints | {"spine2": chain[middle]}

    def _length(self, above: int, below: int) -> float | None:
        """Length of the chain from one joint to another; None where it does not lead there."""
        length, joint = 0.0, below
        while joint > above:
            length += float(np.linalg.norm(self.offsets[joint]))
            joint = self.parents[joint]
        return length if joint == above and below != above else None
