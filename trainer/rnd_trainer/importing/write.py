"""A recording becomes a capture: one world with Y up, one body, one undistortion, pictures on black."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.capture.body import Body
from rnd_runtime.capture.capture import Capture, Frame, save_capture
from rnd_runtime.capture.format import TRAIN_SHARE
from rnd_runtime.core.camera import Camera
from rnd_runtime.core.errors import InputError, refuse_changed
from rnd_runtime.core.files import output_folder
from rnd_runtime.core.images import linear_to_srgb, srgb_to_linear, to_bytes, write_image
from rnd_runtime.core.rotations import slerp_matrices
from rnd_runtime.motion.motion import Motion
from rnd_runtime.motion.readers.arrays import SMPL_REST_ROOT, SMPLX_REST_ROOT

from .body_models import BodyModel
from .images import fitting
from .options import Choice
from .recording import Poses, Recording, Shot

Floats = NDArray[np.float64]

UPS = {"x": (1.0, 0, 0), "-x": (-1.0, 0, 0), "y": (0, 1.0, 0), "-y": (0, -1.0, 0), "z": (0, 0, 1.0), "-z": (0, 0, -1.0)}
SNAP = np.cos(np.radians(30))
"""a person who stands within 30° of an axis on average stands along it; farther off the world was never levelled"""
MOST_FILLED = 100_000
"""poses between given ones, an hour of a video; numbers farther apart, such as times, count no frames"""
_TO_LINEAR = srgb_to_linear(np.arange(256) / 255)


@dataclass(frozen=True, eq=False)
class Scene:
    """A recording's body, motion (from its first pose on) and cameras in a world with Y up.

    Attributes:
        turn: [3, 3] from the source's world to ours.
        notes: what had to be assumed, one sentence each.
    """

    body: Body
    motion: Motion
    cameras: dict[str, Camera]
    turn: Floats
    notes: list[str]


def placed(recording: Recording, model: BodyModel, up: str | None = None) -> Scene:
    """The scene of ``recording`` with the body of ``model``; frames between poses are slerped.

    ``up`` is the axis of the source that points up ("y", "-z", …); None to go by the layout or the poses.
    """
    poses, notes = recording.poses, list(recording.notes)
    shaped = model.family == poses.family or (model.family, poses.family) == ("SMPL-H", "SMPL")
    body = model.shaped(poses.betas if shaped else None)
    rest = body.skeleton.rest_joints[0]
    if not shaped:
        rest = SMPLX_REST_ROOT if poses.family == "SMPL-X" else SMPL_REST_ROOT
        notes.append(
            f"the poses are {poses.family}'s and the body is not: shape ignored, {poses.family}'s mean pelvis assumed"
        )
    roots = poses.root(rest)
    rotations = _by_name(poses, body)
    turn = _upright(rotations[:, 0], up or recording.up, notes)
    rotations[:, 0] = turn @ rotations[:, 0]
    roots = roots @ turn.T
    motion = _filled(poses.frames, rotations, roots - body.skeleton.rest_joints[0], body, recording.fps, notes)
    back = np.eye(4)
    back[:3, :3] = turn.T
    cameras = {
        name: replace(lens.camera, world_to_camera=lens.camera.world_to_camera @ back)
        for name, lens in recording.lenses.items()
    }
    return Scene(body, motion, cameras, turn, notes)


def chosen_shots(recording: Recording, choice: Choice) -> list[Shot]:
    """The shots that ``choice`` keeps, each with its split.

    Shots that have one keep it. Else: the first 4/5 of the training camera's frames train, its last 1/5 are novel
    poses; of the other cameras every so many frames are novel views, or novel poses from there on.

    Raises:
        InputError: nothing is kept, the training camera has no picture among what is, or ``choice`` speaks of several
            cameras where there is no choice between them.
    """
    first, last = int(recording.poses.frames[0]), int(recording.poses.frames[-1])
    kept = [shot for shot in recording.shots if first <= shot.frame <= last and choice.keeps(shot.frame)]
    if not kept:
        raise InputError("pictures", expected=f"some in the {last - first + 1} frames that have poses", got="none")
    seen = list(dict.fromkeys(shot.camera for shot in kept))
    if all(shot.split is not None for shot in kept):
        refuse_cameras(choice, seen, "the pictures' splits are given")
        return kept
    moving = len({shot.frame for shot in kept}) == len(kept)  # one picture a moment: a single, maybe moving camera
    camera = choice.train_camera or kept[0].camera
    if camera not in seen:
        known = " or ".join(seen[:8])
        raise InputError("--train-camera", expected=f"one with pictures in range: {known}", got=camera)
    if moving:
        why = "there is one picture a moment: the first 4/5 train, the rest are novel poses"
        refuse_cameras(choice, seen, why)
    train = [shot.frame for shot in kept if moving or shot.camera == camera]
    border = sorted(train)[max(0, round(TRAIN_SHARE * len(train)) - 1)] if len(train) > 1 else train[0]
    frames = {frame: k for k, frame in enumerate(sorted({shot.frame for shot in kept}))}
    result = []
    for shot in kept:
        early = shot.frame <= border
        if moving or shot.camera == camera:
            result.append(replace(shot, split="train" if early else "novel_pose"))
        elif frames[shot.frame] % choice.held_out_every == 0:
            result.append(replace(shot, split="novel_view" if early else "novel_pose"))
    return result


def refuse_cameras(choice: Choice, seen: Sequence[str], why: str) -> None:
    """Refuse what ``choice`` says of several cameras where it would change nothing, and say ``why``.

    To name the only one of the cameras ``seen`` is to say nothing.
    """
    said = replace(choice, train_camera=None) if [choice.train_camera] == list(seen) else choice
    refuse_changed(said, ("train_camera", "held_out_every"), why)


def write_capture(
    folder: Path,
    recording: Recording,
    scene: Scene,
    shots: Sequence[Shot],
    on_shot: Callable[[int, int], None] = lambda done, total: None,
    *,
    normal_axes: Floats | None = None,
) -> None:
    """Write ``shots`` of a straightened ``recording``, placed as ``scene``, as a capture into ``folder``.

    ``normal_axes`` [3, 3] is how the user's normals were turned, from where
    ``checking.check.check_capture`` reasons.
    """
    output_folder(folder)
    first = int(recording.poses.frames[0])
    frames = []
    for done, shot in enumerate(shots):
        frames.append(_write_shot(folder, shot, scene.cameras[shot.camera], shot.frame - first))
        on_shot(done + 1, len(shots))
    used = {name: scene.cameras[name] for name in dict.fromkeys(frame.camera for frame in frames)}
    undone = {name: list(lens.undone) for name in used if any((lens := recording.lenses[name]).undone)}
    information = {"kind": recording.kind, "notes": scene.notes, "distortion": undone, "turn": scene.turn.tolist()}
    if normal_axes is not None:
        information["normal_axes"] = normal_axes.tolist()
    capture = Capture(folder, used, {}, scene.body, scene.motion, tuple(frames))
    save_capture(capture, **{"import": information})


def _write_shot(folder: Path, shot: Shot, camera: Camera, frame: int) -> Frame:
    name = f"{shot.camera}_{shot.frame:06d}.png".replace(" ", "_").replace("/", "_")
    try:
        if shot.mask is None:
            raise InputError("mask", expected="one for every picture", got="none")
        image, mask = fitting(shot.image(), camera, "image"), fitting(shot.mask(), camera, "mask")
        normals = None if shot.normals is None else fitting(shot.normals(), camera, "normals")
    except InputError as error:
        raise error.at(frame=shot.frame) from error
    light = _TO_LINEAR[image] * (mask[..., None] / 255.0)  # half a pixel on black is half its light
    write_image(folder / "images" / name, to_bytes(linear_to_srgb(light)))
    write_image(folder / "masks" / name, mask)
    if normals is not None:
        length = np.linalg.norm(normals, axis=-1, keepdims=True)
        known = (length > 0.1) & (mask[..., None] > 0)
        unit = normals / np.where(known, length, 1)
        write_image(folder / "normals" / name, np.where(known, to_bytes((unit + 1) / 2), 0).astype(np.uint8))
    assert shot.split is not None
    return Frame(
        f"images/{name}",
        f"masks/{name}",
        shot.camera,
        frame,
        shot.split,
        normal=None if normals is None else f"normals/{name}",
    )


def _by_name(poses: Poses, body: Body) -> Floats:
    """Rotations [F, J, 3, 3] in the body's joint order; joints that the poses lack stay at rest."""
    rotations = np.tile(np.eye(3), (len(poses.frames), len(body.skeleton), 1, 1))
    columns = {name: k for k, name in enumerate(poses.joint_names)}
    matched = 0
    for joint, name in enumerate(body.skeleton.names):
        column = 0 if joint == 0 else columns.get(name)
        if column is not None:
            rotations[:, joint] = poses.rotations[:, column]
            matched += 1
    if matched < 2:
        raise InputError(
            "joints of the body",
            expected=f"some of {', '.join(poses.joint_names[:4])}, …",
            got=", ".join(body.skeleton.names[:4]),
        )
    return rotations


def _upright(root: Floats, up: str | None, notes: list[str]) -> Floats:
    """The rotation [3, 3] that brings the source's up to Y; None: where the pelvises ``root`` [F, 3, 3] point it."""
    if up is not None:
        direction = np.array(UPS[up], np.float64)
    else:
        mean = root[:, :, 1].mean(0)
        mean /= max(float(np.linalg.norm(mean)), 1e-9)
        axis = int(np.abs(mean).argmax())
        if abs(mean[axis]) >= SNAP:
            direction = np.zeros(3)
            direction[axis] = np.sign(mean[axis])
            name = ("-" if mean[axis] < 0 else "") + "xyz"[axis]
            notes.append(f"{name} of the source taken for up, as the person stands along it")
        else:
            direction = mean
            notes.append("the source's world is tilted: turned so that the person stands along Y on average")
    target = np.array([0.0, 1.0, 0.0])
    if direction @ target < -1 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    v = np.cross(direction, target)
    cross = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    turn: Floats = np.eye(3) + cross + cross @ cross / (1 + direction @ target)
    return turn


def _filled(
    frames: NDArray[np.int64], rotations: Floats, translations: Floats, body: Body, fps: float, notes: list[str]
) -> Motion:
    """A pose for every frame from the first to the last, slerped where the source has none."""
    missing = int(frames[-1]) - int(frames[0]) + 1 - len(frames)
    if missing > MOST_FILLED:
        raise InputError(
            "frames of the poses",
            expected=f"at most {MOST_FILLED} left out",
            got=f"{missing} between {frames[0]} and {frames[-1]}",
        )
    wanted = np.arange(frames[0], frames[-1] + 1)
    after = np.minimum(np.searchsorted(frames, wanted, side="right"), len(frames) - 1)
    before = np.maximum(np.searchsorted(frames, wanted, side="right") - 1, 0)
    span = np.maximum(frames[after] - frames[before], 1)
    t = ((wanted - frames[before]) / span)[:, None]
    turned = slerp_matrices(rotations[before], rotations[after], t)
    moved = (1 - t) * translations[before] + t * translations[after]
    if missing:
        notes.append(f"{missing} of {len(wanted)} poses lie between given ones")
    return Motion(turned, moved, fps, body.skeleton.names)
