"""Rotations of a skeleton's joints from where a recording has them.

Every joint gets a frame from positions: the pelvis from the hips' axis and the spine above them, the chest from the
collars' or shoulders' axis, a limb from its bone's direction and from what shows its roll: the axis about which a knee
or an elbow bends, the toes, the knuckles. Where the recording has rotations too, they carry the frame through time by
one constant rotation per joint, C_k, fitted over the clip: G_k(t) = Q_k(t) C_k. Its roll is the mean of what hinges,
feet and the parent show, weighted by their inverse variances. So neither the zero pose nor the axes of the recorded
bones matter, and what positions do not show (a wrist's twist, a nod) stays as recorded. Where rotations contradict
positions, as of programs that solve them for positions alone, positions decide.
"""

from __future__ import annotations

import numpy as np

from rnd_runtime.motion.skeleton import Skeleton

from .bones import Bone, leg_length
from .directions import (
    Floats,
    about,
    angle_about,
    angle_between,
    body_frame,
    mean_rotation,
    median_rotation,
    swing,
    unit,
)
from .evidence import Complexes, Evidence, Recorded, Tracks, coherence, lateral_at_rest, smooth
from .tips import long_enough, tip_at_rest

_SLIGHT = np.sin(np.radians(20)) ** 2  # weight of a hinge; of a slighter bend, the wrong way round is noise
# Coherences of rolls: of what is shown with rotations that carry it, and where it is noise; and how many times as
# incoherent as with neutral rolls it may be with those that carry it
_COHERENT, _INCOHERENT, _NOISE = 0.97, 0.6, 1.5
_AGREES, _TWISTS = 0.9, 0.5  # of recorded with neutral rolls, where nothing is shown; of a forearm, which twists far
_NO_ROLL = 0.9995  # of rotations that are the smallest ones from bone to bone
# Max median deviations of recorded rotations: from the trunk's frames, from a bone with which those of its children
# may be compared, and of joints of which positions show nothing from their parents
_RIGID, _NEARLY, _FREE = np.radians([20.0, 10.0, 45.0])
_ABOUT_A_MEAN = ("head", "_wrist", "_hand")
# From neutral, of a pose that is held over the clip: more than the mean of 95 % of clips (316 of nine mocap sources,
# from the mean of their source) differs by, so that up to there a zero pose and the clip's mean are as likely neutral,
# and the mean, which any zero pose leaves as it is, counts
_HELD, _HELD_HEAD = np.radians([40.0, 30.0])
_IMPOSSIBLE = np.radians(75)  # from neutral, of a tip that says nothing
_SMOOTH = 0.1  # s, of a roll from positions alone
_NATURAL_TWIST, _NATURAL_BEND = np.radians([45.0, 50.0])  # of a zero pose that is a person's


def solve(tracks: Tracks, skeleton: Skeleton) -> Floats:
    """World rotations [F, J, 3, 3] of ``skeleton``'s joints; a joint that ``tracks`` lacks follows its parent."""
    solver = _Solver(tracks, skeleton)
    rotations = solver.run(zero_is_rest=False)
    return solver.run(zero_is_rest=True) if solver.zero_pose_is_a_persons() else rotations


class _Solver:
    def __init__(self, tracks: Tracks, skeleton: Skeleton) -> None:
        self.recorded = Recorded(tracks, skeleton)
        self.points, self.rotations, self.fps = self.recorded.points, tracks.rotations, tracks.fps
        self.tips = tracks.tips
        self.names, self.parents = skeleton.names, skeleton.parents
        self.bones, self.at_rest, self.chest = self.recorded.bones, self.recorded.at_rest, self.recorded.chest
        self._forget()

    def _forget(self) -> None:
        self.solved: dict[str, Floats] = {}
        self.constants: dict[str, Floats] = {}  # C of joints whose rotations agree with positions
        self.shown: set[str] = set()  # joints whose roll the recording shows
        self.carried: set[str] = set()  # joints whose roll follows recorded rotations

    def run(self, zero_is_rest: bool) -> Floats:
        """World rotations [F, J, 3, 3].

        Args:
            zero_is_rest: whether poses that nothing shows and that are held over the clip are as in the zero pose.
        """
        self._forget()
        for joint, name in enumerate(self.names):
            parent = self.names[self.parents[joint]]
            if joint == 0:
                self.solved[name] = self._trunk(name, *self.recorded.pelvis_axis)
            elif name not in self.recorded.tracks.points:
                self.solved[name] = self.solved[parent]
            elif name == self.chest:
                self.solved[name] = self._trunk(name, *self.recorded.chest_axis)
            elif name in self.bones:
                self.solved[name] = self._bone(name, parent, zero_is_rest)
            else:
                self.solved[name] = self._end(name, parent, zero_is_rest)
        return np.stack([self.solved[name] for name in self.names], 1)

    def zero_pose_is_a_persons(self) -> bool:
        """Whether the zero pose, seen through the constants, is one that a person can hold, without twists."""
        constants, root, chest = self.constants, self.names[0], self.chest or self.names[0]
        if not {root, chest} <= constants.keys() or angle_between(constants[root], constants[chest]) > _NATURAL_TWIST:
            return False
        legs = 0
        for joint, name in enumerate(self.names):
            parent = self.names[self.parents[joint]]
            if name in (root, chest) or name not in self.bones or not {name, parent} <= constants.keys():
                continue
            own, above = constants[name], constants[parent]
            before, after = above @ self.at_rest[name], own @ self.at_rest[name]
            if name in self.shown and angle_between(swing(before, after) @ above, own) > _NATURAL_TWIST:
                return False
            if name.endswith(("_hip", "_knee", "_ankle")):
                legs += 1
                if before @ after < np.cos(_NATURAL_BEND):
                    return False
        return legs >= 4

    def _trunk(self, name: str, left: Floats, left_at_rest: Floats) -> Floats:
        """Pelvis or chest, by its axis to the left and the direction of the spine."""
        if name in self.bones:
            up, up_at_rest = self.bones[name].along(self.points), self.at_rest[name]
        else:
            legs = [Bone(f"{side}_knee", f"{side}_hip") for side in ("left", "right")]
            up, up_at_rest = (np.add(*(leg.along(j) for leg in legs)) for j in (self.points, self.recorded.rest))
        shown: Floats = body_frame(left, up) @ body_frame(left_at_rest, up_at_rest).T
        return self._fitted(name, shown, _RIGID)

    def _fitted(self, name: str, shown: Floats, tolerance: float) -> Floats:
        """Recorded rotations with the constant that brings them nearest to ``shown``; it where they contradict it."""
        if name not in self.rotations:
            return shown
        relative = np.swapaxes(self.rotations[name], -1, -2) @ shown
        # toes are straight most of the time, hands and heads move about a mean
        constant = mean_rotation(relative) if name.endswith(_ABOUT_A_MEAN) else median_rotation(relative)
        if np.median(angle_between(relative, constant)) > tolerance:
            return shown
        self.constants[name] = constant
        fitted: Floats = self.rotations[name] @ constant
        return fitted

    def _end(self, name: str, parent: str, zero_is_rest: bool) -> Floats:
        """A joint of which positions show nothing, by its rotations relative to those of the joint above it."""
        above = self.chest if name == "head" and self.chest in self.solved else parent  # level while the neck bends
        compared = {above, parent} if parent in self.bones else {above}
        if not compared <= self.constants.keys():
            return self.solved[above]
        neutral = self._fitted(name, self.solved[above], _FREE)
        in_zero_pose = self.constants[above]
        held = zero_is_rest and name in self.constants and name.endswith(_ABOUT_A_MEAN)
        if held and angle_between(self.constants[name], in_zero_pose) > _held(name):
            self.constants[name] = in_zero_pose
            return self.rotations[name] @ in_zero_pose
        return self._towards_tip(name, neutral)

    def _towards_tip(self, name: str, neutral: Floats) -> Floats:
        """``neutral`` [F, 3, 3], rotated to the joint's tip where that shows a pose that is held over the clip."""
        at_rest = tip_at_rest(name, self.recorded.rest)
        if name not in self.tips or name not in self.constants or at_rest is None:
            return neutral
        way = self.tips[name] - self.points[name]
        if not long_enough(way, leg_length(self.points)):
            return neutral
        local = unit(np.median(np.einsum("fji,fj->fi", self.rotations[name], unit(way)), axis=0))
        before = self.constants[name] @ at_rest
        if not _held(name) < np.arccos(np.clip(before @ local, -1, 1)) < _IMPOSSIBLE:
            return neutral
        self.constants[name] = swing(before, local) @ self.constants[name]
        turned: Floats = self.rotations[name] @ self.constants[name]
        return turned

    def _bone(self, name: str, parent: str, zero_is_rest: bool) -> Floats:
        """A joint whose bone has a direction, rolled about it."""
        bone, at_rest, above = unit(self.bones[name].along(self.points)), self.at_rest[name], self.solved[parent]
        neutral = swing(above @ at_rest, bone) @ above
        prior, shown = self.recorded.prior(name, bone, neutral), self.recorded.shown(name)
        by_position = shown.rolls(bone, neutral)
        constant = self._constant(name, parent, bone)
        if constant is not None:
            recorded = self.rotations[name] @ constant
            base, lateral = swing(recorded @ at_rest, bone) @ recorded, lateral_at_rest(name, at_rest)
            by_rotation = shown.rolls(bone, base)
            own = np.exp(1j * angle_about(bone, neutral @ lateral, base @ lateral))
            if self._carries(name, parent, coherence(by_rotation), coherence(by_position), own):
                roll = self._constant_roll(name, shown, prior, bone, base, zero_is_rest)
                self.constants[name] = constant @ about(at_rest, roll)
                self.carried.add(name)
                carried: Floats = about(bone, np.full(len(bone), roll)) @ base
                return carried
        to_prior = np.sum([seen.rolls(bone, neutral) for seen in prior], axis=0)
        wrong = (shown.size < _SLIGHT) & ((by_position * to_prior.conj()).real < 0)
        rolls = smooth(np.where(wrong, 0, by_position) + to_prior, _SMOOTH * self.fps)
        solved: Floats = about(bone, np.angle(rolls)) @ neutral
        if constant is not None:
            self._fitted(name, solved, _NEARLY)
        return solved

    def _constant_roll(
        self, name: str, shown: Evidence, prior: list[Evidence], bone: Floats, base: Floats, zero_is_rest: bool
    ) -> float:
        """The roll from ``base``, recorded rotations, to what is ``shown`` over the clip and to the ``prior``."""
        visible = shown.over_clip(bone, base)
        expected = complex(sum(seen.over_clip(bone, base) for seen in prior))
        if shown.mean_size() < _SLIGHT and (visible * expected.conjugate()).real < 0:
            visible = 0j
        if abs(visible) > abs(expected):
            self.shown.add(name)
        elif zero_is_rest and self.recorded.foot_axis(name) is None and abs(np.angle(expected)) > _HELD:
            return 0.0
        return float(np.angle(visible + expected))

    def _carries(self, name: str, parent: str, by_rotation: float, by_position: float, own: Complexes) -> bool:
        """Whether the recorded rolls of joint ``name`` are a body's, not what a program chose for want of knowledge.

        Args:
            by_rotation: coherence of what is shown with the recorded rolls.
            by_position: its coherence with neutral rolls.
            own: e^{iφ} [F] of the recorded rolls relative to neutral ones.
        """
        twists = name.endswith(("_elbow", "_wrist"))
        if max(by_rotation, by_position) < _INCOHERENT:
            return (parent in self.constants or not twists) and coherence(own) > (_TWISTS if twists else _AGREES)
        if twists and parent in self.shown and by_rotation > _TWISTS:
            return True
        hinge = name.endswith(("_elbow", "_knee"))
        if hinge and parent not in self.carried:  # the same hinge
            return False
        rolls = hinge or len(own) < 3 or coherence(own) < _NO_ROLL
        return rolls and 1 - by_rotation <= max(1 - _COHERENT, _NOISE * (1 - by_position))

    def _constant(self, name: str, parent: str, bone: Floats) -> Floats | None:
        """C with a neutral roll in the zero pose; None where the recorded rotations do not carry the ``bone``."""
        if name not in self.rotations:
            return None
        in_bone = np.einsum("fji,fj->fi", self.rotations[name], bone)
        local = unit(np.median(in_bone, axis=0))
        if np.median(in_bone @ local) < np.cos(_RIGID):
            return None
        above = self.constants.get(parent, np.eye(3))
        constant: Floats = swing(above @ self.at_rest[name], local) @ above
        return constant


def _held(name: str) -> float:
    return float(_HELD_HEAD if name == "head" else _HELD)
