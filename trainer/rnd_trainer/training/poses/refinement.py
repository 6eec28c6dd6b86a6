"""Bounded corrections of estimated body poses, learned with the avatar: as large as the estimate is unsure.

Training corrects the bone transforms; motion windows and velocities remain those of the estimate.
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

from .uncertainty import PoseUncertainty

ROTATION_BOUND = 0.12
"""bound of a joint's correction about each axis, rad (7°), where nothing is known of the poses' errors"""
TRANSLATION_BOUND = 0.05
"""bound of the root's correction along each axis, m, where nothing is known"""
DEVIATIONS = 2.5
"""bound of a correction in deviations of the estimate"""
ROTATION_LIMITS = (0.03, 0.6)
TRANSLATION_LIMITS = (0.01, 0.3)
"""least and largest bound, rad and m"""
SMOOTH_SECONDS = 0.15
"""neighbours so near in time are corrected alike"""
SMOOTH_WEIGHT = 5.0
"""of the difference from the neighbours' mean correction, beside that of the correction itself"""
FADE_SECONDS = 0.5
"""time over which corrections fade out before the first and after the last training frame, s"""


class PoseRefinement(nn.Module):
    """Local rotations R_k exp(δ_k) and root translations of the training frames.

    Each frame is a parameter of its own, so that Adam updates only the frame of the step.

    Args:
        motion: the estimated poses.
        skeleton: of the motion.
        frames: motion frames of the training images, repeats allowed.
        uncertainty: of the motion's poses; its deviations bound the corrections.
    """

    rotations: Tensor
    translations: Tensor
    rest_joints: Tensor
    rotation_bounds: Tensor
    translation_bounds: Tensor

    def __init__(
        self, motion: Motion, skeleton: Skeleton, frames: Sequence[int], uncertainty: PoseUncertainty | None = None
    ) -> None:
        super().__init__()
        self.frames = sorted(set(frames))
        self.row = {frame: k for k, frame in enumerate(self.frames)}
        self.skeleton = skeleton
        self.parents = [int(p) for p in skeleton.parents]
        arrays = {
            "rotations": motion.rotations[self.frames],
            "translations": motion.translations[self.frames],
            "rest_joints": skeleton.rest_joints,
            "rotation_bounds": np.full((len(self.frames), len(self.parents), 3), ROTATION_BOUND),
            "translation_bounds": np.full((len(self.frames), 3), TRANSLATION_BOUND),
        }
        if uncertainty is not None:
            rotations, translations = uncertainty.rotations[self.frames], uncertainty.translations[self.frames]
            arrays["rotation_bounds"] = np.clip(DEVIATIONS * rotations, *ROTATION_LIMITS)
            arrays["translation_bounds"] = np.clip(DEVIATIONS * translations, *TRANSLATION_LIMITS)
        self.times = np.array(self.frames) / motion.fps
        for name, value in arrays.items():
            self.register_buffer(name, torch.as_tensor(value, dtype=torch.float32), persistent=False)
        joints = len(self.parents)
        self.raw = nn.ParameterList(torch.zeros(joints + 1, 3) for _ in self.frames)

    def bounded(self, frame: int) -> tuple[Tensor, Tensor]:
        """δ [J, 3] as rotation vectors (rad) and the root's shift [3] m, of a motion frame."""
        row = self.row[frame]
        raw, bounds = self.raw[row], self._bounds(row)
        rotation, shift = (bound * torch.tanh(part / bound) for part, bound in zip((raw[:-1], raw[-1]), bounds))
        return rotation, shift

    def bones(self, frame: int) -> Tensor:
        """Bone transforms [J, 3, 4] of a motion frame, corrected; differentiable in the correction."""
        delta, shift = self.bounded(frame)
        row = self.row[frame]
        local = self._share_twists(self.rotations[row] @ torch.linalg.matrix_exp(_cross_matrices(delta)))
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
        rotations, positions = torch.stack(rotation), torch.stack(position)
        return torch.cat([rotations, (positions - (rotations @ self.rest_joints[..., None])[..., 0])[..., None]], dim=2)

    def _share_twists(self, local: Tensor) -> Tensor:
        """``rnd_runtime.posing.forearm.share_twists`` of local rotations [J, 3, 3]; no gradient by the twist angle."""
        shared = list(local)
        values = local.detach().double().cpu().numpy()
        for elbow, wrist, axis, angle in twist_angles(self.skeleton, values):
            twist = torch.as_tensor(axis_angle_to_matrix(angle * axis)).to(local)
            shared[elbow], shared[wrist] = shared[elbow] @ twist.T, twist @ shared[wrist]
        return torch.stack(shared)

    def prior(self, frame: int) -> Tensor:
        """Mean square of a frame's correction, and of its difference from its neighbours', in units of its bounds."""
        row = self.row[frame]
        rotation, shift = (part / bound for part, bound in zip(self.bounded(frame), self._bounds(row)))
        result = rotation.square().mean() + shift.square().mean()
        near = [k for k in (row - 1, row + 1) if 0 <= k < len(self.frames)]
        near = [k for k in near if abs(self.times[k] - self.times[row]) <= SMOOTH_SECONDS]
        if near:
            with torch.no_grad():
                around = [self.bounded(self.frames[k]) for k in near]
                means = [torch.stack(parts).mean(0) / bound for parts, bound in zip(zip(*around), self._bounds(row))]
            result = result + SMOOTH_WEIGHT * (
                (rotation - means[0]).square().mean() + (shift - means[1]).square().mean()
            )
        return result

    def _bounds(self, row: int) -> tuple[Tensor, Tensor]:
        return self.rotation_bounds[row], self.translation_bounds[row]

    @torch.no_grad()
    def apply_to(self, motion: Motion) -> Motion:
        """``motion`` with its training frames corrected.

        Corrections are interpolated linearly in time between training frames, and fade out beyond them.
        """
        at_frames = np.stack(
            [
                torch.cat([rotation.flatten(), shift]).double().cpu().numpy()
                for rotation, shift in map(self.bounded, self.frames)
            ]
        )
        every = np.arange(motion.frame_count)
        correction = np.stack([np.interp(every, self.frames, column) for column in at_frames.T], axis=1)
        beyond = np.maximum(np.maximum(self.frames[0] - every, every - self.frames[-1]), 0) / motion.fps
        correction *= np.maximum(1 - beyond / FADE_SECONDS, 0)[:, None]
        rotation_vectors = correction[:, :-3].reshape(len(every), -1, 3)
        rotations = motion.rotations @ axis_angle_to_matrix(rotation_vectors)
        return replace(motion, rotations=rotations, translations=motion.translations + correction[:, -3:])


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
