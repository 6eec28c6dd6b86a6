"""The unclothed template body of a capture."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.kinds import explained
from rnd_runtime.core.npz import Npz, save_npz
from rnd_runtime.motion.skeleton import Skeleton, bone_transforms

Floats = NDArray[np.float64]

# Weights are often stored as float16 or with three digits; farther off they never were a partition of one.
_WEIGHT_SUM_TOLERANCE = 1e-2


@dataclass(frozen=True, eq=False)
class Body:
    """A skinned template in its rest pose.

    Attributes:
        vertices: [V, 3] m.
        faces: [F, 3] vertex indices, counter-clockwise seen from outside.
        skinning_weights: [V, J], not negative, rows sum to 1.
        skeleton: J joints.
        license: of the template's shape, which holds for avatars made from it.

    Raises:
        InputError: when the arrays do not fit together. Weights within 1 % of summing to 1 are normalised.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int32]
    skinning_weights: NDArray[np.float32]
    skeleton: Skeleton
    license: str = "unknown"

    def __post_init__(self) -> None:
        vertices = np.asarray(self.vertices, np.float64)
        faces = np.asarray(self.faces)
        weights = np.asarray(self.skinning_weights, np.float64)
        count = len(vertices)
        if vertices.shape != (count, 3) or count == 0 or not np.isfinite(vertices).all():
            raise InputError("vertices", expected="finite, n×3, at least one", got=f"shape {vertices.shape}")
        if faces.ndim != 2 or faces.shape[1] != 3 or (faces != np.floor(faces)).any():
            raise InputError("faces", expected="integers, n×3", got=f"{faces.dtype} of shape {faces.shape}")
        if faces.size and (faces.min() < 0 or faces.max() >= count):
            worst = faces.max() if faces.max() >= count else faces.min()
            raise InputError("faces", expected=f"vertex indices below {count}", got=int(worst))
        if weights.shape != (count, len(self.skeleton)):
            raise InputError(
                "skinning_weights",
                expected=f"{count} vertices × {len(self.skeleton)} joints",
                got="×".join(map(str, weights.shape)),
            )
        if not np.isfinite(weights).all() or weights.min() < 0:
            worst_row = int(np.argmin(np.where(np.isfinite(weights), weights, -np.inf).min(1)))
            raise InputError(f"skinning_weights of vertex {worst_row}", expected="finite, not negative")
        sums = weights.sum(1)
        worst_row = int(np.abs(sums - 1).argmax())
        if abs(sums[worst_row] - 1) > _WEIGHT_SUM_TOLERANCE:
            raise InputError(
                f"skinning_weights of vertex {worst_row}", expected="a sum of 1", got=f"{sums[worst_row]:.4g}"
            )
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "faces", faces.astype(np.int32))
        object.__setattr__(self, "skinning_weights", (weights / sums[:, None]).astype(np.float32))

    @classmethod
    def load(cls, path: str | Path) -> Body:
        """Read ``body.npz`` (arrays: ``save``)."""
        try:
            with Npz(path, what="body") as archive:
                names = archive.strings("joint_names")
                joints = len(names)
                parents = archive.numbers("joint_parents", (joints,))
                skeleton = Skeleton(names, parents, archive.numbers("rest_joints", (joints, 3)))  # type: ignore[arg-type]
                return cls(
                    archive.numbers("vertices", (None, 3)),
                    archive.numbers("faces", (None, 3)),  # type: ignore[arg-type]  # checked to be integers
                    archive.numbers("skinning_weights", (None, joints)),  # type: ignore[arg-type]
                    skeleton,
                    next(iter(archive.strings("license")), "unknown") if "license" in archive.names else "unknown",
                )
        except InputError as error:
            raise explained(error, path, "body") from error

    def save(self, path: str | Path) -> None:
        """Write ``body.npz``; vertices are stored as float32 (0.1 µm), everything else as it is."""
        save_npz(
            path,
            {
                "vertices": self.vertices.astype(np.float32),
                "faces": self.faces,
                "skinning_weights": self.skinning_weights,
                "joint_names": np.array(self.skeleton.names),
                "joint_parents": self.skeleton.parents,
                "rest_joints": self.skeleton.rest_joints,
                "license": np.array([self.license]),
            },
        )


def posed_vertices(body: Body, rotations: Floats, translation: Floats) -> Floats:
    """Vertices [V, 3] m of ``body`` under local ``rotations`` [J, 3, 3] and root ``translation`` [3] m."""
    bones = bone_transforms(body.skeleton, rotations, translation).astype(np.float64)
    return skin(body.vertices, body.skinning_weights.astype(np.float64), bones)


def skin(points: Floats, weights: Floats, bones: Floats) -> Floats:
    """Linear blend skinning of ``points`` [N, 3] by ``weights`` [N, J] and ``bones`` [J, 3, 4]."""
    blend = np.einsum("nj,jrc->nrc", weights, bones)
    posed: Floats = np.einsum("nrc,nc->nr", blend[:, :, :3], points) + blend[:, :, 3]
    return posed
