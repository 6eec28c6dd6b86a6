"""Pictures that two players must agree on, although the last bits of their places differ.

Where two Gaussians lie at one depth to 1e-7 m, the order of a sum's operations decides which of them is in front. A
pixel that is off must then be the pixel of another picture by the same player, whose places differ in their last bits
and in nothing else.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any
from unittest.mock import patch

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rnd_runtime.posing.rest import RestPose
from rnd_runtime.posing.skinning import PosedArrays

Image = NDArray[np.uint8]

LAST_BITS = 2e-7
"""m, of a place: what two orders of one float32 sum may differ by"""
TRIES = 24
"""pictures that are drawn anew where a pixel is off"""


def assert_only_ties(got: Image, expected: Image, again: Callable[[], Image], tolerance: ArrayLike) -> None:
    """No pixel of ``got`` is farther than ``tolerance`` from ``expected`` and from all that ``again`` draws.

    ``tolerance`` (of 255) is one for all or [H, W]. ``again`` draws ``expected`` once more; places that are posed on
    the CPU then differ in their last bits.
    """
    assert got.shape == expected.shape
    off = _error(got, expected) > tolerance
    rng = np.random.default_rng(0)
    pose = RestPose.pose

    def wobbling(rest: RestPose, *fields: Any) -> PosedArrays:
        posed = pose(rest, *fields)
        return posed._replace(means=posed.means + rng.normal(0, LAST_BITS, posed.means.shape).astype(np.float32))

    with patch.object(RestPose, "pose", wobbling):
        for _ in range(TRIES):
            if not off.any():
                break
            off &= _error(got, again()) > tolerance
    assert not off.any(), np.argwhere(off)


def _error(got: Image, expected: Image) -> NDArray[np.int64]:
    return np.abs(got.astype(int) - expected).max(axis=-1)
