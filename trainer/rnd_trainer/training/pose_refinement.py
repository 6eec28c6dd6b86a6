"""Corrections of estimated body poses, learned with the avatar: bounded, delayed, one row a picture.

What is corrected in training is where the bones are; windows and velocities are those of the estimate there, and in
playback those of the motion that is played, corrected or not. Poses between the training frames are corrected as their
neighbours are, so that the motion stays as smooth as it was.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor, nn

from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_runtime.motion.motion import Motion
from rnd_runtime.motion.skeleton import Skeleton
from rnd_runtime.posing.forearm import twist_angles

ROTATION_BOUND = 0.12
"""radians that a joint may be corrected by about each axis, 7°: estimators err by one to three"""
TRANSLATION_BOUND = 0.05
"""metres that the root may be moved along each axis"""
FADE_SECONDS = 0.5
"""time in which the correction of the first and of the last training frame fades out beyond them"""


class PoseRefinement(nn.Module):
    """Local rotations R_k exp(δ_k) and root translations of the training frames.

    Each frame is a parameter of its own: Adam then steps only the frame that was looked at.

    Args:
        motion: the estimated poses.
        skeleton: whose rest joints place the bones.
        frames: motion frames of the training pictures; a frame seen twice is corrected once.
    """

    rotations: Tensor
    translations: Tensor
    rest_joints: Tensor

    def __init__(self, motion: Motion, skeleton: Skeleton, frames: Sequence[int]) -> None:
        super().__init__()
        self.frames = sorted(set(frames))
        self.row = {frame: k for k, frame in enumerate(self.frames)}
        self.skeleton = skeleton
        self.parents = [int(p) for p in skeleton.parents]
        arrays = {
            "rotations": motion.rotations[self.frames],
            "translations": motion.translations[self.frames],
            "rest_joints": skeleton.rest_joints,
        }
        for name, value in arrays.items():
            self.register_buffer(name, torch.as_tensor(value, dtype=torch.float32), persistent=False)
        joints = len(self.parents)
        self.raw = nn.ParameterList(torch.zeros(joints + 1, 3) for _ in self.frames)

    def bounded(self, frame: int) -> tuple[Tensor, Tensor]:
        """δ [J, 3] as rotation vectors, radians, and the root's shift [3] m, of a motion frame."""
        raw = self.raw[self.row[frame]]
        turn = ROTATION_BOUND * torch.tanh(raw[:-1] / ROTATION_BOUND)
        return turn, TRANSLATION_BOUND * torch.tanh(raw[-1] / TRANSLATION_BOUND)

    def bones(self, frame: int) -> Tensor:
        """Bone transforms [J, 3, 4] of a motion frame, corrected; differentiable in the correction."""
        turn, shift = self.bounded(frame)
        row = self.row[frame]
        local = self.rotations[row] @ torch.linalg.matrix_exp(_cross_matrices(turn))
        local = self._shared(local)
        rotation: list[Tensor] = []
        position: list[Tensor] = []
        for k, parent in enumerate(self.parents):
            if parent < 0:
                rotation.append(local[k])
                position.append(self.rest_joints[k] + self.translations[row] + shift)
            else:
                rotation.append(rotation[parent] @ local[k])
                lever = self.rest_joints[k] - self.rest_joints[parent]
                position.append(position[parent] + rotation[parent] @ lever)
        turned, moved = torch.stack(rotation), torch.stack(position)
        return torch.cat([turned, (moved - (turned @ self.rest_joints[..., None])[..., 0])[..., None]], dim=2)

    def _shared(self, local: Tensor) -> Tensor:
        """Local rotations [J, 3, 3] as ``.forearm.share_twists`` has them; by how much is taken as given."""
        shared = list(local)
        given = local.detach().double().cpu().numpy()
        for elbow, wrist, axis, angle in twist_angles(self.skeleton, given):
            turn = torch.as_tensor(axis_angle_to_matrix(angle * axis)).to(local)
            shared[elbow], shared[wrist] = shared[elbow] @ turn.T, turn @ shared[wrist]
        return torch.stack(shared)

    def prior(self, frame: int) -> Tensor:
        """Mean square of a frame's correction in units of its bounds."""
        turn, shift = self.bounded(frame)
        return (turn / ROTATION_BOUND).square().mean() + (shift / TRANSLATION_BOUND).square().mean()

    @torch.no_grad()
    def apply_to(self, motion: Motion) -> Motion:
        """``motion`` with its training frames corrected.

        Frames in between get what lies between the corrections of their neighbours, linear in time; what was learned
        at the first and at the last training frame fades out beyond them.
        """
        learned = np.stack(
            [
                torch.cat([turn.flatten(), shift]).double().cpu().numpy()
                for turn, shift in map(self.bounded, self.frames)
            ]
        )
        every = np.arange(motion.frame_count)
        between = np.stack([np.interp(every, self.frames, column) for column in learned.T], axis=1)
        beyond = np.maximum(np.maximum(self.frames[0] - every, every - self.frames[-1]), 0) / motion.fps
        between *= np.maximum(1 - beyond / FADE_SECONDS, 0)[:, None]
        turns = between[:, :-3].reshape(len(every), -1, 3)
        rotations = motion.rotations @ axis_angle_to_matrix(turns)
        return replace(motion, rotations=rotations, translations=motion.translations + between[:, -3:])


def joint_error_degrees(motion: Motion, truth: Motion, frames: Sequence[int]) -> float:
    """Mean angle between the local rotations of two motions over ``frames``, degrees."""
    frames = list(frames)
    relative = np.swapaxes(motion.rotations[frames], -1, -2) @ truth.rotations[frames]
    cosine = (np.trace(relative, axis1=-2, axis2=-1) - 1) / 2
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean())


def _cross_matrices(vectors: Tensor) -> Tensor:
    """[..., 3] → [..., 3, 3] with [v]× u = v × u."""
    x, y, z = vectors.unbind(-1)
    zero = torch.zeros_like(x)
    rows = [zero, -z, y, z, zero, -x, -y, x, zero]
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))
