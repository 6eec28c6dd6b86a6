"""avatar.ckpt → avatar.onnx: bake, write, compare with torch, and only then take the final name."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
import onnx
import torch

from rnd_runtime import __version__
from rnd_runtime.avatar import METADATA_KEY, SCHEMA, Avatar, AvatarMetadata, SkeletonMetadata, encode_light
from rnd_runtime.errors import InputError
from rnd_runtime.files import atomic_path
from rnd_runtime.motion import Motion
from rnd_runtime.rotations import axis_angle_to_matrix
from rnd_runtime.skeleton import Skeleton
from rnd_trainer.checkpoint import Checkpoint, load_checkpoint
from rnd_trainer.data import pose_input

from .bake import bake
from .graph import build_model

MAX_WEIGHT_ERROR = 1e-4
"""largest difference of a skinning weight between onnxruntime and torch"""
MAX_POSITION_ERROR_M = 1e-4
"""largest difference of a position: 0.1 mm, a tenth of a pixel at 512² and arm's length"""
CONVENTIONS = (
    "metres, Y up, right-handed; covariances xx xy xz yy yz zz; 6D rotations are the first two columns; "
    "visibility: real SH of degree 3, ordering l*l+l+m with the signs of 3D Gaussian splatting, root frame, "
    "towards the light; radiance linear Rec.709; trained_light lat-long, centre +X, right +Z, top +Y"
)


@dataclass(frozen=True)
class Drift:
    """Largest differences between onnxruntime and torch over a motion."""

    frames: int
    weights: float
    position_m: float
    normal: float
    visibility: float
    covariance_relative: float


def export(checkpoint_path: Path, out: Path, motion: Motion | None = None) -> Drift:
    """Write ``out`` and return how far it is from torch over ``motion`` (by default 120 random frames).

    Raises :class:`InputError`, leaving nothing under ``out``, when the difference exceeds
    ``MAX_WEIGHT_ERROR`` or ``MAX_POSITION_ERROR_M``.
    """
    checkpoint = load_checkpoint(checkpoint_path)
    model = build_model(
        bake(checkpoint.model),
        checkpoint.config.model,
        {METADATA_KEY: _metadata(checkpoint, checkpoint_path)},
    )
    if motion is None:
        motion = random_motion(checkpoint.skeleton, frames=120, seed=0)
    with atomic_path(out) as temporary:
        onnx.save_model(model, str(temporary))
        drift = measure_drift(Avatar.load(temporary), checkpoint, motion)
        for what, got, bound in (
            ("skinning weights", drift.weights, MAX_WEIGHT_ERROR),
            ("positions", drift.position_m, MAX_POSITION_ERROR_M),
        ):
            if not got <= bound:
                raise InputError(
                    f"export refused: {what} of onnxruntime and torch differ",
                    expected=f"at most {bound:g}", got=f"{got:.3g}", file=out,
                )  # fmt: skip
    return drift


@torch.no_grad()
def measure_drift(avatar: Avatar, checkpoint: Checkpoint, motion: Motion) -> Drift:
    """Compare the written file with the checkpoint's model on every frame of ``motion``."""
    outputs = ("skinning_weights", "means", "normals", "visibility", "covariances")
    worst = np.zeros(len(outputs))
    for frame in range(motion.frame_count):
        pose = pose_input(motion, checkpoint.skeleton, frame / motion.fps, checkpoint.config.model)
        posed = checkpoint.model(pose)
        ours = avatar.run((pose.window.numpy(), pose.velocity.numpy(), pose.bones.numpy()), outputs)
        theirs = (posed.weights, posed.means, posed.normals, posed.visibility, posed.covariances)
        errors = [np.abs(a - b.numpy()) for a, b in zip(ours, theirs)]
        errors[-1] /= posed.covariances.numpy()[:, [0, 3, 5]].max(
            axis=1, keepdims=True
        )  # of its largest axis
        worst = np.maximum(worst, [float(error.max()) for error in errors])
    return Drift(motion.frame_count, *(float(error) for error in worst))


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


def _metadata(checkpoint: Checkpoint, path: Path) -> str:
    skeleton, config = checkpoint.skeleton, checkpoint.config.model
    metadata = AvatarMetadata(
        schema=SCHEMA,
        gaussians=config.gaussians,
        spacing_m=float(checkpoint.model.spacing),
        window_poses=config.window_poses,
        window_seconds=config.window_seconds,
        skeleton=SkeletonMetadata(
            names=list(skeleton.names),
            parents=[int(p) for p in skeleton.parents],
            rest_joints=[(float(x), float(y), float(z)) for x, y, z in skeleton.rest_joints],
        ),
        trained_light=encode_light(checkpoint.probe.numpy()),
        body_license=str(checkpoint.info.get("body_license", "unknown")),
        checkpoint_sha256=hashlib.sha256(path.read_bytes()).hexdigest(),
        conventions=CONVENTIONS,
        generator=f"rnd-avatar {__version__}",
    )
    return msgspec.json.encode(metadata).decode()
