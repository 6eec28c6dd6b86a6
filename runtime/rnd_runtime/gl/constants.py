"""Numeric constants of Python's kernels as GLSL macros."""

from __future__ import annotations

from functools import cache
from math import pi
from typing import Any

from rnd_runtime.posing import skinning
from rnd_runtime.raster import oracle, project
from rnd_runtime.shading import brdf, direct, lanes, lookup, sh, shader, shadow, specular_lobe
from rnd_runtime.shading import sum as light_sum

_SH = ("_C0", "_C1", "_C2_SIDE", "_C2_ZONAL", "_C3_3", "_C3_2", "_C3_1", "_C3_0")


@cache
def shared_constants() -> dict[str, str]:
    """GLSL text of each constant by name."""
    values: dict[str, Any] = {
        "ONE_OVER_PI": 1 / pi,
        "F0": brdf.F0,
        "COSINE_FLOOR": brdf.COSINE_FLOOR,
        "ROUGHNESS_LOW": brdf.ROUGHNESS_RANGE[0],
        "ROUGHNESS_HIGH": brdf.ROUGHNESS_RANGE[1],
        "TINY": lanes.TINY,
        "HALF_FLOOR": light_sum.HALF_FLOOR,
        "SMALLEST_SQUARE": skinning.SMALLEST_SQUARE,
        "SHORTEST": skinning.SHORTEST,
        "TWIST_STEPS": skinning.TWIST_STEPS,
        "NEAR": oracle.NEAR,
        "DILATION": oracle.DILATION,
        "ALPHA_MIN": oracle.ALPHA_MIN,
        "ALPHA_MAX": oracle.ALPHA_MAX,
        "LOG2_ALPHA_MIN": project.LOG2_ALPHA_MIN,
        "HALF_LOG2_E": project.HALF_LOG2_E,
        "LOBE_ROWS": specular_lobe.ROUGHNESS_COUNT,
        "LOBE_COLUMNS": specular_lobe.COSINE_COUNT,
        "LEVELS": len(specular_lobe.LOBE_WIDTHS),
        "DIFFUSE_SIZE": lookup.DIFFUSE_SIZE,
        "SPECULAR_SIZE": lookup.SPECULAR_SIZE,
        "MAP_SIZE": shader.SHADOW_RESOLUTION,
        "CASTING_OPACITY": shader.CASTING_OPACITY,
        "DISC_SIGMAS": shader.DISC_SIGMAS,
        "TURNED_AWAY": direct.TURNED_AWAY,
        "AT_SILHOUETTE": direct.AT_SILHOUETTE,
    }
    values |= {f"SH{name}": getattr(sh, name) for name in _SH}
    for name in ("DEPTH_BIAS", "CLEARANCE_TEXELS", "DROP", "EDGE_ON", "RIM_TEXELS", "SLOPE_FLOOR", "SOFTNESS"):
        values[name] = getattr(shadow, name)
    macros = {name: str(value) if isinstance(value, int) else f"({float(value)!r})" for name, value in values.items()}
    cosine = ", ".join(str(float(sh.COSINE_LOBE[degree * degree])) for degree in range(sh.SH_DEGREE + 1))
    return macros | {"COSINE_LOBE": f"vec4({cosine})"}
