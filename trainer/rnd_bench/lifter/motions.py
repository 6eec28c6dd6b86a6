"""Motion-captured clips as joint rotations, split by subject, and variants of them."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_trainer.estimating.lifted import JOINTS, PARENTS

Floats32 = NDArray[np.float32]
Generator = np.random.Generator

FPS = 30.0
TEST = ("05", "43", "55", "85", "131")
"""CMU subjects of the test: a dancer, a breakdancer, whirls, walks; none is in another split under another name"""
VALIDATION = ("02", "49", "88", "90", "127")
MIRROR = np.array([0, 2, 1, 3, 5, 4, 6, 8, 7, 9, 11, 10, 12, 14, 13, 15, 17, 16, 19, 18, 21, 20])
_ARM = {
    side: [JOINTS.index(f"{side}_{n}") for n in ("collar", "shoulder", "elbow", "wrist")] for side in ("left", "right")
}
_LEG = {side: [JOINTS.index(f"{side}_{n}") for n in ("hip", "knee", "ankle", "foot")] for side in ("left", "right")}
_SPINE3 = JOINTS.index("spine3")
_FLIP = np.diag([-1.0, 1.0, 1.0]).astype(np.float32)
_JITTER = np.radians(
    [0, 8, 8, 5, 8, 8, 4, 6, 6, 4, 5, 5, 8, 4, 4, 8, 12, 12, 10, 10, 10, 10]
)  # rms of a sequence's constant


@dataclass(frozen=True, eq=False)
class Clips:
    """Clips in a row.

    Attributes:
        rotations: [N, 22, 3, 3] of each joint, from the T-pose into the world (Y up).
        roots: [N, 3] m, of the pelvis.
        starts, lengths: [C] frames.
        names: of the clips, with file and clip.
    """

    rotations: Floats32
    roots: Floats32
    starts: NDArray[np.int64]
    lengths: NDArray[np.int64]
    names: tuple[str, ...]


def subject_of(name: str) -> str:
    """The CMU subject of a clip named ``NN_MM``, else the clip's own name without its number."""
    numbered = re.match(r"(\d+)_", name)
    return numbered[1] if numbered else re.split(r"[_#-]\d", name)[0]


def load_clips(folder: Path) -> dict[str, Clips]:
    """Read the clips of every .npz in ``folder`` as "train", "validation" and "test"."""
    files = sorted(folder.glob("*.npz"))
    if not files:
        raise InputError("motions", expected="a folder with .npz files", got="none", file=folder)
    parts: dict[str, list[tuple[Floats32, Floats32, str]]] = {"train": [], "validation": [], "test": []}
    for file in files:
        with np.load(file, allow_pickle=False) as archive:
            _check(archive, file)
            rotations = _global(archive["poses"])
            roots = archive["root_trans"].astype(np.float32)
            for start, length, name in zip(archive["start"], archive["length"], archive["name"]):
                subject = subject_of(str(name))
                part = "test" if subject in TEST else "validation" if subject in VALIDATION else "train"
                cut = slice(start, start + length)
                parts[part].append((rotations[cut], roots[cut], f"{file.stem}/{name}"))
    return {part: _joined(clips) for part, clips in parts.items()}


def _check(archive: Any, file: Path) -> None:
    if tuple(archive["joint_names"]) != JOINTS or float(archive["fps"]) != FPS:
        raise InputError(
            "motions", expected=f"{len(JOINTS)} joints at {FPS:g} frames per second", got="others", file=file
        )


def _global(poses: NDArray[np.float16]) -> Floats32:
    local = axis_angle_to_matrix(poses.astype(np.float64)).astype(np.float32)
    return chained(local)


def chained(local: Floats32) -> Floats32:
    """Rotations from the T-pose [..., 22, 3, 3] of rotations relative to the parent."""
    out = local.copy()
    for joint, parent in enumerate(PARENTS):
        if parent >= 0:
            out[..., joint, :, :] = out[..., parent, :, :] @ local[..., joint, :, :]
    return out


def relative(rotations: Floats32) -> Floats32:
    """Rotations relative to the parent [..., 22, 3, 3]: the inverse of ``chained``."""
    out = rotations.copy()
    parents = np.array(PARENTS[1:])
    out[..., 1:, :, :] = np.swapaxes(rotations[..., parents, :, :], -1, -2) @ rotations[..., 1:, :, :]
    return out


def _joined(clips: list[tuple[Floats32, Floats32, str]]) -> Clips:
    lengths = np.array([len(rotations) for rotations, _, _ in clips], np.int64)
    return Clips(
        np.concatenate([rotations for rotations, _, _ in clips]),
        np.concatenate([roots for _, roots, _ in clips]),
        np.concatenate([[0], np.cumsum(lengths)[:-1]]),
        lengths,
        tuple(name for _, _, name in clips),
    )


def windows(clips: Clips, count: int, frames: int, rng: Generator) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Frame numbers [count, frames] of random windows, and their clips; short clips go back and forth.

    Clips are chosen by the root of their length.
    """
    chance = np.sqrt(clips.lengths)
    chosen = rng.choice(len(chance), count, p=chance / chance.sum())
    lengths = clips.lengths[chosen]
    first = (rng.random(count) * np.maximum(lengths - frames, 1)).astype(np.int64)
    index = first[:, None] + np.arange(frames)
    period = np.maximum(2 * lengths - 2, 1)[:, None]
    index = index % period
    index = np.where(index < lengths[:, None], index, period - index)
    backwards = rng.random(count) < 0.1
    index[backwards] = index[backwards, ::-1]
    return clips.starts[chosen][:, None] + index, chosen


def sampled(clips: Clips, count: int, frames: int, rng: Generator, augment: bool = True) -> tuple[Floats32, Floats32]:
    """Random windows: rotations [count, frames, 22, 3, 3] and roots [count, frames, 3].

    With ``augment`` some are mirrored, get arms or legs of other clips, bend deeper, sit, or are perturbed.
    """
    index, _ = windows(clips, count, frames, rng)
    rotations, roots = clips.rotations[index], clips.roots[index]
    if not augment:
        return rotations, roots
    for side in ("left", "right"):
        chosen = np.flatnonzero(rng.random(count) < 0.12)
        _graft(rotations, clips.rotations[windows(clips, len(chosen), frames, rng)[0]], chosen, _ARM[side], _SPINE3)
    chosen = np.flatnonzero(rng.random(count) < 0.06)
    other = clips.rotations[windows(clips, len(chosen), frames, rng)[0]]
    for side in ("left", "right"):
        _graft(rotations, other, chosen, _LEG[side], 0)
    chosen = np.flatnonzero(rng.random(count) < 0.5)
    rotations[chosen] = _perturbed(rotations[chosen], rng)
    mirrored = rng.random(count) < 0.5
    rotations[mirrored] = _FLIP @ rotations[mirrored][:, :, MIRROR] @ _FLIP
    roots[mirrored] *= np.array([-1, 1, 1], np.float32)
    return rotations, roots


def _graft(rotations: Floats32, other: Floats32, chosen: NDArray[np.int64], limb: list[int], base: int) -> None:
    """Give the windows ``chosen`` the limb of ``other``, as it moves there relative to the joint ``base``."""
    if len(chosen):
        to = rotations[chosen][:, :, base] @ np.swapaxes(other[:, :, base], -1, -2)
        for joint in limb:
            rotations[chosen, :, joint] = to @ other[:, :, joint]


def _perturbed(rotations: Floats32, rng: Generator) -> Floats32:
    """Add a constant rotation to the joints of every window; some sit or squat, some bend the trunk, some lean."""
    count = len(rotations)
    local = relative(rotations)
    vectors = rng.normal(size=(count, len(JOINTS), 3)) * _JITTER[:, None]
    vectors[:, [JOINTS.index("left_knee"), JOINTS.index("right_knee")], 1:] *= 0.3
    bent = rng.random(count) < 0.2  # forwards, over three joints
    for joint in ("spine1", "spine2", "spine3"):
        vectors[bent, JOINTS.index(joint), 0] += np.radians(rng.uniform(-8, 25, bent.sum()))
    local = local @ axis_angle_to_matrix(vectors).astype(np.float32)[:, None]
    seated = np.flatnonzero(rng.random(count) < 0.12)  # legs at rest: on a chair, squatting, on the floor
    if len(seated):
        spread = np.radians(rng.uniform(-5, 35, len(seated)))
        flexed, knee = np.radians(rng.uniform(50, 125, len(seated))), np.radians(rng.uniform(10, 135, len(seated)))
        for side, sign in (("left", 1), ("right", -1)):
            hip, bend = _LEG[side][:2]
            zero = np.zeros(len(seated))
            noise = np.radians(rng.normal(0, 10, (2, len(seated))))
            hips = axis_angle_to_matrix(np.stack([zero, zero, sign * spread], -1))
            hips = hips @ axis_angle_to_matrix(np.stack([-flexed + noise[0], zero, zero], -1))
            local[seated, :, hip] = hips[:, None]
            local[seated, :, bend] = axis_angle_to_matrix(np.stack([np.abs(knee + noise[1]), zero, zero], -1))[:, None]
    lean = np.radians(np.where(rng.random(count) < 0.1, [60.0], [6.0]))[:, None]
    local[:, :, 0] = (
        axis_angle_to_matrix(rng.normal(size=(count, 3)) * lean * [1, 0.1, 0.7]).astype(np.float32)[:, None]
        @ local[:, :, 0]
    )
    return chained(local)
