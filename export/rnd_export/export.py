"""avatar.ckpt → avatar.onnx: bake, write, compare with torch, and only then take the final name."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
import onnx
import torch
from numpy.typing import NDArray

from rnd_export.build.graph import build_model
from rnd_export.reduce.culling import advise, advised_cull
from rnd_export.reduce.variant import Variant, reduced
from rnd_runtime import __version__
from rnd_runtime.avatar.avatar import Avatar
from rnd_runtime.avatar.file import (
    METADATA_KEY,
    SCHEMA,
    AvatarMetadata,
    Precision,
    SkeletonMetadata,
    VariantMetadata,
    encode_light,
)
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import atomic_path
from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_runtime.motion.motion import Motion
from rnd_runtime.motion.skeleton import Skeleton
from rnd_runtime.posing.window import motion_window
from rnd_trainer.model.checkpoint import Checkpoint
from rnd_trainer.training.data import pose_input

from .bake import BakedAvatar, bake
from .order import gaussians_by_place, moving_sites, nodes_by_place

MOST_FRAMES = 1_000
"""that a file is compared with torch on: half a minute with 30 000 Gaussians"""
MAX_WEIGHT_ERROR = 1e-4
"""largest difference of a skinning weight between onnxruntime and torch"""
MAX_POSITION_ERROR_M = 1e-4
"""largest difference of a position: 0.1 mm, a tenth of a pixel at 512² and arm's length"""
MAX_RELATIVE_ERROR = 1e-3
"""largest difference of a unit normal, a harmonic of visibility (in −1…1), and a covariance over its longest axis"""
MAX_P99_M: dict[Precision, float] = {"f32": MAX_POSITION_ERROR_M, "f16": 1e-3, "int8": 3e-3}
"""of all places in all frames, what 99 % must be nearer than"""
CONVENTIONS = (
    "metres, Y up, right-handed; covariances xx xy xz yy yz zz; 6D rotations are the first two columns; "
    "visibility: real SH of degree 3, ordering l*l+l+m with the signs of 3D Gaussian splatting, root frame, "
    "towards the light; radiance linear Rec.709; trained_light lat-long, centre +X, right +Z, top +Y"
)


@dataclass(frozen=True)
class Drift:
    """Largest differences between onnxruntime and torch over a motion; of positions the 99th percentile too."""

    frames: int
    weights: float
    position_m: float
    position_p99_m: float
    normal: float
    visibility: float
    covariance_relative: float


def export(
    checkpoint: Checkpoint,
    out: Path,
    motion: Motion | None = None,
    variant: Variant | None = None,
    *,
    cull: float | None = None,
) -> Drift:
    """Write ``out``, a name in .onnx; how far it is from torch over ``motion``, by default 120 random frames.

    ``cull`` is what the file tells players to leave out of the back: a cosine, −1 for nothing, by default what is found
    not to show along ``motion`` (``advised_cull``).

    Raises ``InputError``, leaving nothing under ``out``, when the difference exceeds what the variant's
    precision allows. What ``coarse``, ``static`` and the like give up is meant: it is measured, not bounded.
    """
    refuse_ablations(checkpoint)
    variant = variant or Variant()
    variant.check(checkpoint.config.model)
    baked = gaussians_by_place(bake(checkpoint.model))
    baked = reduced(baked, checkpoint.config.model, variant)
    model = written(checkpoint, baked, variant)
    advise(model, cull)
    if motion is None:
        motion = random_motion(checkpoint.skeleton, frames=120, seed=0)
    with atomic_path(out) as temporary:
        onnx.save_model(model, str(temporary))
        avatar = Avatar.load(temporary)
        drift = measure_drift(avatar, checkpoint, motion, baked.rows)
        if not np.isfinite(dataclasses.astuple(drift)).all():
            raise InputError("export refused: places", expected="finite numbers", got="NaN or infinity", file=out)
        for what, got, bound in _bounds(drift, variant):
            if not got <= bound:
                raise InputError(
                    f"export refused: {what} of onnxruntime and torch differ",
                    expected=f"at most {bound:g}",
                    got=f"{got:.3g}",
                    file=out,
                )
        if cull is None:
            advise(model, advised_cull(avatar, motion))
            onnx.save_model(model, str(temporary))
    return drift


def refuse_ablations(checkpoint: Checkpoint) -> None:
    """What the ablations leave out the player would miss: such a checkpoint is for rnd-eval only."""
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


def written(checkpoint: Checkpoint, baked: BakedAvatar, variant: Variant) -> onnx.ModelProto:
    """The file of ``baked``, which has been ``reduced`` to ``variant``."""
    poses = variant.window_poses or checkpoint.config.model.window_poses
    metadata = _metadata(checkpoint, baked, variant)
    return build_model(nodes_by_place(baked), variant.precision, poses, {METADATA_KEY: metadata})


def _bounds(drift: Drift, variant: Variant) -> list[tuple[str, float, float]]:
    """What was measured and what is allowed, for everything that ``variant`` did not choose to change."""
    if variant != Variant(precision=variant.precision):
        return []
    if variant.precision != "f32":
        return [("positions (99 %)", drift.position_p99_m, MAX_P99_M[variant.precision])]
    return [
        ("skinning weights", drift.weights, MAX_WEIGHT_ERROR),
        ("positions", drift.position_m, MAX_POSITION_ERROR_M),
        ("normals", drift.normal, MAX_RELATIVE_ERROR),
        ("visibility", drift.visibility, MAX_RELATIVE_ERROR),
        ("covariances", drift.covariance_relative, MAX_RELATIVE_ERROR),
    ]


@torch.no_grad()
def measure_drift(avatar: Avatar, checkpoint: Checkpoint, motion: Motion, rows: NDArray[np.int64]) -> Drift:
    """Compare the written file with the ``rows`` [N] of the checkpoint's model, on ``motion``'s frames.

    Of a motion of more than ``MOST_FRAMES`` on as many, evenly spread.
    """
    outputs = ("skinning_weights", "means", "normals", "visibility", "covariances")
    worst, distances = np.zeros(len(outputs)), []
    config = checkpoint.config.model
    count = min(motion.frame_count, MOST_FRAMES)
    for frame in np.linspace(0, motion.frame_count - 1, count).astype(int):
        time = int(frame) / motion.fps
        pose = pose_input(motion, checkpoint.skeleton, time, config)
        posed = checkpoint.model(pose)
        window, velocity = motion_window(motion, time, poses=avatar.window_poses, seconds=avatar.window_seconds)
        ours = avatar.run((window, velocity, pose.bones.numpy()), outputs)
        theirs = (posed.weights, posed.means, posed.normals, posed.visibility, posed.covariances)
        errors = [np.abs(a - b.numpy()[rows]) for a, b in zip(ours, theirs)]
        largest_axis = posed.covariances.numpy()[rows][:, [0, 3, 5]].max(axis=1, keepdims=True)
        errors[-1] /= largest_axis
        worst = np.maximum(worst, [float(error.max()) for error in errors])
        distances.append(np.linalg.norm(ours[1] - posed.means.numpy()[rows], axis=1))
    weights, position, *others = (float(error) for error in worst)
    return Drift(count, weights, position, float(np.percentile(distances, 99)), *others)


def random_motion(skeleton: Skeleton, *, frames: int, seed: int) -> Motion:
    """A smooth random motion at 30 fps that bends every joint up to about a radian and turns the root around."""
    rng = np.random.default_rng(seed)
    time = np.arange(frames)[:, None, None] / 30
    shape = (1, len(skeleton), 3)
    angles = 0.6 * np.sin(2 * np.pi * rng.uniform(0.3, 1.5, shape) * time + rng.uniform(0, 2 * np.pi, shape))
    angles[:, 0, 1] += 2 * np.pi * time[:, 0, 0] / time.max()
    translations = 0.3 * np.sin(time[:, 0] * np.array([1.0, 2.0, 1.5]))
    return Motion(
        axis_angle_to_matrix(angles), translations, 30.0, skeleton.names, "random motion for the export check"
    )


def _metadata(checkpoint: Checkpoint, baked: BakedAvatar, variant: Variant) -> str:
    skeleton, config = checkpoint.skeleton, checkpoint.config.model
    moving, rates = len(moving_sites(baked)), baked.rates
    most = max(moving, rates.offsets, rates.visibility)
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
            encoder="static" if baked.skinning is None else "coarse" if most < config.nodes else "full",
            precision=variant.precision,
            nodes=most,
            dynamic_nodes=moving,
            visibility_degree=variant.visibility_degree,
        ),
    )
    return msgspec.json.encode(metadata).decode()
