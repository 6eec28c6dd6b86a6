"""The background, in linear light."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.camera import Camera
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.images import MAX_RADIANCE, srgb_to_linear
from rnd_runtime.playback.frame import RenderedFrame
from rnd_runtime.shading.light import Light

Floats32 = NDArray[np.float32]
_NAMES = {  # of CSS, sRGB
    "black": "000",
    "white": "fff",
    "red": "f00",
    "lime": "0f0",
    "green": "008000",
    "blue": "00f",
    "yellow": "ff0",
    "cyan": "0ff",
    "magenta": "f0f",
    "orange": "ffa500",
    "purple": "800080",
    "pink": "ffc0cb",
    "brown": "a52a2a",
    "gray": "808080",
    "grey": "808080",
    "silver": "c0c0c0",
    "navy": "000080",
    "teal": "008080",
    "olive": "808000",
    "maroon": "800000",
}


@dataclass(frozen=True)
class Background:
    """None (transparent), one colour, or the light itself.

    Attributes:
        kind: ``none``, ``colour`` or ``hdr``.
        colour: linear Rec.709, where the kind is ``colour``.
    """

    kind: str = "none"
    colour: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @classmethod
    def parse(cls, text: str) -> Background:
        """``none``, ``hdr``, ``#rgb``, ``#rrggbb`` or ``red`` (sRGB, as in CSS), or ``r,g,b`` (linear radiance)."""
        if text in ("none", "hdr"):
            return cls(text)
        code = "#" + _NAMES[text.lower()] if text.lower() in _NAMES else text
        if re.fullmatch(r"#[0-9a-fA-F]{3}", code):
            code = "#" + "".join(2 * digit for digit in code[1:])
        if re.fullmatch(r"#[0-9a-fA-F]{6}", code):
            srgb = np.array([int(code[i : i + 2], 16) for i in (1, 3, 5)]) / 255
            red, green, blue = srgb_to_linear(srgb).tolist()
            return cls("colour", (red, green, blue))
        try:
            red, green, blue = (float(channel) for channel in text.split(","))
        except ValueError:
            red = green = blue = np.nan
        if not all(0 <= channel <= MAX_RADIANCE for channel in (red, green, blue)):  # false for NaN
            raise InputError("--background", expected="none, hdr, #rgb, #rrggbb, a name like red, or r,g,b", got=text)
        return cls("colour", (red, green, blue))

    def radiance(self, camera: Camera, light: Light) -> Floats32:
        """Linear radiance of the background at every pixel of ``camera``: [H, W, 3] or, for one colour, [3]."""
        if self.kind != "hdr":
            return np.array(self.colour, np.float32)
        x, y, z = camera.rays
        columns = (np.arange(camera.width) + 0.5)[:, None] * x
        rows = (np.arange(camera.height) + 0.5)[:, None, None] * y + z
        return light.sample(rows + columns)


class Backdrop:
    """Composites frames over a background; its radiance is cached while camera and light are the same."""

    def __init__(self, background: Background) -> None:
        self.background = background
        self._cached: tuple[Camera, Light, Floats32] | None = None

    def behind(self, frame: RenderedFrame, camera: Camera, light: Light) -> RenderedFrame:
        """``frame`` of ``camera`` under ``light``, over the background."""
        if self.background.kind == "none":
            return frame
        if self._cached is None or self._cached[0] is not camera or self._cached[1] is not light:
            self._cached = camera, light, self.background.radiance(camera, light)
        return replace(frame, background=self._cached[2])
