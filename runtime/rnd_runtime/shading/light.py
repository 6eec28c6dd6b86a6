"""Light probes: lat-long maps of linear radiance, and what keeps their energy right."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rnd_runtime.core.arrays import shallow_copy
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import existing_file
from rnd_runtime.core.images import ImageHeader, read_header, read_image, read_strips
from rnd_runtime.core.kinds import explained
from rnd_runtime.shading.files.channels import colour_channels, colour_notes
from rnd_runtime.shading.files.radiance import as_stored, read_radiance_header

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]
Up = Literal["y", "z", "-y"]

_MAX_STOPS = 64  # beyond it radiance leaves float32
_MAX_ROWS = 2048  # a map of more is averaged down to as many while it is read
_ROWS_AT_ONCE = 16  # rows or columns that are averaged by one product
_LARGEST_HALF = 65504.0
_DIM = 1e-3  # largest radiance below which every 8-bit pixel of a body would be black or next to it

_TO_Y_UP: dict[str, Floats] = {
    "y": np.eye(3),
    "z": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),  # (x, y, z) → (x, z, −y)
    "-y": np.diag([1.0, -1.0, -1.0]),  # OpenCV camera axes
}


@dataclass(frozen=True, eq=False)
class Light:
    """Distant light all around, as a lat-long map.

    Column and row of a direction (x, y, z) **in the light's frame**: ``u = 0.5 + atan2(z, x) / 2π``,
    ``v = acos(y) / π``; texel centres at (i + 0.5) / N. Only ``rotation`` knows how that frame lies in
    the world, so turning a light never touches its texels.

    Attributes:
        radiance: [H, W, 3] linear Rec.709, finite and not negative, W = 2 H.
        yaw: turns the light about +Y, radians: what the map has at azimuth φ = atan2(z, x) appears at
            φ + yaw, so it moves from +X towards +Z.
        up: which axis of the map's frame points up in the world it was made for.
        repaired: texels that had to be filled in when it was read.
        notes: what its file says that was not followed, one sentence each, for the user to see.
    """

    radiance: Floats32
    yaw: float = 0.0
    up: Up = "y"
    repaired: int = 0
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        radiance = np.ascontiguousarray(self.radiance, np.float32)
        if radiance.ndim != 3 or radiance.shape[2] != 3 or radiance.shape[1] != 2 * radiance.shape[0]:
            raise InputError("light", expected="[H, 2H, 3]", got=list(radiance.shape))
        if not np.isfinite(radiance).all() or radiance.min() < 0:
            raise InputError("light", expected="finite radiance, not negative")
        _check_yaw(self.yaw)
        if self.up not in _TO_Y_UP:
            raise InputError("light up", expected=" or ".join(_TO_Y_UP), got=self.up)
        object.__setattr__(self, "radiance", radiance)

    @cached_property
    def rotation(self) -> Floats:
        """[3, 3], light's frame → world."""
        return _rotation(self.yaw, self.up)

    @property
    def maximum(self) -> float:
        """The largest radiance of any channel; a map that cannot light anything shows here."""
        return float(self.radiance.max())

    @property
    def mean_radiance(self) -> Floats:
        """[3], the radiance averaged over the sphere; π times it is the irradiance averaged over normals."""
        height, width = self.radiance.shape[:2]
        weights = texel_solid_angles(height, width) / (4 * np.pi)
        return np.asarray(np.einsum("hwc,hw->c", self.radiance.astype(np.float64), weights))

    def turned(self, yaw: float) -> Light:
        """The same light at another ``yaw``; no texel is looked at, so it may be turned in every frame."""
        _check_yaw(yaw)
        return shallow_copy(self, yaw=yaw, rotation=_rotation(yaw, self.up))

    def resized(self, height: int, width: int) -> Light:
        """The same light on another grid, by ``downsize``."""
        return replace(self, radiance=downsize(self.radiance, height, width))

    def scaled(self, scale: ArrayLike) -> Light:
        """The same light times ``scale``, a number or one per channel."""
        return replace(self, radiance=_finite_float32(self.radiance * np.asarray(scale, np.float64)))

    def sample(self, directions: ArrayLike) -> Floats32:
        """Radiance [..., 3] seen towards world ``directions`` [..., 3], of any length but zero.

        Bilinear between texel centres; wraps around horizontally, clamps at the poles.
        """
        local = np.asarray(directions, np.float64) @ self.rotation  # Rᵀ d
        x, y, z = local[..., 0], local[..., 1], local[..., 2]
        height, width = self.radiance.shape[:2]
        column = (0.5 + np.arctan2(z, x) / (2 * np.pi)) * width - 0.5
        row = np.clip(np.arctan2(np.hypot(x, z), y) / np.pi * height - 0.5, 0, height - 1)
        left, top = np.floor(column).astype(np.int64), np.floor(row).astype(np.int64)
        s, t = (column - left)[..., None], (row - top)[..., None]
        right, bottom = (left + 1) % width, np.minimum(top + 1, height - 1)
        left = left % width
        upper = (1 - s) * self.radiance[top, left] + s * self.radiance[top, right]
        lower = (1 - s) * self.radiance[bottom, left] + s * self.radiance[bottom, right]
        return np.asarray((1 - t) * upper + t * lower, np.float32)


def _rotation(yaw: float, up: Up) -> Floats:
    cosine, sine = math.cos(yaw), math.sin(yaw)
    turn: Floats = np.array([[cosine, 0.0, -sine], [0.0, 1.0, 0.0], [sine, 0.0, cosine]])
    return turn if up == "y" else turn @ _TO_Y_UP[up]


def _check_yaw(yaw: float) -> None:
    if not math.isfinite(yaw):
        raise InputError("light yaw", expected="finite radians", got=yaw)


def load_light(path: str | Path, *, up: Up = "y", yaw: float = 0.0, exposure: float = 0.0) -> Light:
    """Read a lat-long .exr or .hdr as a ``Light``.

    NaN, infinite and negative texels are filled from their neighbours; ``Light.repaired`` counts them. In a HALF map
    +inf is 65 504, the largest HALF number, as a sun that did not fit. A map of more than 2048 rows is averaged to
    2048 × 4096 texels while it is read, weighted by solid angle, so that memory does not grow with it. Pixels of a
    Radiance file are divided by each EXPOSURE that its header states ("Radiance image format", Ward); CIE XYZ becomes
    Rec.709, and rows are ordered as its resolution line says.

    Args:
        up: the axis that points up in the world the map was made for: "y"; "z" for a Z-up world; "-y" for
            camera axes that point down. The map's own layout is always that of ``Light``.
        yaw: radians about +Y.
        exposure: in stops; radiance is multiplied by 2^exposure.

    Raises:
        InputError: unreadable, not 2:1, without channels R, G, B of one layer, or without one valid texel.
    """
    suffix = existing_file(path, what="light probe").suffix.lower()
    if suffix not in (".exr", ".hdr"):
        got = suffix or "no suffix"
        raise explained(InputError("light probe", expected="an .exr or .hdr file", got=got), path, "light")
    if not abs(exposure) <= _MAX_STOPS:
        raise InputError("exposure", expected=f"at most {_MAX_STOPS} stops either way", got=exposure)
    if suffix == ".exr" or not _is_radiance(path):
        radiance, repaired, notes = _read(path, path)
    else:
        stored = read_radiance_header(path)
        with as_stored(path, stored) as copy:
            radiance, repaired, _ = _read(copy, path, across=stored.axes[1] == "X")
        notes = stored.notes + (() if stored.xyz else colour_notes(stored.primaries))
        radiance = stored.upright(radiance if not stored.xyz else stored.rec709(radiance)) / np.float64(stored.exposure)
    radiance = _finite_float32(radiance * 2.0 ** np.float64(exposure))
    return Light(radiance, yaw=yaw, up=up, repaired=repaired, notes=notes)


def _is_radiance(path: str | Path) -> bool:
    """Whether ``path`` begins as a .hdr file does; others fail in OpenImageIO, with its reason."""
    with Path(path).open("rb") as file:
        return file.read(2) == b"#?"


def _read(path: str | Path, name: str | Path, across: bool = False) -> tuple[Floats32, int, tuple[str, ...]]:
    """Radiance as stored, how many texels were repaired, and notes; errors are of the file ``name``.

    ``across``: rows and columns have changed places, which is not read of large maps.
    """
    try:
        header = read_header(path)
        channels, notes = colour_channels(header.channels, name)
        width, height = (header.height, header.width) if across else (header.width, header.height)
        if width != 2 * height:
            raise InputError("light probe", expected="a 2:1 lat-long map", got=f"{width} x {height}", file=name)
        large = height > _MAX_ROWS
        if large and across:
            raise InputError("large light probe", expected="rows from left to right", got="columns", file=name)
        radiance, repaired, cut = (_read_reduced if large else _read_whole)(path, header, channels)
    except InputError as error:
        named = {"expected": error.expected, "got": error.got, "hint": error.hint}
        raise InputError(error.what, file=name, **named) from error
    return radiance, repaired, notes + colour_notes(header.chromaticities) + _cut_notes(cut)


def _read_whole(path: str | Path, header: ImageHeader, channels: list[int]) -> tuple[Floats32, int, int]:
    """Radiance of the map, how many texels were repaired, and in how many a sun was cut."""
    radiance = read_image(path)[..., channels].astype(np.float32)
    cut = _limit_half(radiance, header)
    radiance, repaired = repair(radiance)
    return radiance, repaired, cut


def _read_reduced(path: str | Path, header: ImageHeader, channels: list[int]) -> tuple[Floats32, int, int]:
    """As ``_read_whole``, averaged to ``_MAX_ROWS`` rows strip by strip; texels that need repair have no weight."""
    mean, lost = np.zeros((_MAX_ROWS, 2 * _MAX_ROWS, 3)), None
    repaired = cut = 0
    for top, strip in read_strips(path, channels):
        if not (strip.min() >= 0 and strip.max() < np.inf):  # false for NaN
            cut += _limit_half(strip, header)
            valid = np.isfinite(strip) & (strip >= 0)
            repaired += int((~valid.all(-1)).sum())
            strip[~valid] = 0
            lost = np.zeros(mean.shape, np.float32) if lost is None else lost
            _add_mean(lost, (~valid).astype(np.float32), top, header.height)
        _add_mean(mean, strip, top, header.height)
    if lost is None:
        return mean.astype(np.float32), 0, cut
    with np.errstate(divide="ignore", invalid="ignore"):
        mean[lost > 0] /= 1 - lost[lost > 0]
    mean[lost > 1 - _LEAST_WEIGHT] = np.nan
    return repair(mean.astype(np.float32))[0], repaired, cut


_LEAST_WEIGHT = 1e-3  # of a texel's area, from which its radiance is known


def _add_mean(mean: NDArray[Any], strip: Floats32, top: int, height: int) -> None:
    """Add to the ``mean`` [H, W, C] what the rows of ``strip`` from ``top`` on contribute, of a map of ``height``."""
    count, width = strip.shape[:2]
    columns = mean.shape[1]
    source, target = 1 - _heights(height), 1 - _heights(len(mean))

    def rows(low: int, high: int) -> slice:
        """The target's rows that these source rows overlap."""
        first = int(np.searchsorted(target, source[low], "right")) - 1
        return slice(max(first, 0), min(int(np.searchsorted(target, source[high], "left")), len(mean)))

    touched = rows(top, top + count)
    tall = np.zeros((touched.stop - touched.start, width * strip.shape[2]))
    for low in range(top, top + count, _ROWS_AT_ONCE):
        high = min(low + _ROWS_AT_ONCE, top + count)
        here = rows(low, high)
        weights = _overlaps(source[low : high + 1], target[here.start : here.stop + 1])
        part = strip[low - top : high - top].reshape(high - low, -1).astype(np.float64)
        tall[here.start - touched.start : here.stop - touched.start] += weights @ part
    tall = np.ascontiguousarray(tall.reshape(len(tall), width, -1).swapaxes(0, 1)).reshape(width, -1)
    for left in range(0, columns, _ROWS_AT_ONCE):
        right = min(left + _ROWS_AT_ONCE, columns)
        low, high = left * width // columns, -(-right * width // columns)
        weights = _overlaps(np.arange(low, high + 1) / width, np.arange(left, right + 1) / columns)
        wide = (weights @ tall[low:high]).reshape(right - left, -1, mean.shape[2])
        mean[touched, left:right] += wide.swapaxes(0, 1)


def _limit_half(radiance: Floats32, header: ImageHeader) -> int:
    """Replace +inf in HALF ``radiance`` by the largest HALF number; in how many texels."""
    if header.pixel_type != "half":
        return 0
    infinite = np.isposinf(radiance)
    radiance[infinite] = _LARGEST_HALF
    return int(infinite.any(-1).sum())


def _cut_notes(cut: int) -> tuple[str, ...]:
    if not cut:
        return ()
    return (f"{cut} texels of the light were infinite and are taken as 65504, HALF's largest number: a sun was cut",)


def light_notes(light: Light) -> list[str]:
    """What the user should know of ``light``, one sentence each."""
    notes = list(light.notes)
    if light.repaired:
        notes.append(f"{light.repaired} texels of the light were NaN, infinite or negative and were filled in")
    if light.maximum < _DIM:
        notes.append(f"the light is dark: its largest radiance is {light.maximum:.3g}; try --exposure")
    return notes


def repair(radiance: Floats32) -> tuple[Floats32, int]:
    """``radiance`` [H, W, 3] with NaN, infinite and negative values filled in, and how many texels had one.

    Each bad channel value becomes the mean of its valid neighbours among the eight around it (wrapping
    horizontally); holes fill from their rim inwards.

    Raises:
        InputError: a channel has no valid value at all.
    """
    valid = np.isfinite(radiance) & (radiance >= 0)
    repaired = int((~valid.all(-1)).sum())
    if repaired == 0:
        return radiance, 0
    if not valid.any((0, 1)).all():
        raise InputError("light probe", expected="finite radiance, not negative", got="none in some channel")
    shape, valid = radiance.shape, valid.reshape(-1)
    values = np.where(valid, radiance.reshape(-1), 0).astype(np.float64)
    bad = np.flatnonzero(~valid)
    while len(bad):
        total, count = np.zeros(len(bad)), np.zeros(len(bad))
        for near in _around(bad, shape):
            total += np.where(valid[near], values[near], 0)
            count += valid[near]
        rim = count > 0
        filled = bad[rim]
        values[filled], valid[filled] = total[rim] / count[rim], True
        bad = np.unique(np.concatenate(_around(filled, shape)))
        bad = bad[~valid[bad]]  # the next rim: what is deeper inside has no valid neighbour yet
    return values.astype(np.float32).reshape(shape), repaired


def _around(texels: NDArray[np.int64], shape: tuple[int, ...]) -> list[NDArray[np.int64]]:
    """Of flat ``texels`` in [H, W, C] the neighbours within a texel, themselves too: nine arrays as long."""
    row, column, channel = np.unravel_index(texels, shape)
    rows = [np.clip(row + down, 0, shape[0] - 1) for down in (-1, 0, 1)]
    columns = [(column + right) % shape[1] for right in (-1, 0, 1)]
    return [np.ravel_multi_index((r, c, channel), shape) for r in rows for c in columns]


def texel_directions(height: int, width: int) -> Floats:
    """[H, W, 3], the unit direction of every texel's centre in the light's frame."""
    azimuth = (np.arange(width) + 0.5) / width * 2 * np.pi - np.pi
    polar = ((np.arange(height) + 0.5) / height * np.pi)[:, None]
    ring = np.sin(polar)
    return np.stack(
        [ring * np.cos(azimuth), np.broadcast_to(np.cos(polar), (height, width)), ring * np.sin(azimuth)], -1
    )


def texel_solid_angles(height: int, width: int) -> Floats:
    """[H, W] sr, exact: a row between polar angles a and b covers 2π (cos a − cos b). The sum is 4π."""
    rows = -np.diff(_heights(height)) * 2 * np.pi / width
    return np.broadcast_to(rows[:, None], (height, width)).copy()


REC709_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""what of linear R, G and B is luminance (ITU-R BT.709-6, section 3)"""


def downsize(radiance: ArrayLike, height: int, width: int) -> Floats32:
    """``radiance`` [H, W, C] as the mean over each of ``height`` × ``width`` texels, weighted by solid angle.

    Exact for any two sizes, whole ratio or not, so Σ radiance · solid angle stays: bilinear resizing loses a
    small sun altogether. Larger grids repeat texels.
    """
    source = np.asarray(radiance, np.float64)
    # solid angle is uniform in azimuth and in y = cos(polar angle): both axes are one-dimensional overlaps
    vertical = _overlaps(1 - _heights(source.shape[0]), 1 - _heights(height))
    horizontal = _overlaps(np.arange(source.shape[1] + 1) / source.shape[1], np.arange(width + 1) / width)
    rows = np.tensordot(vertical, source, (1, 0))
    return np.ascontiguousarray(np.tensordot(horizontal, rows, (1, 1)).swapaxes(0, 1), np.float32)


def _heights(rows: int) -> Floats:
    """y = cos(polar angle) [rows + 1] of the edges between rows, from 1 down to −1."""
    return np.cos(np.linspace(0, np.pi, rows + 1))


def _overlaps(source: Floats, target: Floats) -> Floats:
    """[targets, sources], the fraction of each target interval each source interval covers; edges given."""
    low = np.maximum(target[:-1, None], source[None, :-1])
    high = np.minimum(target[1:, None], source[None, 1:])
    return np.asarray(np.maximum(high - low, 0) / np.diff(target)[:, None])


def _finite_float32(radiance: NDArray[np.floating]) -> Floats32:
    """To float32, clipped to what it can hold: a huge exposure must not make an infinity."""
    return np.asarray(np.clip(radiance, 0, np.finfo(np.float32).max), np.float32)
