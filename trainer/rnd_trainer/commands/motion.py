"""rnd-data motion: any motion file rewritten as an .npz in AMASS' form."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro
from rich.console import Console

from rnd_runtime.avatar.avatar import Avatar
from rnd_runtime.capture.body import Body
from rnd_runtime.core.console import print_plain
from rnd_runtime.core.errors import check_option
from rnd_runtime.core.files import existing_file, npz_output, refuse_input
from rnd_runtime.motion.amass import write_amass
from rnd_runtime.motion.edit import MotionEdits, edit_motion, resampled
from rnd_runtime.motion.motion import Motion, load_motion, motion_inputs
from rnd_runtime.motion.readers.arrays import FPS_LIMITS, SMPLH_NAMES
from rnd_runtime.motion.retarget import sole
from rnd_runtime.motion.skeleton import Skeleton, smpl_skeleton

# Joints of an adult in cm, SMPL's order, standing about SMPL's origin: what matters are the proportions of the legs.
_MEAN_PERSON = (
    (-0.18, -22.33, 2.82),
    (7, -31, 2),
    (-7, -31, 2),
    (0, -11, 0),
    (10, -69, 2),
    (-10, -69, 2),
    (0, 2, 0),
    (9, -109, -3),
    (-9, -109, -3),
    (0, 7, 3),
    (12, -114, 9),
    (-12, -114, 9),
    (0, 29, -1),
    (8, 20, -1),
    (-8, 20, -1),
    (0, 35, 4),
    (17, 23, -2),
    (-17, 23, -2),
    (43, 21, -4),
    (-43, 21, -4),
    (68, 22, -4),
    (-68, 22, -4),
    (77, 21, -6),
    (-77, 21, -6),
)
_FINGERS = frozenset(SMPLH_NAMES[22:])
_NEAR = 0.3  # m from there at which feet are taken to stand where the mean person's do at rest


def motion(
    source: Annotated[Path, tyro.conf.Positional],
    out: Annotated[Path, tyro.conf.Positional],
    body: Path | None = None,
    up: Annotated[Literal["auto", "y", "z"], tyro.conf.arg(aliases=["--motion-up"])] = "auto",
    source_fps: float | None = None,
    fps: float | None = None,
    joint_map: Path | None = None,
    edits: Annotated[MotionEdits, tyro.conf.arg(name="")] = MotionEdits(),  # noqa: B008  # frozen
) -> int:
    """Rewrite a motion of any kind as an .npz in AMASS' form (SMPL-H, Z up), which most tools read.

    Args:
        source: .npz, .pkl, .pt, .npy, .bvh, or .amc with its .asf beside it
        out: the .npz to write
        body: body.npz or avatar.onnx whose skeleton BVH and AMC are retargeted to; SMPL's mean body when not given
        up: the axis that points up in the source
        source_fps: frames per second of the source, where it does not say
        fps: frames per second to write; the source's when not given
        joint_map: TOML or JSON file with SMPL's joints and what the source calls them
        edits: what to do to the motion
    """
    refuse_input(npz_output(out), *motion_inputs(source), body, joint_map)
    low, high = FPS_LIMITS
    for name, rate in (("--source-fps", source_fps), ("--fps", fps)):
        check_option(rate is None or low <= rate <= high, name, f"{low:g} to {high:g}", rate)
    skeleton = _skeleton(body)
    loaded = load_motion(source, skeleton, up=up, fps=source_fps, joint_map=joint_map)
    if body is None and not _FINGERS.isdisjoint(loaded.left_out):
        skeleton = _with_fingers(skeleton)
        loaded = load_motion(source, skeleton, up=up, fps=source_fps, joint_map=joint_map)
    made = edit_motion(loaded, edits)
    if body is None:
        made = _lifted(made, skeleton)
    if fps is not None:
        notes = made.notes + made.loop_notes(fps)
        made = replace(resampled(made, fps), notes=notes)
    lost = write_amass(out, made, skeleton)
    console = Console()
    for note in [
        *made.notes,
        *(
            [f"joints that turn and the skeleton lacks are left out: {', '.join(made.left_out)}"]
            if made.left_out
            else []
        ),
        *([f"joints that SMPL-H lacks are left out: {', '.join(lost)}"] if lost else []),
    ]:
        print_plain(console, f"note: {note}")
    seconds = f"{made.fps:g} per second, {made.duration:.1f} s"
    line = f"{out}: {made.frame_count} frames, {seconds}"
    print_plain(console, line)
    return 0


def _lifted(motion: Motion, mean: Skeleton) -> Motion:
    """``motion`` on the floor, where a file whose ``trans`` begin at another body's rest has it about SMPL's origin."""
    feet = [k for k, name in enumerate(mean.names) if name.endswith("_foot")]
    heights = mean.joint_transforms(motion.rotations, motion.translations)[:, feet, 1, 3].min(1)
    below = sole(mean)
    if abs(np.percentile(heights, 5) - mean.rest_joints[feet, 1].min()) > _NEAR:
        return motion
    note = f"lifted by {-below:.2f} m, so that SMPL's mean body stands on the floor; --body names the motion's own"
    return replace(motion, translations=motion.translations - [0, below, 0], notes=(*motion.notes, note))


def _with_fingers(skeleton: Skeleton) -> Skeleton:
    """SMPL's ``skeleton`` with SMPL-H's fingers beside its hands, where they are: what matters is that they turn."""
    names, parents, places = list(skeleton.names), list(skeleton.parents), list(skeleton.rest_joints)
    for finger in SMPLH_NAMES[22:]:
        side, bone = finger.split("_")[0], int(finger[-1])
        parents.append(names.index(f"{side}_wrist" if bone == 1 else f"{finger[:-1]}{bone - 1}"))
        places.append(skeleton.rest_joints[names.index(f"{side}_hand")])
        names.append(finger)
    return Skeleton(tuple(names), np.array(parents), np.array(places))


def _skeleton(body: Path | None) -> Skeleton:
    if body is None:
        return smpl_skeleton(np.array(_MEAN_PERSON) / 100)
    file = existing_file(body, what="body")
    return Avatar.load(file).skeleton if file.suffix.lower() == ".onnx" else Body.load(file).skeleton
