"""The stage's lights: nineteen LED modules around the person, each a spherical Gaussian."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.errors import InputError
from rnd_runtime.shading.files.load import load_light
from rnd_runtime.shading.light import Light, downsize, texel_directions

Floats = NDArray[np.float64]

SHARPNESS = 14.0  # λ of exp(λ(μ·d − 1)): half the peak at 18°
AMBIENT = 0.02  # ambient radiance over a module's peak
MAP_HEIGHT = 64  # rows of the written maps
EXPOSURE = 0.75  # mean radiance of the strongest channel
WHITE = "white"
_MAX_ROWS = 256  # of a given HDR

# elevation in degrees and number of evenly spaced modules, the first at azimuth 90° (+Z, in front of the person)
RINGS = ((90.0, 1), (45.0, 6), (5.0, 8), (-35.0, 4))

RED, GREEN, BLUE = (1.0, 0.05, 0.03), (0.06, 0.9, 0.12), (0.05, 0.12, 1.0)
AMBER, CYAN, MAGENTA = (1.0, 0.55, 0.12), (0.05, 0.75, 0.95), (0.95, 0.08, 0.7)
COOL, DARK = (0.45, 0.6, 1.0), (0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class StageLight:
    """A named light: the map of its file [H, 2H, 3], and the factor to radiance."""

    name: str
    file_radiance: NDArray[np.float32]
    scale: float

    @cached_property
    def radiance(self) -> Floats:
        """[H, 2H, 3]; always the same array, by which ``RenderSet`` identifies lights."""
        return self.file_radiance.astype(np.float64) * self.scale


def module_directions() -> Floats:
    """Unit vectors [19, 3] from the person to the modules, by rings from the top."""
    result = []
    for elevation, count in RINGS:
        azimuth = np.pi / 2 + 2 * np.pi * np.arange(count) / count
        e = np.radians(elevation)
        result.append(
            np.stack([np.cos(e) * np.cos(azimuth), np.full(count, np.sin(e)), np.cos(e) * np.sin(azimuth)], axis=1)
        )
    return np.concatenate(result)


def coloured() -> dict[str, Floats]:
    """Amplitudes [19, 3] of the eight coloured lights."""
    d = module_directions()
    front, left, up = d[:, 2], d[:, 0], d[:, 1]  # +X is the person's left
    hue = np.arctan2(front, left)

    def where(choice: NDArray[np.bool_], yes: tuple[float, ...], no: tuple[float, ...]) -> Floats:
        return np.where(choice[:, None], yes, no)

    wheel = np.stack([0.5 + 0.5 * np.cos(hue - shift) for shift in (0, 2 * np.pi / 3, 4 * np.pi / 3)], axis=1)
    return {
        "red": where(left > -0.2, RED, (0.12, 0.01, 0.01)),
        "green": where(left < 0.2, GREEN, (0.01, 0.10, 0.02)),
        "blue": where(up > 0.05, BLUE, (0.01, 0.02, 0.15)),
        "sunset": where(left > 0.3, AMBER, (0.10, 0.12, 0.30)),
        "split": where(left > 0, CYAN, MAGENTA) * (0.25 + 0.75 * np.abs(left))[:, None],
        "rainbow": wheel**2,
        "rim": where(front < -0.1, COOL, (0.10, 0.08, 0.06)),
        "footlight": where(up < -0.1, AMBER, DARK) + where(up > 0.9, (0.25, 0.1, 0.6), DARK),
    }


def spherical_gaussians(amplitudes: Floats, height: int = MAP_HEIGHT) -> NDArray[np.float32]:
    """The lat-long map [height, 2·height, 3] of the modules' Gaussians, ``amplitudes`` [19, 3], plus ambient light."""
    directions = texel_directions(height, 2 * height)
    lobes = np.exp(SHARPNESS * (directions @ module_directions().T - 1))
    return (lobes @ amplitudes + AMBIENT).astype(np.float32)


def stage_lights(hdr_files: tuple[Path, ...] = ()) -> list[StageLight]:
    """White, the eight coloured lights, and each of ``hdr_files`` by its stem, all of mean radiance ``EXPOSURE``."""
    amplitudes = {WHITE: np.ones((len(module_directions()), 3)), **coloured()}
    lights = [_exposed(name, spherical_gaussians(values)) for name, values in amplitudes.items()]
    for path in hdr_files:
        if path.stem in {light.name for light in lights}:
            raise InputError("light", expected="a name of its own", got=path.stem, file=path)
        light = load_light(path)
        if light.maximum <= 0:
            raise InputError("light", expected="some radiance", got="black", file=path)
        rows = min(_MAX_ROWS, light.radiance.shape[0])
        lights.append(_exposed(path.stem, downsize(light.radiance, rows, 2 * rows)))
    return lights


def _exposed(name: str, radiance: NDArray[np.float32]) -> StageLight:
    return StageLight(name, radiance, float(EXPOSURE / Light(radiance).mean_radiance.max()))
