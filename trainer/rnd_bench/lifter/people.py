"""People to film: the light stage's coded people and rigged characters as coloured points on skinned surfaces."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rnd_runtime.capture.body import Body
from rnd_runtime.core.errors import InputError
from rnd_runtime.motion.skeleton import smpl_skeleton
from rnd_runtime.motion.smpl import SMPL_NAMES, SMPL_PARENTS
from rnd_trainer.estimating.fitting.figure import figure_of, vertex_normals

Floats = NDArray[np.float64]

CODED = (0, 1, 2, 3, 11, 12)
"""seeds of the coded people"""
STEP = 0.01  # m between the vertices of these
_HELD = 4  # joints that carry a vertex


def prepare(characters: Path, folder: Path) -> list[Path]:
    """Files of all people in ``folder``; those that are missing are made (minutes)."""
    from rnd_stage.people.characters import load_character
    from rnd_stage.people.dressing import dress
    from rnd_stage.people.subjects import subject
    from rnd_stage.people.template import template_body

    given = sorted(characters.glob("*.npz"))
    if not given:
        raise InputError("characters", expected="a folder with .npz files", got="none", file=characters)
    files = {f"subject{seed}": seed for seed in CODED} | {file.stem: file for file in given}
    template = None
    for name, source in files.items():
        if not (folder / f"{name}.npz").exists():
            if isinstance(source, int) and template is None:
                template = template_body()
            dressed = load_character(source) if isinstance(source, Path) else dress(subject(source), STEP, template)
            held = np.argsort(-dressed.weights, 1)[:, :_HELD]
            np.savez_compressed(
                folder / f"{name}.npz",
                vertices=dressed.vertices.astype(np.float32),
                faces=dressed.faces.astype(np.int32),
                joints=held.astype(np.uint8),
                weights=np.take_along_axis(dressed.weights, held, 1).astype(np.float16),
                colour=dressed.colour.astype(np.float16),
                piece=dressed.drape.piece.astype(np.uint8),
                rest=dressed.body.skeleton.rest_joints,
            )
    return [folder / f"{name}.npz" for name in sorted(files)]


@dataclass(frozen=True, eq=False)
class Points:
    """Points on a person's surface at rest, and how they move with shape and pose.

    Attributes:
        places: [P, 3] m; normals: [P, 3]; colour: [P, 3] linear albedo; piece: [P] of the clothes.
        weights: [P, 24] of SMPL's joints.
        rest: [24, 3] m.
        place_basis, rest_basis: [K, P, 3] and [K, 24, 3] m per unit of the K parameters of the shape.
        neutral: [K] the person as given.
    """

    places: Tensor
    normals: Tensor
    colour: Tensor
    piece: Tensor
    weights: Tensor
    rest: Tensor
    place_basis: Tensor
    rest_basis: Tensor
    neutral: Tensor

    @classmethod
    def load(cls, file: Path, count: int, device: torch.device) -> Points:
        """``count`` random points, evenly spread over the surface."""
        with np.load(file, allow_pickle=False) as archive:
            vertices, faces = archive["vertices"].astype(np.float64), archive["faces"]
            held, share = archive["joints"].astype(np.int64), archive["weights"].astype(np.float64)
            colour, piece, rest = archive["colour"].astype(np.float64), archive["piece"], archive["rest"]
        weights = np.zeros((len(vertices), len(SMPL_NAMES)))
        np.put_along_axis(weights, held, share, 1)
        weights /= weights.sum(1, keepdims=True)
        figure = figure_of(Body(vertices, faces, weights.astype(np.float32), smpl_skeleton(rest)))
        rng = np.random.default_rng(0)
        corners = vertices[faces]
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        face = rng.choice(len(faces), count, p=area / area.sum())
        mix = rng.dirichlet((1, 1, 1), count)

        def at(values: Floats) -> Tensor:
            mixed = sum(mix[:, k, None] * values[..., faces[face, k], :] for k in range(3))
            return torch.from_numpy(np.asarray(mixed, np.float32)).to(device)

        neutral = np.array([-1.0 if name == "clothes" else 0.0 for name in figure.names])
        return cls(
            at(figure.body.vertices),
            at(vertex_normals(vertices, faces)),
            at(colour),
            torch.from_numpy(piece[faces[face, 0]].astype(np.int64)).to(device),
            at(weights),
            torch.from_numpy(rest.astype(np.float32)).to(device),
            at(figure.vertex_basis),
            torch.from_numpy(figure.joint_basis.astype(np.float32)).to(device),
            torch.from_numpy(neutral.astype(np.float32)).to(device),
        )

    def joints(self, shape: Tensor, rotations: Tensor, roots: Tensor) -> Tensor:
        """Joints [B, T, 24, 3] of shapes [B, K], rotations [B, T, 24, 3, 3] from the T-pose, pelvises [B, T, 3]."""
        rest = self.rest + torch.einsum("bk,kji->bji", shape, self.rest_basis)
        placed = [roots]
        for joint, parent in enumerate(SMPL_PARENTS[1:], 1):
            bone = (rest[:, joint] - rest[:, parent])[:, None, :, None]
            placed.append(placed[parent] + (rotations[:, :, parent] @ bone)[..., 0])
        return torch.stack(placed, 2)

    def posed(self, shape: Tensor, rotations: Tensor, joints: Tensor) -> tuple[Tensor, Tensor]:
        """Places and normals [B, P, 3] of shapes [B, K], rotations [B, 24, 3, 3] and joints [B, 24, 3]."""
        rest = self.rest + torch.einsum("bk,kji->bji", shape, self.rest_basis)
        shift = joints - (rotations @ rest[..., None])[..., 0]
        moves = torch.cat([rotations, shift[..., None]], -1)
        blend = (self.weights @ moves.flatten(2)).unflatten(-1, (3, 4))
        places = self.places + torch.einsum("bk,kpi->bpi", shape, self.place_basis)
        placed = (blend[..., :3] @ places[..., None])[..., 0] + blend[..., 3]
        return placed, (blend[..., :3] @ self.normals[..., None])[..., 0]
