"""avatar.ckpt → avatar.onnx: bake, order, reduce, build, and compare with torch before the file is renamed."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import msgspec
import numpy as np
import onnx

from rnd_export.build.graph import build_model
from rnd_export.reduce.culling import add_advice, find_cull
from rnd_export.reduce.variant import Variant, reduced
from rnd_runtime import __version__
from rnd_runtime.avatar.avatar import Avatar
from rnd_runtime.avatar.file import (
    METADATA_KEY,
    SCHEMA,
    AvatarMetadata,
    SkeletonMetadata,
    VariantMetadata,
    encode_light,
)
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import atomic_path
from rnd_runtime.motion.motion import Motion
from rnd_trainer.model.checkpoint import Checkpoint

from .bake import BakedAvatar, bake
from .order import order_gaussians, order_nodes
from .parity import ParityError, measure_parity, random_motion

CONVENTIONS = (
    "metres, Y up, right-handed; covariances xx xy xz yy yz zz; 6D rotations are the first two columns; "
    "visibility: real SH of degree 3, ordering l*l+l+m with the signs of 3D Gaussian splatting, root frame, "
    "towards the light; radiance linear Rec.709; trained_light lat-long, centre +X, right +Z, top +Y"
)


def export(
    checkpoint: Checkpoint,
    out: Path,
    motion: Motion | None = None,
    variant: Variant | None = None,
    *,
    cull: float | None = None,
) -> ParityError:
    """Write ``out``, a name in .onnx, and return its difference from torch over ``motion``.

    Args:
        motion: by default 120 random frames.
        variant: reductions; errors of the precision are limited, those of others only measured.
        cull: n·v below which players are advised to cull Gaussians; −1: none, by default ``find_cull``.

    Raises:
        InputError: the difference exceeds the limit of the precision; ``out`` is not written.
    """
    refuse_ablations(checkpoint)
    variant = variant or Variant()
    variant.check(checkpoint.config.model)
    baked = reduced(order_gaussians(bake(checkpoint.model)), checkpoint.config.model, variant)
    model = build(checkpoint, baked, variant)
    add_advice(model, cull)
    if motion is None:
        motion = random_motion(checkpoint.skeleton, frames=120, seed=0)
    with atomic_path(out) as temporary:
        onnx.save_model(model, str(temporary))
        avatar = Avatar.load(temporary)
        error = measure_parity(avatar, checkpoint, motion, baked.rows)
        if not np.isfinite(dataclasses.astuple(error)).all():
            raise InputError("export refused: positions", expected="finite numbers", got="NaN or infinity", file=out)
        for what, got, allowed in error.limits(variant):
            if not got <= allowed:
                what = f"export refused: {what} of onnxruntime and torch differ"
                raise InputError(what, expected=f"at most {allowed:g}", got=f"{got:.3g}", file=out)
        if cull is None:
            add_advice(model, find_cull(avatar, motion))
            onnx.save_model(model, str(temporary))
    return error


def refuse_ablations(checkpoint: Checkpoint) -> None:
    """Raise ``InputError`` for checkpoints of ablations, which players do not support."""
    config = checkpoint.config
    for field, got, wanted in (
        ("visibility", config.model.visibility, "pose"),
        ("motion_encoder", config.model.motion_encoder, "full"),
        ("light", config.light, "learn"),
    ):
        if got != wanted and (field, got) != ("light", "capture"):
            raise InputError(
                f"an ablation, which is not exported: {field}", expected=wanted, got=got, file=checkpoint.file
            )


def build(checkpoint: Checkpoint, baked: BakedAvatar, variant: Variant) -> onnx.ModelProto:
    """The ONNX model of ``baked``, which has been ``reduced`` to ``variant``."""
    poses = variant.window_poses or checkpoint.config.model.window_poses
    return build_model(
        order_nodes(baked), variant.precision, poses, {METADATA_KEY: _metadata(checkpoint, baked, variant)}
    )


def _metadata(checkpoint: Checkpoint, baked: BakedAvatar, variant: Variant) -> str:
    skeleton, config = checkpoint.skeleton, checkpoint.config.model
    nodes = len(baked.codes)
    metadata = AvatarMetadata(
        schema=SCHEMA,
        gaussians=len(baked.points),
        spacing_m=float(checkpoint.model.spacing) * math.sqrt(config.gaussians / len(baked.points)),
        window_poses=variant.window_poses or config.window_poses,
        window_seconds=config.window_seconds,
        skeleton=SkeletonMetadata(
            names=list(skeleton.names),
            parents=[int(p) for p in skeleton.parents],
            rest_joints=[(float(x), float(y), float(z)) for x, y, z in skeleton.rest_joints],
        ),
        trained_light=encode_light(checkpoint.probe.numpy()),
        body_license=str(checkpoint.info.get("body_license", "unknown")),
        checkpoint_sha256=checkpoint.sha256,
        conventions=CONVENTIONS,
        generator=f"rnd-avatar {__version__}",
        variant=VariantMetadata(
            encoder="static" if baked.skinning is None else "coarse" if nodes < config.nodes else "full",
            precision=variant.precision,
            nodes=nodes,
            dynamic_nodes=baked.dynamic_nodes,
            visibility_degree=variant.visibility_degree,
        ),
    )
    return msgspec.json.encode(metadata).decode()
