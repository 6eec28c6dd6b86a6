"""From whatever a user has to a capture: find out what it is, read it, fill in what is missing, write it."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from rnd_runtime.core.errors import InputError, check_option, flag, refuse_changed, refuse_outside
from rnd_runtime.core.files import output_folder
from rnd_runtime.motion.readers.arrays import FPS_LIMITS
from rnd_trainer.importing.layouts import (
    arah,
    easymocap,
    humannerf,
    instant_avatar,
    intrinsic_avatar,
    nerfstudio,
    neuman,
    rana,
    snapshot,
    zju,
)
from rnd_trainer.importing.surfaces.estimate import attached, with_masks, with_normals

from . import video
from .body_models import BodyModel, load_body_model
from .options import ImportOptions
from .pose_files import read_poses
from .recording import Recording, RootConvention, read_as, straightened
from .write import Scene, chosen_shots, placed, refuse_cameras, write_capture

LAYOUTS: dict[str, Any] = {
    "zju": zju,
    "arah": arah,
    "humannerf": humannerf,
    "snapshot": snapshot,
    "instant-avatar": instant_avatar,
    "intrinsic-avatar": intrinsic_avatar,
    "rana": rana,
    "neuman": neuman,
    "nerfstudio": nerfstudio,
    "easymocap": easymocap,
    "video": video,
}
"""modules with ``detect`` and ``read``, the particular before the general: a folder of pictures may be anything"""
_CONVENTIONS: dict[str, RootConvention] = {"smpl": "smpl", "easymocap": "easymocap"}
_COEFFICIENTS = (0, 4, 5, 8, 12, 14)
"""numbers that OpenCV takes as a lens's distortion"""
_POSES_FROM_ELSEWHERE = ("video", "nerfstudio", "easymocap")


def find_layout(source: Path, name: str | None = None) -> tuple[str, str]:
    """(layout, what was found) of ``source``; ``name`` forces the layout.

    Raises:
        InputError: nothing known is there, or not what ``name`` says.
    """
    if not source.exists():
        raise InputError("source not found", file=source)
    if (source / "capture.json").is_file():
        raise InputError("a capture already", file=source, hint="rnd-train takes it as it is")
    if name in LAYOUTS:
        found = _detect(name, source)
        if found is None and name == "easymocap":  # then it says how the poses' root is meant
            return find_layout(source)
        if found is None:
            raise InputError("layout", expected=f"{name}: {_needs(name)}", got="none of it", file=source)
        return name, found
    if name not in (None, "smpl"):
        raise InputError("--as", expected=" or ".join([*LAYOUTS, "smpl"]), got=name)
    for layout in LAYOUTS:
        found = _detect(layout, source)
        if found is not None:
            return layout, found
    raise InputError(
        "source",
        expected="a known layout",
        got="none of " + ", ".join(LAYOUTS),
        file=source,
        hint="docs/own-video.md lists what each one needs",
    )


def _said(name: str | None) -> tuple[str | None, RootConvention | None]:
    """(layout, root convention) of ``--as``: one of them, or both with a comma between."""
    layout, comma, root = (name or "").partition(",")
    if comma and (layout not in LAYOUTS or root not in _CONVENTIONS):
        raise InputError("--as", expected="a layout, a comma and smpl or easymocap", got=name)
    return layout or None, _CONVENTIONS.get(root or layout)


def _detect(layout: str, source: Path) -> str | None:
    found: str | None = LAYOUTS[layout].detect(source) if source.is_dir() or layout in ("video", "nerfstudio") else None
    return found


def _needs(layout: str) -> str:
    return str(LAYOUTS[layout].detect.__doc__).rstrip(".")


def import_source(
    source: Path,
    out: Path,
    options: ImportOptions,
    *,
    on_shot: Callable[[int, int], None] = lambda done, total: None,
    on_found: Callable[[str], None] = lambda sentence: None,
) -> Scene:
    """Turn ``source`` into a capture in the folder ``out``.

    Args:
        on_shot: called with (pictures written, pictures in all).
        on_found: called with what the source was found to be, then with what it holds.

    Raises:
        InputError: with the file and, where there is one, the frame.
    """
    _check_numbers(options)
    name, convention = _said(options.layout)
    layout, found = find_layout(source, name)
    on_found(f"{layout}: {found}")
    _refuse_full(out, source, options)
    _refuse_unmakeable(out)
    if options.body is None:
        raise InputError("--body", expected="SMPL, SMPL-H or SMPL-X (.npz, .pkl), a body.npz, or anny", got="none")
    _refuse_unused(layout, options)
    model = load_body_model(options.body)
    try:
        recording = _read(layout, source, model, options)
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        got = f"{type(error).__name__}: {error}"
        raise InputError(f"{layout} cannot be read", expected=_needs(layout), got=got, file=source) from error
    if convention is not None:
        recording = replace(recording, poses=read_as(recording.poses, convention))
    on_found(_contents(recording))
    recording = straightened(attached(recording, options.masks, options.normals))
    if options.fps is not None:
        recording = replace(recording, fps=options.fps)
    scene = placed(recording, model, options.up)
    shots = chosen_shots(recording, options.choice)
    shots = with_masks(shots, scene, recording, options.mask_net)
    shots, axes = with_normals(
        shots, scene, recording, net=options.normal_net, axes=options.normal_axes, found=options.normals is not None
    )
    write_capture(out, recording, scene, shots, on_shot, normal_axes=axes)
    return scene


def _refuse_full(out: Path, source: Path, options: ImportOptions) -> None:
    """Refuse a folder ``out`` with files whose place a capture's would take, or among which they would stand."""
    if out.resolve() == source.resolve():
        raise InputError("OUT", expected="another folder than the source", got=out)
    for name in ("capture.json", "motion.npz", "body.npz"):
        if (out / name).exists():
            what = "holds a capture already" if name == "capture.json" else f"holds a {name}"
            raise InputError(what, file=out, hint="choose another folder")
    given = {"the source": source, "--masks": options.masks, "--normals": options.normals}
    for name in ("images", "masks", "normals"):
        place = out / name
        for what, folder in given.items():
            if folder is not None and place.resolve() == folder.resolve():
                raise InputError("OUT", expected=f"another folder than that of {what}", got=out)
        if place.is_file() or (place.is_dir() and any(place.iterdir())):
            raise InputError(f"holds {name} already", file=out, hint="choose another folder, or remove them")


def _refuse_unmakeable(out: Path) -> None:
    """Refuse a folder ``out`` that cannot be made or written, before what takes long; made to try, it is removed."""
    missing = [place for place in (out, *out.parents) if not place.exists()]
    output_folder(out)
    for place in missing:
        with contextlib.suppress(OSError):  # somebody else put a file there
            place.rmdir()


def _check_numbers(options: ImportOptions) -> None:
    choice = options.choice
    check_option(choice.every >= 1, "--every", "at least 1", choice.every)
    check_option(choice.held_out_every >= 1, "--held-out-every", "at least 1", choice.held_out_every)
    check_option(options.count >= 1, "--count", "at least 1", options.count)
    stop = math.inf if choice.stop is None else choice.stop
    check_option(stop > choice.start, "--stop", f"more than --start {choice.start}", choice.stop)
    check_option(
        len(options.distortion) in _COEFFICIENTS and all(map(math.isfinite, options.distortion)),
        "--distortion",
        "k1 k2 p1 p2 [k3 …], as OpenCV has them",
        " ".join(map(str, options.distortion)),
    )
    refuse_outside(options, {"fps": FPS_LIMITS})


def _refuse_unused(layout: str, options: ImportOptions) -> None:
    """What is given and would change nothing is a misunderstanding."""
    if options.masks and options.mask_net:
        raise InputError("--masks and --mask-net", expected="one of them", got="both")
    if options.normals and options.normal_net:
        raise InputError("--normals and --normal-net", expected="one of them", got="both")
    for name, used in (
        ("poses", layout in _POSES_FROM_ELSEWHERE),
        ("person", layout in _POSES_FROM_ELSEWHERE),
        ("intrinsics", layout == "video"),
        ("distortion", layout == "video"),
    ):
        given = getattr(options, name)
        if not used and given is not None and given != ():
            raise InputError(flag(name), expected=f"none, as {layout} has its own", got=given)
    if layout == "video":
        why = "a video has one camera, and its last 1/5 are novel poses"
        refuse_cameras(options.choice, [video.CAMERA], why)
    else:
        why = f"of a video the sharpest pictures are chosen; of {layout}, --every keeps fewer"
        refuse_changed(options, ["count"], why)


def _contents(recording: Recording) -> str:
    """What a source was found to hold, in a sentence."""
    lens = next(iter(recording.lenses.values()))
    bent = any(any(lens.distortion) for lens in recording.lenses.values())
    size = f"{lens.camera.width} x {lens.camera.height}" + (", lenses bend" if bent else "")
    convention = {"smpl": "SMPL's root", "easymocap": "EasyMocap's root", "placed": "the pelvis's place"}
    poses = recording.poses
    count = len(recording.lenses)
    return (
        f"{recording.kind}: {len(recording.shots)} pictures of {count} camera{'s' * (count > 1)}, {size}; "
        f"{len(poses.frames)} poses ({len(poses.joint_names)} joints, {convention[poses.convention]})"
    )


def _read(layout: str, source: Path, model: BodyModel, options: ImportOptions) -> Recording:
    if layout == "video":
        if options.poses is None:
            raise InputError("--poses", expected="a file from WHAM, GVHMR, 4D-Humans, ROMP or EasyMocap", got="none")
        poses = read_poses(options.poses, person=options.person)
        return video.read(
            source,
            model,
            poses,
            intrinsics=options.intrinsics,
            distortion=options.distortion,
            count=options.count,
            fps=options.fps,
            choice=options.choice,
        )
    if layout == "nerfstudio":
        return nerfstudio.read(source, poses=options.poses, person=options.person)
    if layout == "easymocap":
        return easymocap.read(source, poses=options.poses, person=options.person)
    recording: Recording = LAYOUTS[layout].read(source)
    return recording
