"""The constants of a model, evaluated in float64.

Outputs of networks that depend on a node's position alone are not stored: onnxruntime folds them when it loads the
file. They would be more than half of the file.
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
    """A ``JointAttention``: its query projection scaled by 1/√(width per head), its output fused with the next layer.

    query [width, width], query_bias [width], out [O, width]; ``module`` are the module's own parameters.
    """

    query: Floats
    query_bias: Floats
    out: Floats
    module: dict[str, Floats]


@dataclass(frozen=True, eq=False)
class BakedSkinning:
    """D_W; ``merge`` [width, width] and ``merge_bias`` [width] apply to f_x in the first layer after attention."""

    temporal: BakedAttention
    spatial: BakedAttention
    merge: Floats
    merge_bias: Floats
    module: dict[str, Floats]
    heads: int


@dataclass(frozen=True, eq=False)
class BakedAvatar:
    """The constants of an avatar: N Gaussians, M nodes, J joints.

    Attributes:
        codes: encoded positions of the nodes [M, 3] m. all_codes: of the Gaussians [N, 3] m.
        node_rows: the Gaussian at each node [M]. dynamic_nodes: the first so many nodes have dynamic skinning.
        skinning: None for the template's weights. offsets, visibility: a ``PoseConditioned`` each.
        neighbours, neighbour_weights: nodes that a Gaussian interpolates [N, K].
        weights: template skinning [N, J]. points: rest positions [N, 3] m. factors: R S at rest [N, 3, 3] m.
        rows: indices of the model's Gaussians [N], whose order is farthest-point.
        max_offset: m. area: of the template, m².
    """

    codes: Floats
    all_codes: Floats
    frequencies: int
    node_rows: NDArray[np.int64]
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


# fields of ``BakedAvatar`` with a row per Gaussian
PER_GAUSSIAN: tuple[str, ...] = (
    "all_codes",
    "neighbours",
    "neighbour_weights",
    "weights",
    "points",
    "factors",
    "normals",
)
PER_GAUSSIAN += ("limb_axes", "limb_levers", "limb_shares", "opacities", "albedo", "roughness", "rows")


@torch.no_grad()
def bake(model: AvatarModel) -> BakedAvatar:
    """Evaluate everything that does not depend on the pose."""
    model = copy.deepcopy(model).double()
    config = model.config
    static = model.attributes(model.encoded_nodes())
    frames = model.tangents @ small_rotation(static.rotation)
    return BakedAvatar(
        codes=_array(model.codes[: config.nodes]),
        all_codes=_array(model.codes),
        frequencies=config.frequencies,
        node_rows=np.arange(config.nodes),
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
    assert skinning.temporal is not None
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
