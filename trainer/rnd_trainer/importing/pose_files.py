"""Body poses of a video from the programs that estimate them, told apart by their keys and shapes."""

from __future__ import annotations

import tempfile
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rnd_runtime.errors import InputError
from rnd_runtime.npz import Npz
from rnd_runtime.rotations import matrix_to_axis_angle
from rnd_runtime.unpickle import read_pickle

from .pictures import listed, read_json
from .recording import Floats, Poses, easymocap_poses, smpl_poses

Focal = Callable[[int, int], float]

_PHALP_FOCAL = 5000.0
_ROMP_HALF_ANGLE = np.radians(30.0)


@dataclass(frozen=True, eq=False)
class FoundPoses:
    """What a file of body poses says.

    Attributes:
        kind: the program that wrote it.
        poses: in the camera's frame for programs that look at a video; in the world for EasyMocap's.
        K: [3, 3] intrinsics where the file has them.
        focal: what the program assumed, as a function of width and height; None where it says nothing.
        fps: where the file has it.
        notes: what had to be assumed.
    """

    kind: str
    poses: Poses
    K: Floats | None = None
    focal: Focal | None = None
    fps: float | None = None
    notes: tuple[str, ...] = ()


def read_poses(path: Path, *, person: int | None = None, convention: str | None = None) -> FoundPoses:
    """Read the body poses of one person.

    ==============================================  =============================  ============================
    file                                            told by                        in the camera's frame by
    ==============================================  =============================  ============================
    WHAM ``wham_output.pkl`` (joblib)               person → pose, trans,          pose, trans; focal √(w² + h²)
                                                    frame_ids
    GVHMR ``hmr4d_results.pt``                      smpl_params_incam              itself; K_fullimg (SMPL-X)
    PHALP / 4D-Humans ``*.pkl`` (joblib)            picture → smpl, camera, tid    camera; focal 5000
    ROMP ``*.npz`` of a video, or a folder of them  smpl_thetas, cam_trans         cam_trans; field of view 60°
    EasyMocap folder of JSON, ``motion.npz``        Rh, Th, poses, shapes          (its own world)
    SMPL ``.npz``                                   poses | thetas | global_orient trans | transl
                                                    and body_pose
    ==============================================  =============================  ============================

    Args:
        person: track or person number; the one with most frames when None.
        convention: "easymocap" or "smpl" to read an .npz's root so, whatever its keys suggest.
    """
    if path.is_dir():
        files = listed(path, (".json", ".npz"))
        return _easymocap_folder(files, person) if files[0].suffix == ".json" else _romp(files)
    if path.suffix.lower() == ".npz":
        with Npz(path, what="body poses") as archive:
            names = archive.names
        return _romp([path]) if "results" in names or "smpl_thetas" in names else _npz(path, convention)
    content = read_pickle(path, what="body poses")
    if isinstance(content, dict):
        try:
            if "smpl_params_incam" in content:
                return _gvhmr(content)
            values = [value for value in content.values() if isinstance(value, dict)]
            if values and all("frame_ids" in value and "pose" in value for value in values):
                return _wham(content, person)
            if values and all("smpl" in value and "camera" in value for value in values):
                return _phalp(content, person)
        except InputError as error:
            raise error.at(file=path) from error
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise InputError(
                "body poses", expected="the layout its keys promise", got=repr(error), file=path
            ) from error
    keys = ", ".join(map(str, list(content)[:6])) if isinstance(content, dict) else type(content).__name__
    raise InputError(
        "body poses", expected="WHAM's, GVHMR's, PHALP's, ROMP's or EasyMocap's", got=keys, file=path
    )


def _wham(content: dict[Any, Any], person: int | None) -> FoundPoses:
    chosen = _one_of({key: len(value["frame_ids"]) for key, value in content.items()}, person)
    entry = content[chosen]
    frames = np.asarray(entry["frame_ids"], np.int64)
    order = np.unique(frames, return_index=True)[1]
    pose, trans, betas = (np.asarray(entry[key], np.float64)[order] for key in ("pose", "trans", "betas"))
    poses = smpl_poses(frames[order], pose, trans, betas)
    return FoundPoses("WHAM", poses, focal=lambda w, h: float(np.hypot(w, h)), notes=_others(content, chosen))


def _gvhmr(content: dict[str, Any]) -> FoundPoses:
    entry = content["smpl_params_incam"]
    body, root, trans = (
        np.asarray(entry[key], np.float64) for key in ("body_pose", "global_orient", "transl")
    )
    angles = np.concatenate([root.reshape(-1, 3), body.reshape(len(body), -1)[:, :63]], 1)
    K = np.asarray(content["K_fullimg"], np.float64).reshape(-1, 3, 3)[0] if "K_fullimg" in content else None
    poses = smpl_poses(range(len(angles)), angles, trans.reshape(-1, 3), entry["betas"], family="SMPL-X")
    return FoundPoses("GVHMR", poses, K=K)


def _phalp(content: dict[str, Any], person: int | None) -> FoundPoses:
    moments = sorted(content.values(), key=lambda value: int(value.get("time", 0)))
    counts: dict[Any, int] = {}
    for moment in moments:
        for track in moment["tid"]:
            counts[int(track)] = counts.get(int(track), 0) + 1
    chosen = _one_of(counts, person)
    frames, angles, trans, betas = [], [], [], []
    for number, moment in enumerate(moments):
        tracks = [int(track) for track in moment["tid"]]
        if chosen not in tracks or tracks.index(chosen) >= len(moment["smpl"]):
            continue
        place = tracks.index(chosen)
        smpl = moment["smpl"][place]
        matrices = np.concatenate(
            [np.asarray(smpl[key], np.float64).reshape(-1, 3, 3) for key in ("global_orient", "body_pose")]
        )
        frames.append(int(moment.get("time", number)))
        angles.append(matrix_to_axis_angle(matrices))
        trans.append(np.asarray(moment["camera"][place], np.float64).reshape(3))
        betas.append(np.asarray(smpl["betas"], np.float64).reshape(-1))
    poses = smpl_poses(frames, np.stack(angles), np.stack(trans), np.stack(betas))
    notes = ("frames are those of PHALP's picture list", *_others(counts, chosen))
    return FoundPoses("4D-Humans / PHALP", poses, focal=lambda w, h: _PHALP_FOCAL, notes=notes)


def _romp(files: Sequence[Path]) -> FoundPoses:
    rows: list[tuple[int, dict[str, Any]]] = []
    for number, file in enumerate(files):
        content = _romp_content(file)
        if "smpl_thetas" in content:
            rows.append((_trailing_number(file.stem, number), content))
        else:  # a video's results: picture name → result
            rows += [(k, content[name]) for k, name in enumerate(sorted(content)) if content[name]]
    kept = [(k, row) for k, row in rows if len(np.atleast_2d(row["smpl_thetas"]))]
    if not kept:
        raise InputError(
            "ROMP results", expected="smpl_thetas of at least one frame", got="none", file=files[0]
        )
    thetas, trans, betas = (
        np.stack([np.atleast_2d(np.asarray(row[key], np.float64))[0] for _, row in kept])
        for key in ("smpl_thetas", "cam_trans", "smpl_betas")
    )
    poses = smpl_poses([k for k, _ in kept], thetas, trans, betas[:, :10])
    several = any(len(np.atleast_2d(row["smpl_thetas"])) > 1 for _, row in kept)
    notes = ("ROMP saw several people in a frame: its first is taken",) if several else ()
    return FoundPoses(
        "ROMP", poses, focal=lambda w, h: 0.5 * max(w, h) / float(np.tan(_ROMP_HALF_ANGLE)), notes=notes
    )


def _romp_content(file: Path) -> dict[str, Any]:
    """ROMP saves a dict as one array of Python objects, or its members."""
    with Npz(file, what="ROMP results") as archive:
        if "results" not in archive.names:
            return {key: archive.numbers(key) for key in ("smpl_thetas", "cam_trans", "smpl_betas")}
    with zipfile.ZipFile(file) as members, tempfile.TemporaryDirectory() as folder:
        content = read_pickle(members.extract("results.npy", folder), what="ROMP results")
    if not isinstance(content, dict):
        raise InputError("ROMP results", expected="a dict", got=type(content).__name__, file=file)
    return content


def _easymocap_folder(files: Sequence[Path], person: int | None) -> FoundPoses:
    records = {}
    for number, file in enumerate(files):
        content = read_json(file)
        people = content.get("annots", []) if isinstance(content, dict) else content
        records[_trailing_number(file.stem, number)] = {int(entry.get("id", 0)): entry for entry in people}
    counts: dict[int, int] = {}
    for people in records.values():
        for key in people:
            counts[key] = counts.get(key, 0) + 1
    chosen = _one_of(counts, person)
    kept = {frame: people[chosen] for frame, people in sorted(records.items()) if chosen in people}
    try:
        poses, Rh, Th, shapes = (
            np.stack([np.asarray(entry[key], np.float64).reshape(-1) for entry in kept.values()])
            for key in ("poses", "Rh", "Th", "shapes")
        )
    except (KeyError, ValueError) as error:
        raise InputError(
            "EasyMocap fits", expected="Rh, Th, poses, shapes", got=repr(error), file=files[0].parent
        ) from error
    found = easymocap_poses(list(kept), _with_root(poses), Rh, Th, shapes)
    return FoundPoses("EasyMocap", found, notes=_others(counts, chosen))


def _npz(path: Path, convention: str | None) -> FoundPoses:
    with Npz(path, what="body poses") as archive:
        member = archive.first_of("poses", "thetas", "poses_all", "pose", "body_pose", "pose_body")
        if member is None:
            raise InputError(
                "body poses", expected="poses, thetas or body_pose", got=", ".join(archive.names), file=path
            )
        poses = archive.numbers(member)
        poses = poses.reshape(len(poses), -1)
        root = archive.first_of("global_orient", "root_orient")
        if member in ("body_pose", "pose_body") and root is not None:
            poses = np.concatenate([archive.numbers(root).reshape(-1, 3), poses], 1)
        poses = _with_root(poses)
        betas_name = archive.first_of("shapes", "betas")
        betas = None if betas_name is None else archive.numbers(betas_name)
        rate = archive.first_of("mocap_framerate", "mocap_frame_rate", "fps")
        fps = None if rate is None else float(archive.numbers(rate).reshape(-1)[0])
        turn, shift = archive.first_of("Rh", "Rh_all"), archive.first_of("Th", "Th_all", "trans", "transl")
        trans = np.zeros((len(poses), 3)) if shift is None else archive.numbers(shift).reshape(-1, 3)
        Rh = None if turn is None else archive.numbers(turn).reshape(-1, 3)
    notes = () if shift is not None else ("no trans in the file: the root stays at its rest place",)
    frames = range(len(poses))
    family = "SMPL-X" if poses.shape[1] == 165 else "SMPL"
    if convention == "easymocap" or (convention is None and Rh is not None):
        if Rh is None:
            Rh = poses[:, :3].copy()
            poses[:, :3] = 0
        found = easymocap_poses(frames, poses, Rh, trans, betas, family=family)
        return FoundPoses("EasyMocap's Rh and Th", found, fps=fps, notes=notes)
    if Rh is not None:
        poses[:, :3] = Rh
    return FoundPoses("SMPL", smpl_poses(frames, poses, trans, betas, family=family), fps=fps, notes=notes)


def _with_root(poses: Floats) -> Floats:
    """Poses [F, 3J] with a zero root before those that leave it out (69, 63 columns)."""
    if poses.shape[1] in (63, 69):
        return np.concatenate([np.zeros((len(poses), 3)), poses], 1)
    return poses


def _one_of(counts: dict[Any, int], person: int | None) -> Any:
    if not counts:
        raise InputError("people", expected="at least one", got="none")
    if person is None:
        return max(counts, key=lambda key: counts[key])
    found = next((key for key in counts if int(key) == person), None)
    if found is None:
        raise InputError("--person", expected=" or ".join(str(key) for key in counts), got=person)
    return found


def _others(counts: dict[Any, Any], chosen: Any) -> tuple[str, ...]:
    if len(counts) < 2:
        return ()
    return (f"{len(counts)} people in the file: number {chosen} taken, --person chooses another",)


def _trailing_number(stem: str, otherwise: int) -> int:
    digits = stem[len(stem.rstrip("0123456789")) :]
    return int(digits) if digits else otherwise
