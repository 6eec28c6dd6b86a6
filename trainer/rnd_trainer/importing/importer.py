"""Import of a source as a capture."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from rnd_runtime.cli.lock import folder_lock
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
    video,
    zju,
)
from rnd_trainer.importing.surfaces.estimate import add_albedos, add_masks, add_normals
from rnd_trainer.importing.surfaces.files import attach_files

from .body_models import BodyModel, load_body_model
from .dataset import ImportedDataset, undistort_dataset
from .options import ImportOptions, OnProgress, no_progress
from .pose_files import PROGRAMS, read_poses
from .poses import with_convention
from .scene import PlacedScene, place_scene
from .select import refuse_cameras, select_samples
from .write import write_capture

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
"""modules with ``detect`` and ``read``, in order of detection: specific layouts first"""
_COEFFICIENTS = (0, 4, 5, 8, 12, 14)
"""possible numbers of OpenCV's distortion coefficients"""
_FILES_OR_NETWORK = (("masks", "mask_net"), ("normals", "normal_net"), ("albedos", "albedo_net"))
_EXTERNAL_POSES = ("video", "nerfstudio", "easymocap")


def find_layout(source: Path, name: str | None = None) -> tuple[str, str]:
    """Layout and description of ``source``; ``name`` forces the layout.

    Raises:
        InputError: no known layout, or not ``name``.
    """
    if not source.exists():
        raise InputError("source not found", file=source)
    if (source / "capture.json").is_file():
        raise InputError("a capture already", file=source, hint="rnd-train takes it as it is")
    if name is not None and name not in LAYOUTS:
        raise InputError("--as", expected=" or ".join(LAYOUTS), got=name)
    for layout in LAYOUTS if name is None else [name]:
        if source.is_dir() or layout in ("video", "nerfstudio"):
            found = LAYOUTS[layout].detect(source)
            if found is not None:
                return layout, found
    if name is not None:
        raise InputError("layout", expected=f"{name}: {_requirements(name)}", got="none of it", file=source)
    known, hint = "none of " + ", ".join(LAYOUTS), "docs/own-video.md lists what each one needs"
    raise InputError("source", expected="a known layout", got=known, file=source, hint=hint)


def _requirements(layout: str) -> str:
    return str(LAYOUTS[layout].detect.__doc__).strip().rstrip(".")


def import_source(
    source: Path,
    out: Path,
    options: ImportOptions,
    *,
    on_progress: OnProgress = no_progress,
    on_found: Callable[[str], None] = lambda sentence: None,
) -> PlacedScene:
    """Turn ``source`` into a capture in the folder ``out``.

    Args:
        on_progress: called with (phase, done, total).
        on_found: called with the layout, then with a summary of the content.

    Raises:
        InputError: with file and frame.
    """
    check_numbers(options)
    layout, found = find_layout(source, options.layout)
    on_found(f"{layout}: {found}")
    refuse_occupied(out, source, options)
    refuse_unwritable(out)
    if options.body is None:
        raise InputError("--body", expected="SMPL, SMPL-H or SMPL-X (.npz, .pkl), a body.npz, or anny", got="none")
    _refuse_unused(layout, options)
    model = load_body_model(options.body)
    try:
        dataset = _read(layout, source, model, options, on_progress)
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        got = f"{type(error).__name__}: {error}"
        raise InputError(f"{layout} cannot be read", expected=_requirements(layout), got=got, file=source) from error
    if options.root is not None:
        dataset = replace(dataset, poses=with_convention(dataset.poses, options.root))
    on_found(_summary(dataset))
    dataset = undistort_dataset(attach_files(dataset, options))
    if options.fps is not None:
        dataset = replace(dataset, fps=options.fps)
    scene = place_scene(dataset, model, options.up)
    samples = select_samples(dataset, options.selection)
    samples = add_masks(samples, scene, dataset, options.mask_net, on_progress)
    samples, axes = add_normals(samples, scene, dataset, options)
    samples = add_albedos(samples, options.albedo_net)
    with folder_lock(output_folder(out), "rnd-data import"):
        refuse_occupied(out, source, options)  # by another import meanwhile
        write_capture(out, dataset, scene, samples, on_progress, normal_axes=axes)
    return scene


def _read(
    layout: str, source: Path, model: BodyModel, options: ImportOptions, on_progress: OnProgress
) -> ImportedDataset:
    if layout == "video":
        if options.poses is None:
            raise InputError("--poses", expected=f"a file of {PROGRAMS}, or an SMPL .npz", got="none")
        return video.read(source, model, read_poses(options.poses, person=options.person), options, on_progress)
    more = {"poses": options.poses, "person": options.person} if layout in _EXTERNAL_POSES else {}
    dataset: ImportedDataset = LAYOUTS[layout].read(source, **more)
    return dataset


def _summary(dataset: ImportedDataset) -> str:
    lens = next(iter(dataset.lenses.values()))
    distorted = any(any(lens.distortion) for lens in dataset.lenses.values())
    size = f"{lens.camera.width} x {lens.camera.height}" + (", distorted lenses" if distorted else "")
    root = {"smpl": "SMPL's root", "easymocap": "EasyMocap's root", "position": "pelvis positions"}
    poses, count, images = dataset.poses, len(dataset.lenses), len(dataset.samples)
    return (
        f"{dataset.kind}: {images} image{'s' * (images != 1)} of {count} camera{'s' * (count > 1)}, {size}; "
        f"{len(poses.frames)} poses ({len(poses.joint_names)} joints, {root[poses.convention]})"
    )


def refuse_occupied(out: Path, source: Path, options: ImportOptions) -> None:
    """Refuse a folder ``out`` with files that a capture would replace or mix with."""
    if out.resolve() == source.resolve():
        raise InputError("OUT", expected="another folder than the source", got=out)
    for name in ("capture.json", "motion.npz", "body.npz"):
        if (out / name).exists():
            what = "holds a capture already" if name == "capture.json" else f"holds a {name}"
            raise InputError(what, file=out, hint="choose another folder")
    inputs = {"the source": source, **{flag(name): getattr(options, name) for name in ("masks", "normals", "albedos")}}
    for name in ("images", "masks", "normals", "albedo_estimates"):
        folder = out / name
        for what, given in inputs.items():
            if given is not None and folder.resolve() == given.resolve():
                raise InputError("OUT", expected=f"another folder than that of {what}", got=out)
        if folder.is_file() or (folder.is_dir() and any(folder.iterdir())):
            raise InputError(f"holds {name} already", file=out, hint="choose another folder, or remove them")


def refuse_unwritable(out: Path) -> None:
    """Refuse a folder ``out`` that cannot be created or written; leaves no new folder behind."""
    missing = [folder for folder in (out, *out.parents) if not folder.exists()]
    output_folder(out)
    for folder in missing:
        with contextlib.suppress(OSError):  # another program's file in it
            folder.rmdir()


def check_numbers(options: ImportOptions) -> None:
    selection = options.selection
    for name, value in (
        ("--every", selection.every),
        ("--held-out-every", selection.held_out_every),
        ("--count", options.count),
    ):
        check_option(value >= 1, name, "at least 1", value)
    stop = math.inf if selection.stop is None else selection.stop
    check_option(stop > selection.start, "--stop", f"more than --start {selection.start}", selection.stop)
    coefficients = options.distortion
    good = len(coefficients) in _COEFFICIENTS and all(map(math.isfinite, coefficients))
    check_option(good, "--distortion", "k1 k2 p1 p2 [k3 …], as OpenCV has them", " ".join(map(str, coefficients)))
    refuse_outside(options, {"fps": FPS_LIMITS})


def _refuse_unused(layout: str, options: ImportOptions) -> None:
    """Refuse options without effect."""
    for one, other in _FILES_OR_NETWORK:
        if getattr(options, one) and getattr(options, other):
            raise InputError(f"{flag(one)} and {flag(other)}", expected="one of them", got="both")
    unused = [] if layout == "video" else ["intrinsics", "distortion"]
    unused += [] if layout in _EXTERNAL_POSES else ["poses", "person"]
    for name in unused:
        if (given := getattr(options, name)) not in (None, ()):
            raise InputError(flag(name), expected=f"none, as {layout} has its own", got=given)
    if layout == "video":
        refuse_cameras(options.selection, [video.CAMERA], "a video has one camera, and its last 1/5 are novel poses")
    else:
        why = f"of a video the sharpest images are chosen; of {layout}, --every keeps fewer"
        refuse_changed(options, ["count"], why)
