"""Body models: SMPL, SMPL-H, SMPL-X, ``body.npz`` and Anny."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.capture.body import Body
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import npz_output, refuse_input
from rnd_runtime.core.npz import Npz
from rnd_runtime.motion.readers.unpickle import read_pickle
from rnd_runtime.motion.skeleton import Skeleton
from rnd_runtime.motion.smpl import SMPL_NAMES, SMPLH_NAMES, SMPLX_NAMES

from .anny_body import anny_body

Floats = NDArray[np.float64]

SMPL_LICENSE = "the licence of the body model it was made from; SMPL's forbids passing its shape on"
_FAMILIES = {24: ("SMPL", SMPL_NAMES), 52: ("SMPL-H", SMPLH_NAMES), 55: ("SMPL-X", SMPLX_NAMES)}
_MEMBERS = ("v_template", "f", "weights", "kintree_table", "J_regressor", "shapedirs")
_SMPLX_SHAPES = {20: 10, 400: 300}
"""columns of SMPL-X's shapedirs (v1.0, v1.1) → number of shape parameters; the rest are expressions"""
_NO_PARENT = 2**32 - 1  # SMPL's files hold the root's parent, −1, as an unsigned integer


@dataclass(frozen=True, eq=False)
class BodyModel:
    """A body whose shape depends on ``betas``."""

    family: str  # "SMPL", "SMPL-H", "SMPL-X", or without shape parameters "Anny" or "template"
    template: Body  # for betas 0
    shape_dirs: Floats  # [V, 3, B] m per unit of each beta; B may be 0
    joint_regressor: Floats | None = None  # [J, V], joints from shaped vertices

    def shaped(self, betas: Floats | None = None) -> Body:
        """The body for ``betas`` [≤ B] in its rest pose: v = T + S β, joints = 𝒥 v.

        Raises:
            InputError: non-zero betas beyond the model's.
        """
        if betas is None or self.joint_regressor is None:
            return self.template
        betas = np.asarray(betas, np.float64).reshape(-1)
        count = self.shape_dirs.shape[2]
        if betas[count:].any():
            raise InputError("betas", expected=f"at most {count} for this {self.family} file", got=len(betas))
        used = betas[:count]
        vertices = self.template.vertices + self.shape_dirs[:, :, : len(used)] @ used
        old = self.template.skeleton
        skeleton = Skeleton(old.names, old.parents, self.joint_regressor @ vertices)
        return Body(vertices, self.template.faces, self.template.skinning_weights, skeleton, self.template.license)


def load_body_model(path: str | Path) -> BodyModel:
    """Read a body model, recognised by its members and shapes.

    ============================  =================================================================
    file                          model
    ============================  =================================================================
    ``.npz`` with ``vertices``    ``body.npz``: no shape parameters
    ``.npz``, ``.pkl``            SMPL (24 joints), SMPL-H (52), SMPL-X (55) as published; a pickle
                                  is read without executing anything and without chumpy
    the word ``anny``             Anny's default person, through the package ``anny`` (Apache-2.0)
    ============================  =================================================================
    """
    if str(path) == "anny":
        return BodyModel("Anny", anny_body(), np.zeros((1, 3, 0)))
    path = Path(path)
    if path.suffix.lower() == ".npz":
        with Npz(path, what="body model") as archive:
            if "rest_joints" in archive.names:
                return BodyModel("template", Body.load(path), np.zeros((1, 3, 0)))
            _check_members(archive.names, path)
            members: dict[str, Any] = {name: archive.numbers(name) for name in _MEMBERS}
    else:
        content = read_pickle(path, what="body model")
        if not isinstance(content, dict):
            raise InputError("body model", expected="a dict", got=type(content).__name__, file=path)
        _check_members(tuple(content), path)
        members = {name: content[name] for name in _MEMBERS}
    try:
        return _from_members(members)
    except InputError as error:
        raise error.at(file=path) from error


def convert_body_model(
    model: str | Path, out: str | Path, betas: tuple[float, ...] = (), license: str | None = None
) -> str:
    """Write the body of ``model`` for ``betas`` to ``out`` as ``body.npz``; return its description."""
    refuse_input(npz_output(Path(out)), model)
    loaded = load_body_model(model)
    if betas and loaded.joint_regressor is None:
        given = " ".join(f"{beta:g}" for beta in betas)
        raise InputError("--betas", expected=f"none, as {model} has one shape", got=given)
    body = loaded.shaped(np.array(betas) if betas else None)
    if license is not None:
        body = replace(body, license=license)
    body.save(out)
    size = np.ptp(body.vertices, axis=0).max()
    count = f"{len(body.vertices)} vertices, {len(body.skeleton)} joints, {size:.2f} m"
    return f"{loaded.family}, {count}; licence: {body.license}"


def _check_members(names: tuple[str, ...], path: Path) -> None:
    if any(name not in names for name in _MEMBERS):
        expected = "vertices … rest_joints (ours) or " + ", ".join(_MEMBERS)
        got = ", ".join(map(str, names[:8])) or "nothing"
        raise InputError("body model", expected=expected, got=got, file=path)


def _from_members(members: dict[str, Any]) -> BodyModel:
    arrays: dict[str, Floats] = {}
    for name, value in members.items():
        try:
            arrays[name] = np.asarray(value, np.float64)
        except (TypeError, ValueError) as error:
            raise InputError(name, expected="numbers", got=type(value).__name__) from error
    vertices = arrays["v_template"]
    count, joints = len(vertices), arrays["weights"].shape[-1]
    if joints not in _FAMILIES:
        known = ", ".join(f"{n} ({name})" for n, (name, _) in _FAMILIES.items())
        raise InputError("joints of the body model", expected=known, got=joints)
    family, names = _FAMILIES[joints]
    shapes: dict[str, tuple[int | None, ...]] = {
        "v_template": (count, 3),
        "weights": (count, joints),
        "J_regressor": (joints, count),
        "kintree_table": (2, joints),
        "shapedirs": (count, 3, None),
        "f": (None, 3),
    }
    for name, array in arrays.items():
        shape = shapes[name]
        if array.ndim != len(shape) or any(want not in (None, got) for want, got in zip(shape, array.shape)):
            expected = "×".join("n" if want is None else str(want) for want in shape)
            raise InputError(f"shape of {name}", expected=expected, got="×".join(map(str, array.shape)))
        if not np.isfinite(array).all():
            raise InputError(name, expected="finite numbers")
    parents = np.where(arrays["kintree_table"][0] >= _NO_PARENT, -1, arrays["kintree_table"][0])
    skeleton = Skeleton(names, parents.astype(np.int32), arrays["J_regressor"] @ vertices)
    weights = arrays["weights"].astype(np.float32)
    body = Body(vertices, arrays["f"].astype(np.int32), weights, skeleton, SMPL_LICENSE)
    columns = arrays["shapedirs"].shape[2]
    shape_dirs = arrays["shapedirs"][..., : _SMPLX_SHAPES.get(columns, columns) if joints == 55 else columns]
    return BodyModel(family, body, shape_dirs, arrays["J_regressor"])
