"""Edits of a motion before it is played: smoothing, looping, in place, speed."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.errors import InputError, flag, refuse_outside
from rnd_runtime.core.rotations import axis_angle_to_matrix, matrix_to_axis_angle, slerp_matrices

if TYPE_CHECKING:
    from .motion import Motion

Floats = NDArray[np.float64]

# One-Euro filter (Casiez et al. 2012): rise of the cutoff, Hz per rad/s and per m/s. A brisk walk's knee: 5 rad/s
_ROTATION_BETA = 1.5
_TRANSLATION_BETA = 5.0
_SPEED_CUTOFF = 1.0  # Hz, as in the paper
_SEAM_SECONDS = 0.5
_MIN_LOOP = 4  # frames
_MAX_FRAMES = 2_000_000  # 9 h at 60 per second


EDIT_LIMITS = {"smooth": (1e-2, 1e3), "speed": (1e-2, 100.0)}  # minimum and maximum


@dataclass(frozen=True)
class MotionEdits:
    """Changes to a motion, applied in this order.

    Attributes:
        smooth: cutoff in Hz of a One-Euro filter at rest; lower is smoother.
        speed: playback speed; the frame rate stays.
        in_place: keep the root above its start.
        loop: blend the end into the beginning, so that the clip repeats.

    Raises:
        InputError: for a number beyond ``EDIT_LIMITS``.
    """

    smooth: float | None = None
    speed: float = 1.0
    in_place: bool = False
    loop: bool = False

    def __post_init__(self) -> None:
        refuse_outside(self, EDIT_LIMITS)


def edit_motion(motion: Motion, edits: MotionEdits) -> Motion:
    """``motion`` with ``edits`` applied.

    Raises:
        InputError: the motion is too short to loop.
    """
    if edits.smooth is not None:
        motion = smoothed(motion, edits.smooth)
    if edits.speed != 1.0:
        motion = sped_up(motion, edits.speed)
    if edits.in_place:
        motion = kept_in_place(motion)
    return looped(motion) if edits.loop else motion


def smoothed(motion: Motion, cutoff_hz: float) -> Motion:
    """``motion`` through a One-Euro filter on rotations and root path, without lag: the mean of both directions."""
    _check("smooth", cutoff_hz, "a cutoff in Hz")
    frames, joints = motion.rotations.shape[:2]
    forth = _one_euro(motion.rotations, motion.translations, motion.fps, cutoff_hz)
    back = _one_euro(motion.rotations[::-1], motion.translations[::-1], motion.fps, cutoff_hz)
    rotations = slerp_matrices(forth[0], back[0][::-1], np.full((frames, joints), 0.5))
    return replace(motion, rotations=rotations, translations=(forth[1] + back[1][::-1]) / 2)


def sped_up(motion: Motion, speed: float) -> Motion:
    """``motion`` in 1/``speed`` of its time at the same frame rate."""
    _check("speed", speed, "a factor")
    return replace(resampled(motion, motion.fps / speed), fps=motion.fps)


def resampled(motion: Motion, fps: float) -> Motion:
    """``motion`` at ``fps`` frames per second; a closed one stays closed if it has a whole number of frames.

    Raises ``InputError`` for more than ``_MAX_FRAMES``.
    """
    _check("fps", fps, "frames per second")
    count = motion.frames_at(fps)
    if count > _MAX_FRAMES:
        got = f"{count} in {motion.duration:.6g} s at {fps:g} per second"
        raise InputError("frames of the motion", expected=f"at most {_MAX_FRAMES}", got=got)
    frames = motion.at(np.arange(count) / fps)
    return replace(frames, fps=fps, closed=motion.goes_round_at(fps))


def kept_in_place(motion: Motion) -> Motion:
    """``motion`` with its root above its start; its height stays."""
    translations = motion.translations.copy()
    translations[:, [0, 2]] = translations[0, [0, 2]]
    return replace(motion, translations=translations)


def looped(motion: Motion, seam_seconds: float = _SEAM_SECONDS) -> Motion:
    """``motion`` closed: its end is blended into its first ``seam_seconds``, which are cut.

    The root's net displacement is distributed over the clip, so feet slide, which is noted.
    """
    if motion.frame_count < _MIN_LOOP:
        raise InputError("--loop", expected=f"a motion of at least {_MIN_LOOP} frames", got=motion.frame_count)
    seam = min(max(round(seam_seconds * motion.fps), 1), motion.frame_count // 3)
    length = motion.frame_count - seam
    displacement = (motion.translations[length:] - motion.translations[:seam]).mean(0) * [1, 0, 1]
    steps = (np.arange(motion.frame_count) / length)[:, None]
    translations = motion.translations - steps * displacement
    t = (np.arange(seam) + 0.5) / seam
    weight = (t * t * (3 - 2 * t))[:, None]
    tail = slerp_matrices(motion.rotations[length:], motion.rotations[:seam], weight)
    path = (1 - weight) * translations[length:] + weight * translations[:seam]
    distance = float(np.linalg.norm(displacement))
    note = (f"--loop takes back {distance:.2f} m over the clip: feet slide (--in-place keeps the root)",)
    return replace(
        motion,
        rotations=np.concatenate([motion.rotations[seam:length], tail]),
        translations=np.concatenate([translations[seam:length], path]),
        notes=motion.notes + note if distance > 0.1 else motion.notes,
        closed=True,
    )


def _one_euro(rotations: Floats, translations: Floats, fps: float, cutoff_hz: float) -> tuple[Floats, Floats]:
    """The causal filter over [F, J, 3, 3] and [F, 3]."""
    smooth_rotations, smooth_translations = rotations.copy(), translations.copy()
    angular, linear = np.zeros((*rotations.shape[1:2], 3)), np.zeros(3)  # filtered velocities, rad/s and m/s
    gain = _gain(_SPEED_CUTOFF, fps)
    for frame in range(1, len(rotations)):
        step = matrix_to_axis_angle(np.swapaxes(rotations[frame - 1], -1, -2) @ rotations[frame])
        angular = angular + gain * (step * fps - angular)
        linear = linear + gain * ((translations[frame] - translations[frame - 1]) * fps - linear)
        before = smooth_rotations[frame - 1]
        towards = matrix_to_axis_angle(np.swapaxes(before, -1, -2) @ rotations[frame])
        rotation_gain = _gain(cutoff_hz + _ROTATION_BETA * np.linalg.norm(angular, axis=-1), fps)
        smooth_rotations[frame] = before @ axis_angle_to_matrix(rotation_gain[:, None] * towards)
        before = smooth_translations[frame - 1]
        translation_gain = _gain(cutoff_hz + _TRANSLATION_BETA * float(np.linalg.norm(linear)), fps)
        smooth_translations[frame] = before + translation_gain * (translations[frame] - before)
    return smooth_rotations, smooth_translations


def _gain(cutoff_hz: Floats | float, fps: float) -> Floats:
    """Share by which a low-pass filter approaches its input within a frame."""
    return np.asarray(1 / (1 + fps / (2 * np.pi * np.asarray(cutoff_hz))))


def _check(what: str, value: float, expected: str) -> None:
    if not (np.isfinite(value) and value > 0):
        raise InputError(flag(what), expected=f"{expected}, above 0", got=value)
