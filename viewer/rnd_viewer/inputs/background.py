"""What stands behind the avatar, in linear light."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.camera import Camera
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.images import srgb_to_linear
from rnd_runtime.shading.light import Light

Floats32 = NDArray[np.float32]
MOST = float(np.finfo(np.float32).max)
"""radiance that a picture can hold"""
STRIP = 8  # rows sampled at once, so that they stay in the cache: 67 ms instead of 103 at 512²


@dataclass(frozen=True)
class Background:
    """Nothing (transparent), one colour, or the light itself.

    Attributes:
        kind: ``none``, ``colour`` or ``hdr``.
        colour: linear Rec.709, where the kind is ``colour``.
    """

    kind: str = "none"
    colour: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @classmethod
    def parse(cls, text: str) -> Background:
        """``none``, ``hdr``, ``#rrggbb`` (sRGB, as on a web page) or ``r,g,b`` (linear radiance)."""
        if text in ("none", "hdr"):
            return cls(text)
        if re.fullmatch(r"#[0-9a-fA-F]{6}", text):
            srgb = np.array([int(text[i : i + 2], 16) for i in (1, 3, 5)]) / 255
            red, green, blue = srgb_to_linear(srgb).tolist()
            return cls("colour", (red, green, blue))
        try:
            red, green, blue = (float(channel) for channel in text.split(","))
        except ValueError:
            red = green = blue = np.nan
        if not all(0 <= channel <= MOST for channel in (red, green, blue)):  # false for NaN
            raise InputError("--background", expected="none, hdr, #rrggbb or r,g,b", got=text)
        return cls("colour", (red, green, blue))

    def radiance(self, camera: Camera, light: Light) -> Floats32:
        """Linear radiance behind every pixel of ``camera``: [H, W, 3] or, for one colour, [3]."""
        if self.kind != "hdr":
            return np.array(self.colour, np.float32)
        x, y, z = np.linalg.inv(camera.K).T @ camera.world_to_camera[:3, :3]  # the world's share of each pixel axis
        columns = (np.arange(camera.width) + 0.5)[:, None] * x
        rows = (np.arange(camera.height) + 0.5)[:, None, None] * y + z
        behind = np.empty((camera.height, camera.width, 3), np.float32)
        for top in range(0, camera.height, STRIP):
            behind[top : top + STRIP] = light.sample(rows[top : top + STRIP] + columns)
        return behind
