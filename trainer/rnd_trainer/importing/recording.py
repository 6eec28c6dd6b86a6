"""What every layout is read into before it becomes a capture: lenses, shots and poses in the source's own world."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rnd_runtime.capture.format import Split
from rnd_runtime.core.camera import Camera
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_runtime.motion.readers.smpl_names import NAMES_BY_COUNT
from rnd_runtime.motion.skeleton import SMPL_NAMES

from .images import fitting, undistorted

Floats = NDArray[np.float64]
Bytes = NDArray[np.uint8]

RootConvention = Literal["smpl", "easymocap", "placed"]


@dataclass(frozen=True, eq=False)
class Lens:
    """A camera as its source calibrated it.

    Attributes:
        camera: our conventions (pixel centres at +0.5, metres), in the source's world.
        distortion: OpenCV's coefficients k1 k2 p1 p2 [k3 …]; empty where the pictures are undistorted already.
        undone: the coefficients that we undid.
    """

    camera: Camera
    distortion: tuple[float, ...] = ()
    undone: tuple[float, ...] = ()


@dataclass(frozen=True, eq=False)
class Shot:
    """One picture, read when asked for.

    Attributes:
        camera, frame: the lens, and the number that ``Poses`` knows the moment by.
        image: gives [H, W, 3] uint8 sRGB.
        mask: gives [H, W] uint8 coverage; None where there is none.
        normals: gives [H, W, 3] in OpenCV's camera axes, zero where unknown; None where there are none.
        split: None to have it chosen.
        name: of the picture's file, without its suffix: what masks may be called by. Empty for a video's frame.
    """

    camera: str
    frame: int
    image: Callable[[], Bytes]
    mask: Callable[[], Bytes] | None = None
    normals: Callable[[], NDArray[np.float32]] | None = None
    split: Split | None = None
    name: str = ""


@dataclass(frozen=True, eq=False)
class Poses:
    """Body poses in the source's world.

    Attributes:
        frames: [F] strictly ascending, the moments they belong to.
        rotations: [F, J, 3, 3] local, the root first.
        root: gives the root's places [F, 3] m for a rest place [3] m: where conventions differ. Called once to
            check them.
        joint_names: J.
        family: "SMPL" or "SMPL-X": whose rest pelvis ``root`` wants.
        betas: shape, or None.
        convention: how ``root`` was meant: "smpl" (rest + trans), "easymocap" (R rest + Th), or "placed" where the
            layout says where the root is.
    """

    frames: NDArray[np.int64]
    rotations: Floats
    root: Callable[[Floats], Floats]
    joint_names: tuple[str, ...] = SMPL_NAMES
    family: str = "SMPL"
    betas: Floats | None = None
    convention: RootConvention = "placed"

    def __post_init__(self) -> None:
        count = len(self.frames)
        if count == 0:
            raise InputError("body poses", expected="at least one frame", got="none")
        late = np.flatnonzero(np.diff(self.frames) <= 0)
        if len(late):
            before, after = self.frames[late[0] : late[0] + 2].tolist()
            raise InputError("body poses", expected="frames that ascend", got=f"{after} after {before}")
        if self.rotations.shape != (count, len(self.joint_names), 3, 3):
            raise InputError(
                "body poses", expected=f"{count} × {len(self.joint_names)} rotations", got=list(self.rotations.shape)
            )
        places = self.root(np.zeros(3))
        if places.shape != (count, 3):
            raise InputError("places of the root", expected=f"{count} × 3", got=_shape(places))
        finite = np.isfinite(self.rotations).all((1, 2, 3)) & np.isfinite(places).all(1)
        if not finite.all():
            raise InputError("body poses", expected="finite numbers", frame=int(self.frames[~finite][0]))


@dataclass(frozen=True, eq=False)
class Recording:
    """A source, read.

    Attributes:
        kind: what it was found to be.
        lenses: by camera name.
        shots: every picture.
        fps: pictures' frames per second.
        notes: what was assumed, one sentence each.
        up: the world's axis that points up ("y", "-y", "z", …) where the layout says so; None to ask the poses.
        film: where ``shots`` are only some of a camera's pictures, the names of all by frame; empty else.
    """

    kind: str
    lenses: dict[str, Lens]
    shots: Sequence[Shot]
    poses: Poses
    fps: float = 30.0
    notes: tuple[str, ...] = field(default=())
    up: str | None = None
    film: Mapping[int, str] = field(default_factory=dict)


def straightened(recording: Recording) -> Recording:
    """``recording`` with every lens's distortion undone, once, in pictures, masks and normals as they are read."""

    def straight(read: Callable[[], NDArray] | None, lens: Lens, what: str) -> Callable[[], NDArray] | None:
        if read is None:
            return None
        return lambda: undistorted(fitting(read(), lens.camera, what), lens.camera, lens.distortion)

    shots = []
    for shot in recording.shots:
        lens = recording.lenses[shot.camera]
        if any(lens.distortion):
            image = straight(shot.image, lens, "image")
            assert image is not None
            shot = replace(
                shot,
                image=image,
                mask=straight(shot.mask, lens, "mask"),
                normals=straight(shot.normals, lens, "normals"),
            )
        shots.append(shot)
    lenses = {name: Lens(lens.camera, (), lens.distortion) for name, lens in recording.lenses.items()}
    return replace(recording, lenses=lenses, shots=shots)


def smpl_poses(
    frames: Sequence[int] | NDArray[np.int64],
    axis_angles: ArrayLike,
    trans: ArrayLike,
    betas: ArrayLike | None = None,
    *,
    family: str = "SMPL",
    member: str = "trans",
    joint_names: tuple[str, ...] | None = None,
) -> Poses:
    """Poses in SMPL's own convention: the root turns about its rest place J0 and lies at J0 + trans.

    Args:
        axis_angles: [F, 3J] or [F, J, 3] rad, the root first.
        trans: [F, 3] m.
        member: what the file calls ``trans``.
        joint_names: J; without them J is 22, 24, 52 or 55, in the family's order.
    """
    rotations, names = _rotations(axis_angles, joint_names)
    offsets = threes(member, trans, len(rotations))
    return Poses(
        np.asarray(frames, np.int64), rotations, lambda rest: rest + offsets, names, family, mean_betas(betas), "smpl"
    )


def easymocap_poses(
    frames: Sequence[int] | NDArray[np.int64],
    axis_angles: ArrayLike,
    Rh: ArrayLike,
    Th: ArrayLike,
    betas: ArrayLike | None = None,
    *,
    family: str = "SMPL",
    members: tuple[str, str] = ("Rh", "Th"),
    joint_names: tuple[str, ...] | None = None,
) -> Poses:
    """Poses in EasyMocap's convention: a body with an unturned root, then x = R(Rh) X + Th about the origin.

    A root rotation in ``axis_angles`` (zero in its own files) is applied about the pelvis first. ``members``: what the
    file calls ``Rh`` and ``Th``; ``joint_names`` as for ``smpl_poses``.
    """
    rotations, names = _rotations(axis_angles, joint_names)
    turn = axis_angle_to_matrix(threes(members[0], Rh, len(rotations)))
    offsets = threes(members[1], Th, len(rotations))
    rotations[:, 0] = turn @ rotations[:, 0]
    return Poses(
        np.asarray(frames, np.int64),
        rotations,
        lambda rest: turn @ rest + offsets,
        names,
        family,
        mean_betas(betas),
        "easymocap",
    )


def read_as(poses: Poses, convention: RootConvention) -> Poses:
    """``poses`` whose file holds the numbers of another root convention than its layout promises.

    Raises:
        InputError: where the layout says where the root is, so that there is nothing to misread.
    """
    if convention == poses.convention:
        return poses
    if poses.convention == "placed":
        raise InputError("--as", expected="no root convention: this layout says where the pelvis is", got=convention)
    offsets, turn = poses.root(np.zeros(3)), poses.rotations[:, 0]

    def root(rest: Floats) -> Floats:
        return offsets + (turn @ rest if convention == "easymocap" else rest)

    return replace(poses, root=root, convention=convention)


def moved(poses: Poses, motion: Floats) -> Poses:
    """``poses`` in another world: ``motion`` [4, 4] rigidly brings theirs there."""
    turn, shift = motion[:3, :3], motion[:3, 3]
    rotations = poses.rotations.copy()
    rotations[:, 0] = turn @ rotations[:, 0]
    return replace(poses, rotations=rotations, root=lambda rest: poses.root(rest) @ turn.T + shift)


def threes(name: str, values: ArrayLike, count: int) -> Floats:
    """``values`` as [count, 3]: three numbers for each of ``count`` poses.

    Raises:
        InputError: there are more, or fewer; it says ``name``.
    """
    array = np.asarray(values, np.float64)
    if array.size != 3 * count:
        raise InputError(name, expected=f"{count} × 3, as there are {count} poses", got=_shape(array))
    return array.reshape(count, 3)


def mean_betas(betas: ArrayLike | None) -> Floats | None:
    """One shape [B] of one or many ([F, B] → their mean)."""
    if betas is None:
        return None
    array = np.atleast_1d(np.asarray(betas, np.float64))
    return array.reshape(-1, array.shape[-1]).mean(0)


def _rotations(axis_angles: ArrayLike, names: tuple[str, ...] | None) -> tuple[Floats, tuple[str, ...]]:
    angles = np.asarray(axis_angles, np.float64)
    if not angles.size:
        raise InputError("body poses", expected="at least one frame", got="none")
    joints, over = divmod(angles.size, 3 * len(angles))
    names = names or NAMES_BY_COUNT.get(joints)
    if over or names is None:
        known = ", ".join(map(str, NAMES_BY_COUNT))
        raise InputError("joints of the body poses", expected=known, got=_shape(angles) if over else joints)
    return axis_angle_to_matrix(angles.reshape(-1, joints, 3)), names


def _shape(array: Floats) -> str:
    return " × ".join(map(str, array.shape)) or "a single number"
