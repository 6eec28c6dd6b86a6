"""Which channels of an EXR are its colour, and the notes on its colours."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rnd_runtime.core.errors import InputError

REC709 = (0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329)
"""x and y of Rec.709's red, green, blue and white (ITU-R BT.709-6, section 1)"""
_SAME_COLOUR = 2e-3  # by which x and y may miss them: D65 has more digits
_PREFERRED = ("Composite.Combined.", "Composite.")  # Blender's image after its compositor
_RENDERED = ".Combined."  # Blender's pass of all light


def colour_channels(names: tuple[str, ...], path: str | Path) -> tuple[list[int], tuple[str, ...]]:
    """Indices of red, green and blue among channel ``names``, and notes.

    Those of no layer; else of Blender's compositor; else of the only layer that has all three ("view.R"), or the only
    one of Blender's combined pass. Luminance alone ("Y") is all three. Lowercase r, g and b count too.

    Raises:
        InputError: none or several.
    """
    found = {
        layer: [names.index(layer + channel) for channel in letters]
        for letters in ("RGB", "rgb")
        for layer in dict.fromkeys(name[:-1] for name in names if name.split(".")[-1] == letters[0])
        if {layer + channel for channel in letters} <= set(names)
    }
    combined = [layer for layer in found if layer.endswith(_RENDERED)]
    alone = [*found] if len(found) == 1 else combined if len(combined) == 1 else []
    if chosen := next((layer for layer in ("", *_PREFERRED, *alone) if layer in found), None):
        others = [layer.rstrip(".") for layer in found if layer not in ("", chosen)]
        note = f"of the light's layers {chosen.rstrip('.')} is taken; left out: {', '.join(others)}"
        return found[chosen], (note,) * bool(others)
    if "" in found:
        return found[""], ()
    luminance = [name for name in names if name.split(".")[-1] == "Y"]
    if {"RY", "BY"} & {name.split(".")[-1] for name in names}:
        raise InputError("light probe", expected="R, G and B", got="luminance and chroma (Y, RY, BY)", file=path)
    if {"X", "Y", "Z"} <= set(names):
        raise InputError("light probe", expected="R, G and B", got="CIE XYZ (X, Y, Z)", file=path)
    if not found and len(luminance) == 1:
        return [names.index(luminance[0])] * 3, ("the light has luminance alone: it is taken as grey",)
    expected = "channels R, G and B" + (" of one layer" if found else "")
    raise InputError("light probe", expected=expected, got=", ".join(names), file=path)


def colour_notes(chromaticities: tuple[float, ...] | None) -> tuple[str, ...]:
    """A note on primaries other than Rec.709's: x, y of red, green, blue and white."""
    if chromaticities is None or np.allclose(chromaticities, REC709, rtol=0, atol=_SAME_COLOUR):
        return ()
    red, green, blue, white = (f"({x:.4g}, {y:.4g})" for x, y in zip(chromaticities[::2], chromaticities[1::2]))
    stated = f"red {red}, green {green}, blue {blue} and white {white}"
    return (f"the light is taken as Rec.709, but its file states {stated}",)
