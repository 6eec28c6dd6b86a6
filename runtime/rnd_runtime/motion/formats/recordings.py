"""Any motion file as what it holds: poses of a body model, a recorded skeleton, or joint positions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from zipfile import is_zipfile

import numpy as np

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import existing_file, is_folder
from rnd_runtime.core.npz import Members, Npz
from rnd_runtime.motion.readers.arrays import MotionRecord, read_arrays
from rnd_runtime.motion.readers.asf_amc import read_amc
from rnd_runtime.motion.readers.pickles import described, track_of, track_of_folder
from rnd_runtime.motion.readers.tracks import Track, is_slahmr, slahmr
from rnd_runtime.motion.readers.tree import MocapTree
from rnd_runtime.motion.readers.video_fits import easymocap_files

from .gltf import SUFFIXES as GLTF
from .gltf import read_gltf
from .rigs import MHR127, Rig
from .sam3d import is_sam3d, is_sam3d_folder, read_folder, read_sam3d, sam3d_files
from .soma import gemx, is_gemx, is_kimodo, is_somax, kimodo, somax
from .vectors import JointPaths, is_mdm_result, is_named_vector, mdm_result, named_vector, read_vector

_PICKLES = (".pkl", ".pickle", ".joblib", ".pt", ".pth", ".npy")
_KNOWN = (".bvh", ".amc", ".npz", *GLTF, *_PICKLES)
_BLENDER = "import it into Blender and export the armature as .bvh or .glb"
_MARKERS = "markers are no skeleton: solve them to one first (Vicon, OptiTrack, OpenSim), and export that as .bvh"
_ELSEWHERE = {
    ".fbx": _BLENDER,
    ".dae": _BLENDER,
    **dict.fromkeys((".usd", ".usda", ".usdc", ".usdz"), _BLENDER),
    ".mvnx": "MVN Analyze exports the same recording as .bvh",
    ".c3d": _MARKERS,
    ".trc": _MARKERS,
    ".mot": "OpenSim's angles are of its own joints: export the bodies' motion as .bvh",
    ".vmd": "import it with its model into Blender (MMD Tools) and export the armature as .bvh",
}
"""What helps with files that are not read"""


@dataclass(frozen=True, eq=False)
class Recording:
    """A recorded skeleton.

    Attributes:
        tree: it and its motion.
        matched: index of its joints by SMPL's names, where its layout gives them; else names decide.
    """

    tree: MocapTree
    matched: Mapping[str, int] | None = None


def read_recording(
    path: str | Path, joint_names: tuple[str, ...] | None = None
) -> MotionRecord | Recording | JointPaths:
    """Read a motion file or folder of any known format.

    Args:
        joint_names: the joints of the columns, for arrays without names (a capture's motion).

    Raises:
        InputError: another format, or a damaged file.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    try:
        if is_folder(path):
            return _folder(path)
        if suffix in _ELSEWHERE or (suffix not in _KNOWN and not is_zipfile(existing_file(path, what="motion"))):
            expected, got = "a .bvh, .glb, .npz or another documented motion", f"a {suffix or 'nameless'} file"
            raise InputError("motion", expected=expected, got=got, file=path, hint=_ELSEWHERE.get(suffix))
        if suffix == ".bvh":
            from rnd_runtime.motion.readers.bvh import read_bvh  # here and below: most runs read arrays

            return Recording(read_bvh(path))
        if suffix == ".amc":
            return Recording(read_amc(path))
        if suffix in GLTF:
            return Recording(*read_gltf(path))
        if suffix in _PICKLES:
            from rnd_runtime.motion.readers.unpickle import read_pickle

            return _pickle(read_pickle(path, what="motion"), path, joint_names)
        with Npz(path, what="motion") as archive:
            return _archive(archive, joint_names)
    except (ValueError, TypeError, KeyError, IndexError, AttributeError, OverflowError) as error:
        got = f"arrays that do not fit together ({error})"
        raise InputError("motion", expected="poses over time", got=got, file=path) from error


def folder_files(path: Path) -> list[Path]:
    """The files of a folder that ``read_recording`` reads."""
    return sam3d_files(path) if is_sam3d_folder(path) else easymocap_files(path)


def _folder(path: Path) -> MotionRecord | Recording:
    if is_sam3d_folder(path):
        return _sam3d(read_folder(path), path)
    return _record(track_of_folder(path), None)


def _pickle(content: Any, path: Path, joint_names: tuple[str, ...] | None) -> MotionRecord | Recording | JointPaths:
    if isinstance(content, np.ndarray):
        return _vector(read_vector(content, path), joint_names)
    if is_sam3d(content):
        return _sam3d(content, path)
    if not isinstance(content, Mapping) or not content:
        raise InputError("motion", expected="a dict of arrays", got=described(content), file=path)
    if is_gemx(content):
        return _rigged(*gemx(content, path))
    if is_mdm_result(content):
        return mdm_result(content, path)
    if is_kimodo(members := Members({str(name): value for name, value in content.items()}, path)):
        return _rigged(*kimodo(members))
    if is_named_vector(members):
        return _vector(named_vector(members), joint_names)
    return _record(track_of(content, path), joint_names)


def _vector(vector: Track | JointPaths, joint_names: tuple[str, ...] | None) -> MotionRecord | JointPaths:
    return vector if isinstance(vector, JointPaths) else _record(vector, joint_names)


def _archive(archive: Npz, joint_names: tuple[str, ...] | None) -> MotionRecord | Recording | JointPaths:
    if is_kimodo(archive):
        return _rigged(*kimodo(archive))
    if is_somax(archive):
        return _rigged(*somax(archive))
    if {"pred_joint_coords", "pred_global_rots", "pred_cam_t"} <= set(archive.names):
        names = ("pred_joint_coords", "pred_global_rots", "pred_cam_t", "focal_length")
        return _sam3d({name: archive.numbers(name) for name in names if name in archive.names}, archive.path)
    if is_slahmr(archive):
        return _record(slahmr(archive, archive.path), joint_names)
    if is_named_vector(archive):
        return _vector(named_vector(archive), joint_names)
    return read_arrays(archive, joint_names)


def _record(track: Track, joint_names: tuple[str, ...] | None) -> MotionRecord:
    return read_arrays(track.members, joint_names, track.rest_root, track.notes, track.up)


def _rigged(tree: MocapTree, rig: Rig) -> Recording:
    return Recording(tree, rig.matched(tree.names))


def _sam3d(content: Any, path: Path) -> Recording:
    return _rigged(read_sam3d(content, path).tree(path), MHR127)
