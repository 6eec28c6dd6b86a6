"""A motion recorded on its own skeleton, as in BVH and AMC files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.rotations import axis_angle_to_matrix

Floats = NDArray[np.float64]

_MAX_NUMBER = 1e6  # degrees, or lengths in any unit, against overflow


@dataclass(frozen=True, eq=False)
class MocapTree:
    """A recorded skeleton and its motion, in its file's units and axes.

    Attributes:
        names: J unique joint names, the root first.
        parents: [J], −1 for the root; parents come first.
        offsets: [J, 3] from the parent in the zero pose (identity rotations).
        rotations: [F, J, 3, 3] local, relative to the zero pose.
        root_positions: [F, 3].
        fps: frames per second.
        notes: assumptions and omissions.
        ends: offsets [3] of end sites, by the joint above.
        moves: positions [F, 3] in the parent's frame, by joint, of those that move in it.

    Raises:
        InputError: names or parents are not those of one tree.
    """

    names: tuple[str, ...]
    parents: tuple[int, ...]
    offsets: Floats
    rotations: Floats
    root_positions: Floats
    fps: float
    notes: tuple[str, ...] = ()
    ends: Mapping[int, Floats] = field(default_factory=dict)
    moves: Mapping[int, Floats] = field(default_factory=dict)

    def __post_init__(self) -> None:
        apart = [joint for joint, parent in enumerate(self.parents) if joint and not 0 <= parent < joint]
        if apart or len(set(self.names)) != len(self.names):
            raise InputError("skeleton", expected="one tree, each name once", got=", ".join(self.names))

    def global_rotations(self) -> Floats:
        """[F, J, 3, 3] of the joints in the file's world."""
        rotations = self.rotations.copy()
        for joint, parent in enumerate(self.parents[1:], 1):
            rotations[:, joint] = rotations[:, parent] @ self.rotations[:, joint]
        return rotations

    def zero_positions(self) -> Floats:
        """[J, 3] of the joints in the zero pose, the root at the origin."""
        positions = np.zeros((len(self.names), 3))
        for joint, parent in enumerate(self.parents[1:], 1):
            positions[joint] = positions[parent] + self.offsets[joint]
        return positions

    def positions(self, global_rotations: Floats) -> Floats:
        """[F, J, 3] of the joints in the file's world, given ``global_rotations`` of the tree."""
        positions = np.empty(global_rotations.shape[:-1])
        positions[:, 0] = self.root_positions
        for joint, parent in enumerate(self.parents[1:], 1):
            offset = np.broadcast_to(self.moves.get(joint, self.offsets[joint]), positions[:, 0].shape)
            positions[:, joint] = positions[:, parent] + np.einsum("fij,fj->fi", global_rotations[:, parent], offset)
        return positions


def unique_names(names: Sequence[str]) -> tuple[str, ...]:
    """``names`` with a number added to those that occur before."""
    seen: dict[str, int] = {}
    result = []
    for name in names:
        seen[name] = seen.get(name, 0) + 1
        result.append(name if seen[name] == 1 else f"{name} ({seen[name]})")
    return tuple(result)


def check_size(what: str, numbers: Sequence[float], frame: int | None = None) -> None:
    """Raise ``InputError`` for numbers too large to be angles or lengths."""
    largest = max(map(abs, numbers), default=0.0)
    if largest > _MAX_NUMBER:
        raise InputError(what, expected=f"numbers of at most {_MAX_NUMBER:g}", got=f"{largest:g}", frame=frame)


def about_axis(axis: int, angles: Floats | float) -> Floats:
    """Rotations [..., 3, 3] by ``angles`` [...] rad about coordinate axis 0, 1 or 2."""
    return axis_angle_to_matrix(np.asarray(angles)[..., None] * np.eye(3)[axis])
