"""Reading light probes: .exr and .hdr files, large ones reduced strip by strip; repair of invalid texels."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import existing_file
from rnd_runtime.core.images import ImageHeader, read_header, read_image, read_strips
from rnd_runtime.core.kinds import explained
from rnd_runtime.shading.light import Floats32, Light, Up, finite_float32, overlaps, row_edges

from .channels import colour_channels, colour_notes
from .radiance import as_stored, read_radiance_header

_MAX_STOPS = 64  # beyond it radiance leaves float32
_MAX_ROWS = 2048  # larger maps are averaged to this while they are read
_ROWS_AT_ONCE = 16  # rows or columns that are averaged by one product
_LARGEST_HALF = 65504.0
_MIN_WEIGHT = 1e-3  # of a texel's area, from which its radiance is known


def load_light(path: str | Path, *, up: Up = "y", yaw: float = 0.0, exposure: float = 0.0) -> Light:
    """Read a lat-long .exr or .hdr as a ``Light``.

    NaN, infinite and negative texels are filled from their neighbours; ``Light.repaired`` counts them. In a HALF map
    +inf is 65 504, the largest HALF number, as a sun that did not fit. A map of more than 2048 rows is averaged to
    2048 × 4096 texels while it is read, weighted by solid angle, so that memory does not grow with it. Pixels of a
    Radiance file are divided by each EXPOSURE that its header states ("Radiance image format", Ward); CIE XYZ becomes
    Rec.709, and rows are ordered by its resolution line.

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
    scale = 2.0 ** np.float64(exposure)
    if suffix == ".exr" or not _is_radiance(path):
        radiance, repaired, notes = _read(path, path)
    else:
        stored = read_radiance_header(path)
        with as_stored(path, stored) as copy:
            radiance, repaired, _ = _read(copy, path, across=stored.axes[1] == "X")
        notes = stored.notes + (() if stored.xyz else colour_notes(stored.primaries))
        radiance = stored.upright(radiance if not stored.xyz else stored.rec709(radiance))
        scale /= np.float64(stored.exposure)
    radiance = finite_float32(radiance * scale)
    return Light(radiance, yaw=yaw, up=up, repaired=repaired, notes=notes)


def _is_radiance(path: str | Path) -> bool:
    """Whether ``path`` begins as a .hdr file does; others fail in OpenImageIO, with its reason."""
    with Path(path).open("rb") as file:
        return file.read(2) == b"#?"


def _read(path: str | Path, name: str | Path, across: bool = False) -> tuple[Floats32, int, tuple[str, ...]]:
    """Radiance as stored, how many texels were repaired, and notes; errors are of the file ``name``.

    ``across``: the file stores the transposed map, which is refused for large maps.
    """
    parts = None
    try:
        header = read_header(path)
        if header.left_out:
            parts = f"of the light's file the first part is read; left out: {', '.join(header.left_out)}"
        channels, notes = colour_channels(header.channels, name)
        width, height = (header.height, header.width) if across else (header.width, header.height)
        if width != 2 * height:
            raise InputError("light probe", expected="a 2:1 lat-long map", got=f"{width} x {height}", file=name)
        large = height > _MAX_ROWS
        if large and across:
            raise InputError("large light probe", expected="rows from left to right", got="columns", file=name)
        radiance, repaired, cut = (_read_reduced if large else _read_whole)(path, header, channels)
    except InputError as error:
        hint = error.hint or parts
        raise InputError(error.what, expected=error.expected, got=error.got, file=name, hint=hint) from error
    notes += () if parts is None else (parts,)
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
    mean[lost > 1 - _MIN_WEIGHT] = np.nan
    return repair(mean.astype(np.float32))[0], repaired, cut


def _add_mean(mean: NDArray[Any], strip: Floats32, top: int, height: int) -> None:
    """Add to the ``mean`` [H, W, C] what the rows of ``strip`` from ``top`` on contribute, of a map of ``height``."""
    narrow = _narrowed(strip, mean.shape[1])
    source, target = 1 - row_edges(height), 1 - row_edges(len(mean))
    for low in range(top, top + len(strip), _ROWS_AT_ONCE):
        high = min(low + _ROWS_AT_ONCE, top + len(strip))
        first = max(int(np.searchsorted(target, source[low], "right")) - 1, 0)
        last = min(int(np.searchsorted(target, source[high], "left")), len(mean))
        weights = overlaps(source[low : high + 1], target[first : last + 1])
        mean[first:last] += np.tensordot(weights, narrow[low - top : high - top], 1)


def _narrowed(strip: Floats32, columns: int) -> NDArray[np.floating]:
    """The means [rows, columns, C] of ``strip`` [rows, W, C] along its rows."""
    width = strip.shape[1]
    each, rest = divmod(width, columns)
    if rest == 0:
        channels = strip.shape[2]
        mean = np.tile(np.eye(channels, dtype=np.float32), (each, 1)) / np.float32(each)
        return (strip.reshape(-1, each * channels) @ mean).reshape(len(strip), columns, channels)
    narrow = np.empty((len(strip), columns, strip.shape[2]))
    for left in range(0, columns, _ROWS_AT_ONCE):
        right = min(left + _ROWS_AT_ONCE, columns)
        low, high = left * width // columns, -(-right * width // columns)
        weights = overlaps(np.arange(low, high + 1) / width, np.arange(left, right + 1) / columns)
        narrow[:, left:right] = np.einsum("tc,rck->rtk", weights, strip[:, low:high])
    return narrow


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
