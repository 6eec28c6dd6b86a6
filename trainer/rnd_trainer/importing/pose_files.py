"""Body poses from the output files of pose estimators, recognised by keys and shapes."""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.npz import Npz
from rnd_runtime.core.signals import temporary_folder
from rnd_runtime.motion.formats.sam3d import NEEDED, is_sam3d, is_sam3d_folder, read_folder
from rnd_runtime.motion.formats.soma import is_gemx, is_kimodo
from rnd_runtime.motion.readers.arrays import frame_rate, names_of_joints
from rnd_runtime.motion.readers.tracks import is_prompthmr, is_slahmr
from rnd_runtime.motion.readers.unpickle import read_pickle
from rnd_runtime.motion.readers.video_fits import (
    PHALP_FOCAL,
    VideoFits,
    easymocap_files,
    in_order,
    is_phalp,
    one_of,
    read_easymocap_folder,
    read_phalp,
    trailing_number,
    with_root,
)

from .dataset import Lens
from .images import count_shift, list_files, natural_key, numbers_of
from .poses import PoseFile, Poses, easymocap_poses, rows_of_three, smpl_poses, transformed
from .recorded_poses import gemx_poses, prompthmr_poses, sam3d_poses, several, slahmr_poses, tram_poses

PROGRAMS = "WHAM, GVHMR, 4D-Humans, ROMP, EasyMocap, SAM 3D Body, GEM-X, TRAM, PromptHMR or SLAHMR"
"""whose files are read"""
_ROMP_HALF_ANGLE = np.radians(30.0)


def read_poses(path: Path, *, person: int | None = None) -> PoseFile:
    """Read the body poses of one person.

    ==============================================  =============================  ============================
    file                                            recognised by                  in the camera's frame by
    ==============================================  =============================  ============================
    WHAM ``wham_output.pkl`` (joblib)               person → pose, trans,          pose, trans; focal √(w² + h²)
                                                    frame_ids
    GVHMR ``hmr4d_results.pt``                      smpl_params_incam              itself; K_fullimg (SMPL-X)
    PHALP / 4D-Humans ``*.pkl`` (joblib)            image → smpl, camera, tid      camera; focal 5000 for
                                                                                   256 pixels
    ROMP ``*.npz`` of a video, or a folder of them  smpl_thetas, cam_trans         cam_trans; field of view 60°
    EasyMocap folder of JSON, ``motion.npz``        Rh, Th, poses, shapes          (its own world)
    SAM 3D Body, any of its forms, or a folder      pred_joint_coords,            pred_cam_t; focal_length (MHR,
                                                    pred_global_rots, pred_cam_t   fitted to the body)
    GEM-X ``hpe_results.pt``                        body_params_incam              itself; K_fullimg (SOMA, fitted)
    TRAM ``hps_track_0.npy``                        pred_rotmat, pred_trans        itself; img_focal of camera.npy
    PromptHMR ``results.pkl``                       people → smplx_cam             itself; img_focal (SMPL-X)
    SLAHMR ``*_world_results.npz``                  cam_R, cam_t, trans [P, F, 3]  its cameras; intrins (SMPL-H)
    SMPL ``.npz``                                   poses | thetas | global_orient trans | transl
                                                    and body_pose
    ==============================================  =============================  ============================

    Args:
        person: track or person number. Default: the one with most frames.

    Raises:
        InputError: any other file, or a ``person`` where people have no numbers.
    """
    try:
        if path.is_dir() and is_sam3d_folder(path):
            _refuse_person(person, "SAM 3D Body")
            return sam3d_poses(read_folder(path), path)
        if path.is_dir():
            files = list_files(path, (".json", ".npz"))
            if files[0].suffix == ".json":
                numbered = numbers_of(easymocap_files(path)) is not None
                return replace(_video_fits("EasyMocap", read_easymocap_folder(path, person)), numbered=numbered)
            _refuse_person(person, "ROMP")
            return _romp(files)
        if path.suffix.lower() == ".npz":
            with Npz(path, what="body poses") as archive:
                names = archive.names
                if is_slahmr(archive):
                    return slahmr_poses(archive, path, person)
                _refuse_person(person, path.name)
                if set(NEEDED) <= set(names):
                    return sam3d_poses(
                        {name: archive.numbers(name) for name in (*NEEDED, "focal_length") if name in names}, path
                    )
                if is_kimodo(archive):
                    got = "Kimodo's, a generated motion"
                    raise InputError("body poses", expected="poses of a video", got=got, hint="it goes to --motion")
            return _romp([path]) if "results" in names or "smpl_thetas" in names else _npz(path)
        return _from_pickle(path, person)
    except InputError as error:
        raise error.at(file=path) from error
    except OverflowError as error:
        raise InputError("numbers of frames or people", expected="below 2^63", got="more", file=path) from error


def _from_pickle(path: Path, person: int | None) -> PoseFile:
    content = read_pickle(path, what="body poses")
    if is_sam3d(content):
        _refuse_person(person, "SAM 3D Body")
        return sam3d_poses(content, path)
    if not isinstance(content, dict):
        content = {type(content).__name__: content}
    try:
        if "smpl_params_incam" in content:
            _refuse_person(person, "GVHMR")
            return _gvhmr(content)
        if is_gemx(content):
            _refuse_person(person, "GEM-X")
            return gemx_poses(content, path)
        if {"pred_rotmat", "pred_trans"} <= content.keys():
            _refuse_person(person, "TRAM: each person has a file")
            return tram_poses(content, path)
        if is_prompthmr(content):
            return prompthmr_poses(content, person, path)
        values = [value for value in content.values() if isinstance(value, dict)]
        if values and all("frame_ids" in value and "pose" in value for value in values):
            if not any("trans" in value for value in values):
                got = "VIBE's, TCMR's or MAED's, which give no positions"
                hint = "--motion plays them in place"
                raise InputError("body poses", expected="poses with positions", got=got, hint=hint)
            return _wham(content, person, path)
        if is_phalp(content):
            found = _video_fits("4D-Humans / PHALP", read_phalp(content, path, person))
            notes = ("frames are those of PHALP's image list", *found.notes)
            return replace(found, focal=lambda w, h: PHALP_FOCAL * max(w, h), notes=notes, in_camera=True)
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        raise InputError("body poses", expected="the layout its keys promise", got=repr(error)) from error
    keys = ", ".join(map(str, list(content)[:6]))
    raise InputError("body poses", expected=f"a file of {PROGRAMS}", got=keys)


def pair_with_frames(found: PoseFile, numbers: Sequence[int], source: Path) -> tuple[Poses, tuple[str, ...]]:
    """Poses for the ascending frame ``numbers`` of ``source``, and notes.

    Numbers of pose files may have an offset (``images.count_shift``). Poses without numbers start at the first frame.

    Raises:
        InputError: no frame has a pose.
    """
    poses = found.poses
    begin, first, last = numbers[0], int(poses.frames[0]), int(poses.frames[-1])
    if found.numbered and (shift := count_shift(numbers, poses.frames.tolist())):
        note = f"poses are numbered from {first}, frames from {begin}: taken for the same"
        return replace(poses, frames=poses.frames + shift), (note,)
    if not {*numbers} & {*poses.frames.tolist()}:
        expected = f"some of frames {begin} … {numbers[-1]}"
        raise InputError("body poses", expected=expected, got=f"{first} … {last}", file=source)
    if not found.numbered and last != numbers[-1]:
        return poses, (f"poses end with frame {last}, images with frame {numbers[-1]}: both begin with frame 0",)
    return poses, ()


def poses_in_world(found: PoseFile, lenses: Sequence[Lens], source: Path) -> Poses:
    """Poses in the world of ``lenses``.

    Raises:
        InputError: poses in camera axes for several or moving cameras.
    """
    if not found.in_camera:
        return found.poses
    if len(lenses) > 1:
        got = f"{found.kind}'s, in the camera's, of {len(lenses)} cameras or camera positions"
        raise InputError("body poses", expected="some in the cameras' world", got=got, file=source)
    return transformed(found.poses, np.linalg.inv(lenses[0].camera.world_to_camera).astype(np.float64))


def _refuse_person(person: int | None, of: str) -> None:
    if person is not None:
        raise InputError("--person", expected=f"none, as {of} has no numbers of people", got=person)


def _video_fits(kind: str, fits: VideoFits) -> PoseFile:
    shape, family = fits.betas, fits.family
    if fits.turns is None:
        poses = smpl_poses(fits.frames, fits.axis_angles, fits.translations, shape, family=family)
    else:
        poses = easymocap_poses(fits.frames, fits.axis_angles, fits.turns, fits.translations, shape, family=family)
    return PoseFile(kind, poses, notes=several(fits.person, fits.others))


def _wham(content: dict[Any, Any], person: int | None, path: Path) -> PoseFile:
    tracks = {int(key): entry for key, entry in content.items()}
    chosen, others = one_of([key for key, entry in tracks.items() for _ in entry["frame_ids"]], person, path)
    entry = tracks[chosen]
    frames, members = in_order(entry["frame_ids"], *(entry[key] for key in ("pose", "trans", "betas")))
    notes = several(chosen, others)
    return PoseFile(
        "WHAM", smpl_poses(frames, *members), focal=lambda w, h: float(np.hypot(w, h)), notes=notes, in_camera=True
    )


def _gvhmr(content: dict[str, Any]) -> PoseFile:
    entry = content["smpl_params_incam"]
    body, root, trans = (np.asarray(entry[key], np.float64) for key in ("body_pose", "global_orient", "transl"))
    angles = np.concatenate([root.reshape(-1, 3), body.reshape(len(body), -1)[:, :63]], 1)
    K = np.asarray(content["K_fullimg"], np.float64).reshape(-1, 3, 3)[0] if "K_fullimg" in content else None
    poses = smpl_poses(range(len(angles)), angles, trans.reshape(-1, 3), entry["betas"], family="SMPL-X")
    return PoseFile("GVHMR", poses, K=K, in_camera=True)


def _romp(files: Sequence[Path]) -> PoseFile:
    rows: list[tuple[int, dict[str, Any]]] = []
    video: list[tuple[int, dict[str, Any]]] = []
    singles = []
    for index, file in enumerate(files):
        content = _romp_content(file)
        if "smpl_thetas" in content:
            rows.append((trailing_number(file.stem, index), content))
            singles.append(file)
        else:  # image name → result
            names = sorted(content, key=lambda name: natural_key(str(name)))
            video += [(k, content[name]) for k, name in enumerate(names) if content[name]]
    rows = sorted(rows, key=lambda row: row[0]) or video  # ROMP may write both into one folder
    kept = [(k, row) for k, row in rows if len(np.atleast_2d(row["smpl_thetas"]))]
    if not kept:
        raise InputError("ROMP results", expected="smpl_thetas of at least one frame", got="none", file=files[0])
    thetas, trans, betas = (
        np.stack([np.atleast_2d(np.asarray(row[key], np.float64))[0] for _, row in kept])
        for key in ("smpl_thetas", "cam_trans", "smpl_betas")
    )
    poses = smpl_poses([k for k, _ in kept], thetas, trans, betas[:, :10])
    several = any(len(np.atleast_2d(row["smpl_thetas"])) > 1 for _, row in kept)
    notes = ("ROMP found several people in a frame: the first is taken",) if several else ()
    return PoseFile(
        "ROMP",
        poses,
        focal=lambda w, h: 0.5 * max(w, h) / float(np.tan(_ROMP_HALF_ANGLE)),
        notes=notes,
        numbered=bool(singles) and numbers_of(singles) is not None,
        in_camera=True,
    )


def _romp_content(file: Path) -> dict[str, Any]:
    """Content of a results file; empty for a frame without people."""
    with Npz(file, what="ROMP results") as archive:
        if "results" not in archive.names:
            return {key: archive.numbers(key) for key in ("smpl_thetas", "cam_trans", "smpl_betas")}
    with zipfile.ZipFile(file) as members, temporary_folder() as folder:
        content = read_pickle(members.extract("results.npy", folder), what="ROMP results")
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise InputError("ROMP results", expected="a dict", got=type(content).__name__, file=file)
    return content


def _npz(path: Path) -> PoseFile:
    with Npz(path, what="body poses") as archive:
        member = archive.first_of("poses", "thetas", "poses_all", "pose", "body_pose", "pose_body")
        if member is None:
            raise InputError("body poses", expected="poses, thetas or body_pose", got=", ".join(archive.names))
        poses = archive.numbers(member)
        if poses.ndim < 2 or not poses.size:
            raise InputError(member, expected="a row of numbers a frame", got=list(poses.shape))
        poses = poses.reshape(len(poses), -1)
        root = archive.first_of("global_orient", "root_orient")
        names = None
        if "joint_names" in archive.names:
            names = names_of_joints(archive, poses.shape[1] // 3)
        elif member in ("body_pose", "pose_body") and root is not None:
            poses = np.concatenate([rows_of_three(root, archive.numbers(root), len(poses)), poses], 1)
        else:
            poses = with_root(poses)
        betas_name = archive.first_of("shapes", "betas")
        betas = None if betas_name is None else archive.numbers(betas_name)
        notes = () if betas is None else _gender(archive)
        smplx = _is_smplx(archive) or poses.shape[1] == 165
        fps = frame_rate(archive)
        rotation, shift = archive.first_of("Rh", "Rh_all"), archive.first_of("Th", "Th_all", "trans", "transl")
        Rh, trans = (np.zeros((len(poses), 3)) if name is None else archive.numbers(name) for name in (rotation, shift))
    if shift is None:
        notes += ("no trans in the file: the root stays at its rest position",)
    frames = range(len(poses))
    family = "SMPL-X" if smplx else "SMPL"
    options: dict[str, Any] = {"family": family, "joint_names": names}
    if rotation is not None:
        poses_found = easymocap_poses(frames, poses, Rh, trans, betas, members=(rotation, shift or "trans"), **options)
        return PoseFile("EasyMocap's Rh and Th", poses_found, fps=fps, notes=notes)
    poses_found = smpl_poses(frames, poses, trans, betas, member=shift or "trans", **options)
    return PoseFile("SMPL", poses_found, fps=fps, notes=notes)


def _is_smplx(archive: Npz) -> bool:
    """Whether the file is SMPL-X's, by AMASS' model name or its members."""
    if model := _word(archive, "surface_model_type"):
        return model.startswith("smplx")
    return archive.first_of("jaw_pose", "expression", "left_hand_pose") is not None


def _gender(archive: Npz) -> tuple[str, ...]:
    gender = _word(archive, "gender")
    if gender in ("", "neutral"):
        return ()
    return (f"the shape is meant for the {gender} body model: give that as --body",)


def _word(archive: Npz, name: str) -> str:
    """Text of a member, or empty."""
    try:
        return archive.strings(name)[0]
    except (InputError, IndexError):
        return ""
