"""The up axis of a motion whose file does not state it, from how the trunk stands."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

UP_ROTATIONS: dict[str, Floats] = {
    "y": np.eye(3),
    "-y": np.diag([1.0, -1.0, -1.0]),
    "z": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
    "-z": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
    "x": np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
    "-x": np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
}
"""Rotations [3, 3] of a world with that axis up to Y up"""

_UNCLEAR = 0.3  # mean cosine of the trunk and the assumed up axis, below which another is looked for
_CLEAR = 0.8  # mean cosine of the trunk and the other
_LEG = 0.85  # m
_LIES = (-0.1, 0.65)  # heights of the hips of somebody who lies, sits or crawls, in legs
_STANDS = (0.75, 1.3)
_SHARE = 0.05  # of the frames at either end of the heights


def up_axis(trunk: Floats, hips: Floats, assumed: str, clear: float = _CLEAR) -> tuple[str, tuple[str, ...]]:
    """The up axis, a key of ``UP_ROTATIONS``, and a note where it is not ``assumed``, or where it may not be.

    The trunk's mean direction decides, except for a person who lies: whose hips stay near the floor of the assumed
    world, and are not as high as a leg along the trunk.

    Args:
        trunk: [F, 3] unit directions from the hips to the chest, in the file's world.
        hips: [F, 3] m.
        assumed: the layout's axis, "y" or "z".
        clear: mean cosine of the trunk and another axis that makes it up.
    """
    mean = trunk.mean(0)
    along = int(np.abs(mean).argmax())
    found = ("-" if mean[along] < 0 else "") + "xyz"[along]
    if mean["xyz".index(assumed)] > _UNCLEAR or abs(mean[along]) < clear or found == assumed:
        return assumed, ()
    low, high = np.quantile(hips[:, "xyz".index(assumed)] / _LEG, [_SHARE, 1 - _SHARE])
    stands = float(np.median(hips[:, along]) * np.sign(mean[along]) / _LEG)
    if _LIES[0] < low and high < _LIES[1] and not _STANDS[0] < stands < _STANDS[1]:
        overrule = f"; --motion-up {found} overrules" if found in ("y", "z") else ""
        return assumed, (f"the trunk lies along {found}, and {assumed} stays up, as in its layout{overrule}",)
    return found, (f"{found} is taken for up, as the trunk stands along it; --motion-up {assumed} overrules",)
