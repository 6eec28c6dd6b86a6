"""Spatial order of Gaussians and nodes in the file, for the caches of players.

They are stored along a Z-curve (Morton 1966) through their encoded positions, instead of the checkpoint's
farthest-point order.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from rnd_trainer.model.template import z_curve_order

from .bake import PER_GAUSSIAN, BakedAvatar

Integers = NDArray[np.int64]


def order_gaussians(baked: BakedAvatar) -> BakedAvatar:
    """``baked`` with its Gaussians along the curve."""
    order = z_curve_order(baked.all_codes)
    moved = {name: getattr(baked, name)[order] for name in PER_GAUSSIAN}
    return dataclasses.replace(baked, node_rows=_inverse(order)[baked.node_rows], **moved)


def order_nodes(baked: BakedAvatar) -> BakedAvatar:
    """``baked`` with its nodes along the curve, those with dynamic skinning before the others."""
    moving = baked.dynamic_nodes
    order = [z_curve_order(baked.codes[:moving]), moving + z_curve_order(baked.codes[moving:])]
    return permute_nodes(baked, np.concatenate(order))


def permute_nodes(baked: BakedAvatar, order: Integers) -> BakedAvatar:
    """``baked`` with its nodes in ``order`` [M]."""
    return dataclasses.replace(
        baked, codes=baked.codes[order], node_rows=baked.node_rows[order], neighbours=_inverse(order)[baked.neighbours]
    )


def _inverse(order: Integers) -> Integers:
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    return rank
