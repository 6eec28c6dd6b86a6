"""Splats as files: 3DGS's PLY and glTF with KHR_gaussian_splatting; SPZ and SOG through ``splat-transform``."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import atomic_path
from rnd_runtime.core.gaussians import Gaussians
from rnd_runtime.core.images import srgb_to_linear
from rnd_runtime.playback.aov import ambient_visibility

from .glb import FLOAT, GlbBuilder
from .splats import SH_0, Coding, Splats

# order of the 3DGS writer, with all 45 higher coefficients: some readers count bytes
PLY_FIELDS = (
    *("x", "y", "z", "nx", "ny", "nz"),
    *(f"f_dc_{k}" for k in range(3)),
    *(f"f_rest_{k}" for k in range(45)),
    *("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
)
MATERIAL_FIELDS = ("albedo_0", "albedo_1", "albedo_2", "roughness", "ambient_visibility")
MAX_OPACITY = 1 - 1e-6  # the logit of 1 is infinite
KHR = "KHR_gaussian_splatting"
KHR_SPACES = {"srgb": "srgb_rec709_display", "linear": "lin_rec709_display"}
TRANSFORM = "splat-transform"
INSTALL = "npm install -g @playcanvas/splat-transform"


def write_ply(path: Path, splats: Splats, material: Gaussians | None = None) -> None:
    """Binary little-endian PLY with 3DGS's 62 floats: log scales, logit opacities, quaternions wxyz.

    ``f_rest`` holds R's fifteen coefficients, then G's, then B's. Normals are the surface's. ``material`` adds
    ``MATERIAL_FIELDS`` after them: linear Rec.709 albedo, perceptual roughness, and the visible share of the sky.
    """
    opacities = np.clip(splats.opacities, 1 - MAX_OPACITY, MAX_OPACITY)
    columns: tuple[NDArray[np.floating], ...] = (
        splats.means,
        splats.normals,
        splats.sh[:, 0],
        np.swapaxes(splats.sh[:, 1:], 1, 2).reshape(len(splats.means), -1),
        np.log(opacities / (1 - opacities))[:, None],
        np.log(splats.scales),
        splats.quaternions,
    )
    fields = PLY_FIELDS
    if material is not None:
        columns += (material.albedo, material.roughness[:, None], ambient_visibility(material)[:, None])
        fields += MATERIAL_FIELDS
    rows = np.concatenate(columns, axis=1).astype("<f4")
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    header += [f"property float {name}" for name in fields] + ["end_header", ""]
    with atomic_path(path) as temporary:
        temporary.write_bytes("\n".join(header).encode() + rows.tobytes())


def write_splat_glb(path: Path, splats: Splats, coding: Coding) -> None:
    """glTF binary of one KHR_gaussian_splatting primitive: Y up, quaternions xyzw; zero degrees are left out.

    Viewers without the extension show points with COLOR_0, linear by glTF 2.0 (3.7.2.1).
    """
    glb = GlbBuilder()
    stored = np.clip(0.5 + splats.sh[:, 0] * SH_0, 0, 1)
    colour = srgb_to_linear(stored) if coding == "srgb" else stored
    attributes = {
        "POSITION": glb.accessor(splats.means, "VEC3", FLOAT, bounds=True),
        "COLOR_0": glb.accessor(np.c_[colour, splats.opacities], "VEC4", FLOAT),
        f"{KHR}:ROTATION": glb.accessor(splats.quaternions[:, [1, 2, 3, 0]], "VEC4", FLOAT),
        f"{KHR}:SCALE": glb.accessor(splats.scales, "VEC3", FLOAT),
        f"{KHR}:OPACITY": glb.accessor(splats.opacities, "SCALAR", FLOAT),
    }
    used = [degree for degree in range(1, 4) if splats.sh[:, degree**2 :].any()]
    for degree in range(1 + max(used, default=0)):
        for k in range(2 * degree + 1):
            values = splats.sh[:, degree**2 + k]
            attributes[f"{KHR}:SH_DEGREE_{degree}_COEF_{k}"] = glb.accessor(values, "VEC3", FLOAT)
    extension = {"kernel": "ellipse", "colorSpace": KHR_SPACES[coding]}
    primitive = {"mode": 0, "attributes": attributes, "extensions": {KHR: extension}}
    glb.write(
        path,
        {
            "extensionsUsed": [KHR],
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0}],
            "meshes": [{"primitives": [primitive]}],
        },
    )


def splat_transform() -> str:
    """The path of PlayCanvas' converter; refused with an installation hint if it is missing."""
    program = shutil.which(TRANSFORM)
    if program is None:
        raise InputError(f"spz and sog need {TRANSFORM}, which is not installed", hint=INSTALL)
    return program


def transform_ply(program: str, ply: Path, out: Path) -> None:
    """Write ``out`` (.spz or .sog) from ``ply`` by ``program``."""
    with atomic_path(out) as temporary:
        line = [program, "--overwrite", "--quiet", "--gpu", "cpu", str(ply), str(temporary)]
        done = subprocess.run(line, capture_output=True, text=True, check=False)
        if done.returncode or not temporary.stat().st_size:
            reason = (done.stderr or done.stdout).strip().splitlines() or ["nothing written"]
            raise InputError(f"{TRANSFORM} failed", got=reason[-1], file=out)
