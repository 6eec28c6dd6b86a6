"""Neighbours on the body side by side in the file: caches of whoever plays it then hold what comes next.

Gaussians and nodes stand in the order of a Z-curve (Morton 1966) through the pose in which their points are encoded.
The farthest-point order that a checkpoint has them in, in which any prefix covers the body, puts neighbours as far
apart as can be.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from rnd_trainer.model.template import along_curve

from .bake import BakedAvatar

Integers = NDArray[np.int64]

BY_GAUSSIAN = (
    "all_codes",
    "neighbours",
    "neighbour_weights",
    "weights",
    "points",
    "factors",
    "normals",
    "limb_axes",
    "limb_levers",
    "limb_shares",
    "opacities",
    "albedo",
    "roughness",
    "rows",
)


def gaussians_by_place(baked: BakedAvatar) -> BakedAvatar:
    """``baked`` with its Gaussians along the curve."""
    order = along_curve(baked.all_codes)
    moved = {name: getattr(baked, name)[order] for name in BY_GAUSSIAN}
    return dataclasses.replace(baked, node_rows=_inverse(order)[baked.node_rows], **moved)


def nodes_by_place(baked: BakedAvatar) -> BakedAvatar:
    """``baked`` with its nodes along the curve, those with dynamic skinning before the others."""
    moving = baked.dynamic_nodes
    order = [along_curve(baked.codes[:moving]), moving + along_curve(baked.codes[moving:])]
    return nodes_in_order(baked, np.concatenate(order))


def nodes_in_order(baked: BakedAvatar, order: Integers) -> BakedAvatar:
    """``baked`` with its nodes as ``order`` [M] names them."""
    return dataclasses.replace(
        baked,
        codes=baked.codes[order],
        node_rows=baked.node_rows[order],
        node_ranks=baked.node_ranks[order],
        neighbours=_inverse(order)[baked.neighbours],
    )


def node_sites(baked: BakedAvatar, count: int) -> Integers:
    """The nodes that are the first ``count`` in farthest-point order, as they stand in the file."""
    return np.flatnonzero(baked.node_ranks < count)


def moving_sites(baked: BakedAvatar) -> Integers:
    """The nodes at which the skinning network is evaluated; between them stand the template's weights, or what is
    interpolated."""
    sites = node_sites(baked, baked.rates.skinning)
    return sites[sites < baked.dynamic_nodes]


def _inverse(order: Integers) -> Integers:
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order))
    return place
