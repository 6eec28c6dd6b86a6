"""Everything of a model that depends on the Gaussians' places alone, computed once."""

from __future__ import annotations

import copy
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rnd_trainer.encoders import JointAttention, PoseConditioned
from rnd_trainer.model import AvatarModel
from rnd_trainer.skinning import small_rotation

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class BakedAttention:
    """A :class:`JointAttention` whose query [M, width] is a constant, scaled by 1/√(width per head).

    ``out`` [O, width] takes the output projection and the layer after it in one.
    """

    query: Floats
    out: Floats
    module: dict[str, Floats]
    heads: int


@dataclass(frozen=True, eq=False)
class BakedMlp:
    """A :class:`PoseConditioned` with the position's part of its first layer as a constant [M, width]."""

    first: Floats
    module: dict[str, Floats]


@dataclass(frozen=True, eq=False)
class BakedAvatar:
    """The constants of an avatar: per node [M, …], per Gaussian [N, …]; small weights stay in the modules."""

    temporal: BakedAttention
    spatial: BakedAttention
    merge_first: Floats
    skinning: dict[str, Floats]
    offsets: BakedMlp
    visibility: BakedMlp
    node_weights: Floats
    node_normals: Floats
    neighbours: NDArray[np.int32]
    neighbour_weights: Floats
    log_weights: Floats
    points: Floats
    frames: Floats
    scales: Floats
    normals: Floats
    opacities: Floats
    albedo: Floats
    roughness: Floats


@torch.no_grad()
def bake(model: AvatarModel) -> BakedAvatar:
    """Evaluate in float64 all that does not depend on the pose."""
    model = copy.deepcopy(model).double()
    encoded = model.encoded_nodes()
    static = model.attributes(encoded)
    nodes = len(encoded)
    skinning = model.skinning
    f_x = skinning.position(encoded)
    width = model.config.width
    for_t, for_s, for_x = skinning.merge.weight.split([width, width, width], dim=1)
    merge_first = f_x @ for_x.T + skinning.merge.bias
    merge_first = merge_first + skinning.temporal.out.bias @ for_t.T + skinning.spatial.out.bias @ for_s.T
    return BakedAvatar(
        temporal=_attention(skinning.temporal, f_x, for_t),
        spatial=_attention(skinning.spatial, f_x, for_s),
        merge_first=_array(merge_first),
        skinning=_weights(skinning),
        offsets=_mlp(model.offsets, encoded),
        visibility=_mlp(model.visibility, encoded),
        node_weights=_array(model.log_weights[:nodes].softmax(-1)),
        node_normals=_array(static.normals[:nodes]),
        neighbours=model.interpolate.neighbours.numpy().astype(np.int32),
        neighbour_weights=_array(model.interpolate.weights),
        log_weights=_array(model.log_weights),
        points=_array(static.points),
        frames=_array(model.tangents @ small_rotation(static.rotation)),
        scales=_array(static.scales),
        normals=_array(static.normals),
        opacities=_array(static.opacity),
        albedo=_array(static.albedo),
        roughness=_array(static.roughness),
    )


def _attention(module: JointAttention, f_x: Tensor, after: Tensor) -> BakedAttention:
    scale = (f_x.shape[1] // module.heads) ** -0.5
    return BakedAttention(
        query=_array(module.query(f_x) * scale),
        out=_array(after @ module.out.weight),
        module=_weights(module),
        heads=module.heads,
    )


def _mlp(module: PoseConditioned, encoded: Tensor) -> BakedMlp:
    return BakedMlp(_array(module.from_position(module.position(encoded))), _weights(module))


def _weights(module: torch.nn.Module) -> dict[str, Floats]:
    return {name: _array(value) for name, value in module.state_dict().items()}


def _array(value: Tensor) -> Floats:
    return value.detach().numpy().astype(np.float64)
