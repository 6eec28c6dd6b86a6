"""Writes ``src/constants.js``, what the web player shares with Python: ``python viewer/web/constants.py``.

Run it after a change of any constant below; a test holds the file against Python's.
"""

from __future__ import annotations

import json
from base64 import b64encode
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from rnd_runtime.shading.specular_lobe import lobe_table

FILE = Path(__file__).parent / "src/constants.js"
# Names by module; private ones lose their underscore in JavaScript.
SHARED = {
    "rnd_runtime.core.images": "NEUTRAL_OFFSET NEUTRAL_START NEUTRAL_DESATURATION",
    "rnd_runtime.avatar.file": (
        "SCHEMA METADATA_KEY ADVICE_KEY PROBE_SHAPE POSED_OUTPUTS CONSTANT_OUTPUTS"
        " NODE_OUTPUTS NODE_LOGITS REST_OUTPUTS"
    ),
    "rnd_runtime.motion.smpl": "NAMES_BY_COUNT SMPL_REST_ROOT SMPLX_REST_ROOT",
    "rnd_runtime.motion.readers.arrays": (
        "_ORTHOGONAL _AMASS_MEMBERS _MAX_ANGLE _MANY_BEYOND_A_TURN _MAX_DISTANCE _MAX_HEIGHT _MAX_SPEED _ORDERS"
        " _TIMES _FPS_OF_TIMES _UNEVEN _DEFAULT_FPS FPS_LIMITS"
    ),
    "rnd_runtime.motion.motion": "STAND_INS",
    "rnd_runtime.motion.standing": "UP_ROTATIONS _UNCLEAR _CLEAR _LEG _LIES _STANDS _SHARE",
    "rnd_runtime.motion.skeleton": "_TURNS",
    "rnd_runtime.motion.interpolation": "LARGEST_STEP LARGEST_MOVE",
    "rnd_runtime.posing.forearm": "FREE MAX_SHARE",
    "rnd_runtime.posing.skinning": "SHORTEST TWIST_STEPS SMALLEST_SQUARE",
    "rnd_runtime.posing.rest": "_DEEPEST",
    "rnd_runtime.posing.levels": (
        "KEPT CULLED_LEVELS PARTNER_WINDOW MIN_COSINE PARTNER_REACH COLOUR_WEIGHT GROWTH MIN_GAUSSIANS"
        " _CURVE_BITS _NOWHERE"
    ),
    "rnd_runtime.playback.scene": "LEVEL_SPACING NODE_SPACING",
    "rnd_runtime.shading.sh": "SH_COUNT SH_DEGREES COSINE_LOBE _C0 _C1 _C2_SIDE _C2_ZONAL _C3_3 _C3_2 _C3_1 _C3_0",
    "rnd_runtime.shading.files.channels": "REC709 _SAME_COLOUR",
    "rnd_runtime.shading.files.radiance": "_MAX_EXPOSURE",
    "rnd_runtime.shading.light": "REC709_LUMINANCE _DIM _COARSE",
    "rnd_runtime.shading.brdf": "F0 ROUGHNESS_RANGE COSINE_FLOOR LARGEST_ALBEDO",
    "rnd_runtime.shading.specular_lobe": "LOBE_WIDTHS ROUGHNESS_COUNT COSINE_COUNT",
    "rnd_runtime.shading.lookup": "DIFFUSE_SIZE SPECULAR_SIZE",
    "rnd_runtime.shading.sum": "HALF_FLOOR _CUT_TEXELS",
    "rnd_runtime.shading.directional": "_CAP _RING _RING_AREA _LARGEST _MIN_SHARE _MAX_PEAKS _LAMP",
    "rnd_runtime.shading.shader": "SHADOW_RESOLUTION DISC_SIGMAS CASTING_OPACITY",
    "rnd_runtime.shading.shadow": "DEPTH_BIAS CLEARANCE_TEXELS DROP RIM_TEXELS EDGE_ON SOFTNESS SLOPE_FLOOR",
    "rnd_runtime.shading.direct": "TURNED_AWAY AT_SILHOUETTE",
    "rnd_runtime.raster.oracle": "NEAR DILATION ALPHA_MIN ALPHA_MAX TRANSMITTANCE_MIN FIELD_OF_VIEW_MARGIN",
    "rnd_runtime.raster.project": "HALF_LOG2_E LOG2_ALPHA_MIN",
    "rnd_runtime.raster.tiles": "RADIX_BITS",
    "rnd_runtime.playback.aov": "MIN_COVERAGE",
    "rnd_runtime.playback.far": "MIN_PIXELS_PER_METRE MAX_FACTOR MARGIN",
    "rnd_runtime.playback.framing": "PADDING ELEVATION FIELD_OF_VIEW",
    "rnd_runtime.ground.standing": "FRAMES STANDING",
    "rnd_runtime.ground.stand_in": "MAX_DISCS GROWN LARGEST_DISC SINK BANDS",
    "rnd_runtime.ground.sky": "CELL REACH CELLS _SLICE _MAX_SLICES _GAP",
    "rnd_runtime.ground.shadow": "SKY_DIRECTIONS SUN_CELLS SUN_CELL SUN_REACH MIN_ELEVATION BOX",
    "rnd_viewer.view.scene": "CLAY LARGEST_SKY",
}


def source() -> str:
    """The text of ``src/constants.js``."""
    lines = ["// Written by viewer/web/constants.py from Python's constants; not to be edited.", ""]
    for module, names in SHARED.items():
        lines.append(f"// {module}")
        lines += [f"export const {name.lstrip('_')} = {_value(module, name)};" for name in names.split()]
    table = b64encode(np.ascontiguousarray(lobe_table(), "<f4").tobytes()).decode()
    lines += ["// float32 [ROUGHNESS_COUNT·COSINE_COUNT·7] of rnd_runtime.shading.specular_lobe.make_table"]
    return "\n".join([*lines, f'export const LOBE_TABLE = "{table}";', ""])


def _value(module: str, name: str) -> str:
    value: Any = getattr(import_module(module), name)
    return json.dumps(value, default=lambda numbers: numbers.tolist())


if __name__ == "__main__":
    FILE.write_text(source(), encoding="utf-8")
