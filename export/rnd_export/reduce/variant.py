"""Reductions of an exported file for speed or size."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rnd_export.bake import BakedAvatar, BakedSkinning
from rnd_export.order import permute_nodes
from rnd_runtime.avatar.file import EncoderKind, Precision
from rnd_runtime.core.errors import InputError, flag
from rnd_runtime.shading.sh import SH_DEGREE
from rnd_trainer.config import ModelConfig
from rnd_trainer.model.template import NEIGHBOURS, node_interpolation

COARSE_SHARE = 4  # nodes per node of ``coarse``


@dataclass(frozen=True)
class Variant:
    """Reductions of a file, by default none.

    Attributes:
        encoder: ``full``; ``coarse``: networks at ``nodes`` points, by default a quarter of the checkpoint's;
            ``static``: the template's skinning weights, no attention.
        precision: of stored constants; arithmetic is float32.
        nodes: M, a prefix of the farthest-point order; for ``coarse``.
        window_poses: d; fewer poses span the same seconds.
        visibility_degree: 0 to 3; higher SH coefficients are dropped.
    """

    encoder: EncoderKind = "full"
    precision: Precision = "f32"
    nodes: int | None = None
    window_poses: int | None = None
    visibility_degree: int = SH_DEGREE

    def node_count(self, config: ModelConfig) -> int:
        """M of the file."""
        if self.encoder != "coarse":
            return config.nodes
        return self.nodes or max(NEIGHBOURS, config.nodes // COARSE_SHARE)

    def check(self, config: ModelConfig) -> None:
        """Refuse variants that are impossible for ``config``."""
        limits = {
            "nodes": (NEIGHBOURS, config.nodes),
            "window_poses": (min(2, config.window_poses), config.window_poses),
            "visibility_degree": (0, SH_DEGREE),
        }
        for name, (low, high) in limits.items():
            value = getattr(self, name)
            if value is not None and not low <= value <= high:
                raise InputError(flag(name), expected=f"{low} to {high}", got=value)
        if self.nodes is not None and self.encoder != "coarse":
            raise InputError("--nodes", expected="--encoder coarse", got=f"--encoder {self.encoder}")
        static = self.encoder == "static" or not config.dynamic_skinning
        if self.window_poses is not None and static:
            got = "the template's weights, which have no window"
            raise InputError("--window-poses", expected="dynamic skinning", got=got)


def reduced(baked: BakedAvatar, config: ModelConfig, variant: Variant) -> BakedAvatar:
    """``baked`` reduced to ``variant``."""
    changes: dict[str, Any] = {}
    nodes, skinning = variant.node_count(config), baked.skinning
    if nodes < len(baked.codes):
        neighbours, weights = node_interpolation(baked.all_codes, baked.codes[:nodes], baked.area)
        changes |= {
            "codes": baked.codes[:nodes],
            "node_rows": baked.node_rows[:nodes],
            "neighbours": neighbours,
            "neighbour_weights": weights,
            "dynamic_nodes": nodes if skinning else 0,
        }
    if variant.encoder == "static":
        changes |= {"skinning": None, "dynamic_nodes": 0}
    elif skinning is not None and variant.window_poses not in (None, config.window_poses):
        changes["skinning"] = _shorter(skinning, config.window_poses, int(variant.window_poses or 0))
    if variant.visibility_degree < SH_DEGREE:
        kept = (variant.visibility_degree + 1) ** 2
        out = {name: baked.visibility[name][:kept] for name in ("out.weight", "out.bias")}
        changes["visibility"] = {**baked.visibility, **out}
    return dataclasses.replace(baked, **changes)


def static_where(baked: BakedAvatar, still: NDArray[np.bool_]) -> BakedAvatar:
    """``baked`` with the template's skinning at the nodes ``still`` [M], which become the last ones."""
    if still.all():
        return dataclasses.replace(baked, dynamic_nodes=0, skinning=None)
    moved = permute_nodes(baked, np.argsort(still, kind="stable"))
    return dataclasses.replace(moved, dynamic_nodes=int((~still).sum()))


def _shorter(skinning: BakedSkinning, poses: int, fewer: int) -> BakedSkinning:
    """``skinning`` for ``fewer`` poses: its first layer interpolates the missing ones."""
    module = dict(skinning.temporal.module)
    weight = module["embed.weight"]  # [width, poses · 6]
    interpolation = line_through(poses, fewer)
    embedded = np.einsum("wpc,pf->wfc", weight.reshape(len(weight), poses, 6), interpolation)
    module["embed.weight"] = embedded.reshape(len(weight), fewer * 6)
    return dataclasses.replace(skinning, temporal=dataclasses.replace(skinning.temporal, module=module))


def line_through(poses: int, fewer: int) -> NDArray[np.float64]:
    """[poses, fewer]: weights of the piecewise linear interpolation of evenly spaced values."""
    positions = np.linspace(0, fewer - 1, poses)
    weights: NDArray[np.float64] = np.maximum(0, 1 - np.abs(positions[:, None] - np.arange(fewer)))
    return weights
