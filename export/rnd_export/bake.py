"""Everything of a model that does not depend on the pose, folded as far as it makes the file smaller.

What the networks make of a node's place alone is *not* stored: it follows from the node's coordinates and a few
small matrices, and onnxruntime computes it once, when the file is loaded (constant folding). Stored, it would be
more than half of the file.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rnd_trainer.model.encoders import JointAttention
from rnd_trainer.model.model import AvatarModel
from rnd_trainer.model.skinning import small_rotation

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class BakedAttention:
    """A ``JointAttention`` without its query side.

    ``query`` [width, width] and ``query_bias`` [width] are scaled by 1/√(width per head); ``out`` [O, width] takes
    the output projection and the layer after it in one; the rest is the module's.
    """

    query: Floats
    query_bias: Floats
    out: Floats
    module: dict[str, Floats]


@dataclass(frozen=True, eq=False)
class BakedSkinning:
    """D_W: ``merge`` [width, width] and ``merge_bias`` take f_x to its share of the first layer after attention."""

    temporal: BakedAttention
    spatial: BakedAttention
    merge: Floats
    merge_bias: Floats
    module: dict[str, Floats]
    heads: int


@dataclass(frozen=True)
class Rates:
    """At how many nodes each network is evaluated: the first so many in farthest-point order. All nodes read these as
    Gaussians read nodes, by ``rnd_trainer.model.template.node_interpolation``."""

    skinning: int
    offsets: int
    visibility: int


@dataclass(frozen=True, eq=False)
class BakedAvatar:
    """The constants of an avatar. N Gaussians, M nodes, J joints.

    ``rows`` [N] are the model's Gaussians that stand here, in whose farthest-point order any prefix covers the body;
    ``codes`` [M, 3] m and ``node_rows`` [M] (the Gaussian that stands at a node) are in the order of the nodes,
    ``all_codes`` [N, 3] m belong to the Gaussians;
    ``factors`` [N, 3, 3] m is R S in the rest pose; ``offsets`` and ``visibility`` are a
    ``PoseConditioned`` each, ``skinning`` None where the template's weights are used as they are. Skinning is
    dynamic at the first ``dynamic_nodes`` nodes, the template's at the others. ``node_ranks`` [M] are the nodes'
    places in the farthest-point order, by which ``rates`` counts; ``area`` is the template's, m².
    """

    codes: Floats
    all_codes: Floats
    frequencies: int
    node_rows: NDArray[np.int64]
    node_ranks: NDArray[np.int64]
    rates: Rates
    dynamic_nodes: int
    skinning: BakedSkinning | None
    offsets: dict[str, Floats]
    visibility: dict[str, Floats]
    neighbours: NDArray[np.int64]
    neighbour_weights: Floats
    weights: Floats
    points: Floats
    factors: Floats
    normals: Floats
    limb_axes: Floats
    limb_levers: Floats
    limb_shares: Floats
    opacities: Floats
    albedo: Floats
    roughness: Floats
    rows: NDArray[np.int64]
    max_offset: float
    area: float


@torch.no_grad()
def bake(model: AvatarModel) -> BakedAvatar:
    """Evaluate in float64 all that does not depend on the pose."""
    model = copy.deepcopy(model).double()
    config = model.config
    static = model.attributes(model.encoded_nodes())
    frames = model.tangents @ small_rotation(static.rotation)
    return BakedAvatar(
        codes=_array(model.codes[: config.nodes]),
        all_codes=_array(model.codes),
        frequencies=config.frequencies,
        node_rows=np.arange(config.nodes),
        node_ranks=np.arange(config.nodes),
        rates=Rates(config.nodes, config.nodes, config.nodes),
        dynamic_nodes=config.nodes if config.dynamic_skinning else 0,
        skinning=_skinning(model) if config.dynamic_skinning else None,
        offsets=_weights(model.offsets),
        visibility=_weights(model.visibility),
        neighbours=model.interpolate.neighbours.numpy(),
        neighbour_weights=_array(model.interpolate.weights),
        weights=_array(model.log_weights.softmax(-1)),
        points=_array(static.points),
        factors=_array(frames * static.scales[:, None, :]),
        normals=_array(static.normals),
        limb_axes=_array(model.limb_axes),
        limb_levers=_array(model.limb_levers),
        limb_shares=_array(model.limb_shares),
        opacities=_array(static.opacity),
        albedo=_array(static.albedo),
        roughness=_array(static.roughness),
        rows=np.arange(len(model.codes)),
        max_offset=config.max_offset,
        area=config.gaussians * float(model.spacing) ** 2,
    )


def _skinning(model: AvatarModel) -> BakedSkinning:
    skinning, width = model.skinning, model.config.width
    assert skinning.temporal is not None, "ablations are refused before"
    for_t, for_s, for_x = skinning.merge.weight.split([width, width, width], dim=1)
    bias = skinning.merge.bias
    bias = bias + skinning.temporal.out.bias @ for_t.T + skinning.spatial.out.bias @ for_s.T
    return BakedSkinning(
        temporal=_attention(skinning.temporal, for_t),
        spatial=_attention(skinning.spatial, for_s),
        merge=_array(for_x),
        merge_bias=_array(bias),
        module=_weights(skinning),
        heads=skinning.temporal.heads,
    )


def _attention(module: JointAttention, after: Tensor) -> BakedAttention:
    scale = (module.query.weight.shape[0] // module.heads) ** -0.5
    return BakedAttention(
        query=_array(module.query.weight * scale),
        query_bias=_array(module.query.bias * scale),
        out=_array(after @ module.out.weight),
        module=_weights(module),
    )


def _weights(module: torch.nn.Module) -> dict[str, Floats]:
    return {name: _array(value) for name, value in module.state_dict().items()}


def _array(value: Tensor) -> Floats:
    return value.detach().numpy().astype(np.float64)
