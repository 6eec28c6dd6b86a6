"""Materials of the stage, as Mitsuba's dictionaries with vertex attributes.

The layered material is that of ``rnd_runtime.shading.brdf``, formulated independently: Lambert plus GGX with
F0 = 0.04, with exact Fresnel equations instead of Schlick's term. Mitsuba blends two materials, so both are divided by
their share. The other is Mitsuba's own principled material (Burley 2012), whose diffuse part reflects more at grazing
angles where it is rough, and less where it is smooth.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

Material = Literal["layered", "principled"]
SPECULAR_SHARE = 0.3  # of the blend and of the sampled directions; any share gives the same mean


def material_of(name: Material, colour: Floats, roughness: Floats) -> tuple[dict[str, Any], dict[str, Floats]]:
    """The two-sided material and its attributes, of ``colour`` [V, 3] linear and perceptual ``roughness`` [V]."""
    material, attributes = (_principled if name == "principled" else _layered)(colour, roughness)
    return {"type": "twosided", "sides": material}, attributes


def _layered(colour: Floats, roughness: Floats) -> tuple[dict[str, Any], dict[str, Floats]]:
    """Lambert plus GGX."""
    alpha, gain = _attribute("alpha"), _attribute("gain")
    specular = {"type": "roughconductor", "distribution": "ggx", "alpha": alpha, "eta": 1.5, "k": 0.0}
    specular["specular_reflectance"] = gain
    diffuse = {"type": "diffuse", "reflectance": _attribute("color")}
    blend = {"type": "blendbsdf", "weight": SPECULAR_SHARE, "first": diffuse, "second": specular}
    attributes = {
        "vertex_color": colour / (1 - SPECULAR_SHARE),
        "vertex_alpha": roughness[:, None] ** 2,
        "vertex_gain": np.full((len(colour), 1), 1 / SPECULAR_SHARE),
    }
    return blend, attributes


def _principled(colour: Floats, roughness: Floats) -> tuple[dict[str, Any], dict[str, Floats]]:
    """With F0 = 0.04."""
    own = {"type": "principled", "base_color": _attribute("color"), "roughness": _attribute("rough"), "specular": 0.5}
    attributes = {"vertex_color": colour, "vertex_rough": roughness[:, None]}
    return own, attributes


def _attribute(name: str) -> dict[str, Any]:
    return {"type": "mesh_attribute", "name": f"vertex_{name}"}
