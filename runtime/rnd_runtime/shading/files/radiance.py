"""Headers of Radiance .hdr files, and those of other encodings and orientations as OpenImageIO reads them."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.signals import temporary_folder

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]

_MAX_EXPOSURE = 1e30  # a file's EXPOSURE, or one over it
_LONGEST_LINE = 4096  # bytes of a header
_MAX_LINES = 1000
_RESOLUTION = re.compile(rb"^([-+])([XY]) +(\d+) +([-+])([XY]) +(\d+)\s*$")
_RGBE, _XYZE = b"32-bit_rle_rgbe", b"32-bit_rle_xyze"
# CIE XYZ, white D65, → linear Rec.709 (IEC 61966-2-1)
_XYZ_TO_REC709: Floats = np.array(
    [[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]], np.float64
)
_D65: Floats = np.linalg.inv(_XYZ_TO_REC709).sum(1)
_BRADFORD: Floats = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])


@dataclass(frozen=True)
class RadianceHeader:
    """The header of a .hdr file.

    Attributes:
        exposure: product of its EXPOSUREs, by which pixels were multiplied.
        primaries: x, y of red, green, blue and white; None where not stated.
        xyz: whether pixels are CIE XYZ instead of RGB.
        axes: the resolution line's signs and axes: "-Y+X" is from the top, from the left.
        pixels_at: offset of the resolution line, and of the pixels after it.
        sizes: of its two axes.
    """

    exposure: float
    primaries: tuple[float, ...] | None
    xyz: bool
    axes: str
    pixels_at: tuple[int, int]
    sizes: tuple[int, int]

    def upright(self, pixels: Floats32) -> Floats32:
        """``pixels`` [H, W, 3] as stored, from the top and from the left."""
        if self.axes[1] == "X":
            pixels = pixels.swapaxes(0, 1)
        signs = {self.axes[1]: self.axes[0], self.axes[3]: self.axes[2]}
        return pixels[:: 1 if signs["Y"] == "-" else -1, :: 1 if signs["X"] == "+" else -1]

    def rec709(self, pixels: Floats32) -> Floats32:
        """XYZ ``pixels`` [H, W, 3] as linear Rec.709, negative values cut; a stated white is adapted to D65."""
        white = _D65
        if self.primaries is not None:
            x, y = self.primaries[6:]
            white = np.array([x / y, 1, (1 - x - y) / y])
        gains = (_BRADFORD @ _D65) / (_BRADFORD @ white)
        matrix = _XYZ_TO_REC709 @ np.linalg.inv(_BRADFORD) @ (gains[:, None] * _BRADFORD)
        return np.maximum(pixels @ matrix.T.astype(np.float32), 0)

    @property
    def notes(self) -> tuple[str, ...]:
        """Exposure and encoding, one sentence each."""
        notes = []
        if self.exposure != 1:
            notes.append(f"the light's pixels are divided by the exposure that its file states, {self.exposure:.4g}")
        if self.xyz:
            white = "the white it states" if self.primaries else "white D65"
            notes.append(f"the light is CIE XYZ with {white}, converted to Rec.709")
        return tuple(notes)


def read_radiance_header(path: str | Path) -> RadianceHeader:
    """Read the header of a .hdr file; OpenImageIO reads the last EXPOSURE alone, and neither PRIMARIES nor XYZ.

    Raises:
        InputError: it is cut short, of another format, or states an impossible exposure.
    """
    exposure, primaries, form = 1.0, None, b""
    with Path(path).open("rb") as file:
        for _ in range(_MAX_LINES):
            line = file.readline(_LONGEST_LINE)
            if not line.strip():
                break
            name, _, text = line.partition(b"=")
            if name == b"FORMAT":
                form = text.strip()
            if name not in (b"EXPOSURE", b"PRIMARIES"):
                continue
            try:
                numbers = tuple(float(word) for word in text.split())
            except ValueError:
                numbers = ()
            if name == b"EXPOSURE":
                exposure *= numbers[0] if len(numbers) == 1 else np.nan
            elif len(numbers) == 8 and np.isfinite(numbers).all() and numbers[7] > 0:  # zeros state nothing
                primaries = numbers
        start = file.tell()
        found = _RESOLUTION.match(file.readline(_LONGEST_LINE))
        end = file.tell()
    if form not in (_RGBE, _XYZE):
        got = form.decode("latin-1") or "no FORMAT"
        raise InputError("FORMAT of the light probe", expected="rgbe or xyze", got=got, file=path)
    if found is None or found[2] == found[5]:
        raise InputError("size of the light probe", expected="a line such as -Y 512 +X 1024", file=path)
    if not 1 / _MAX_EXPOSURE <= exposure <= _MAX_EXPOSURE:
        expected = f"numbers whose product is {1 / _MAX_EXPOSURE:g} to {_MAX_EXPOSURE:g}"
        raise InputError("EXPOSURE of the light probe", expected=expected, got=f"{exposure:g}", file=path)
    axes = b"".join(found.group(1, 2, 4, 5)).decode()
    sizes = int(found[3]), int(found[6])
    return RadianceHeader(exposure, primaries, form == _XYZE, axes, (start, end), sizes)


@contextmanager
def as_stored(path: str | Path, header: RadianceHeader) -> Iterator[Path]:
    """A path from which OpenImageIO reads the stored pixels as if RGB, from the top: ``path`` or a temporary copy."""
    if header.axes == "-Y+X" and not header.xyz:
        yield Path(path)
        return
    with temporary_folder() as folder, Path(path).open("rb") as source:
        copy = folder / "probe.hdr"
        with copy.open("wb") as target:
            target.write(source.read(header.pixels_at[0]).replace(_XYZE, _RGBE))
            target.write(b"-Y %d +X %d\n" % header.sizes)
            source.seek(header.pixels_at[1])
            shutil.copyfileobj(source, target)
        yield copy
