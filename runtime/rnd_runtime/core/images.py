"""Image files and the two roundings between radiance and bytes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import OpenImageIO as oiio
from numpy.typing import ArrayLike, NDArray

from .budget import Budget
from .errors import InputError
from .files import atomic_path, existing_file

Floats = NDArray[np.floating[Any]]  # float32 or float64, as given
Attribute = str | tuple[str, tuple[float, ...]]
Tone = Literal["srgb", "neutral"]  # what comes before sRGB's transfer function: nothing, or ``neutral``
Image = NDArray[np.uint8] | NDArray[np.uint16] | NDArray[np.float32]


# A file that claims more pixels than deflate (1032 : 1) could hide in it is damaged; reading it would fill the memory.
_MAX_COMPRESSION = 2000
_PNG_END = b"\0\0\0\0IEND\xaeB`\x82"
_PNG_LEVEL, _PNG_UP = 3, 32  # a row less the one above: four times as fast as libpng's choice, photographs 8 % larger
_SMALL_IMAGE = 1 << 20  # bytes of pixels that need no such check
_PIXEL_TYPES = ("uint8", "uint16", "half", "float")  # OpenImageIO would divide others by their largest value
_PIXEL_BYTES = {"uint8": 1, "uint16": 2, "float": 4}  # as read
_MOST_PARTS = 32  # of a file, that are named
_STRIP = 256  # rows: OpenEXR's DWAB decodes as many at once
# Codecs of OpenEXR without such a bound (even pixels in DWAB: 7200 : 1), and the most bytes of pixels in them.
_UNBOUNDED_CODECS = ("dwaa", "dwab", "piz")
_MAX_UNBOUNDED = 1 << 31
_MAX_HALF = np.float32(65504)
NEUTRAL_OFFSET = 0.04  # reflectance of a dielectric at normal incidence
NEUTRAL_START = 0.8 - NEUTRAL_OFFSET
"""peak from which radiance is compressed"""
NEUTRAL_DESATURATION = 0.15
MAX_RADIANCE = float(np.finfo(np.float32).max)


def linear_to_srgb(linear: ArrayLike) -> Floats:
    """sRGB's transfer function (IEC 61966-2-1, piecewise) of linear values; negative ones become 0.

    Values above 1 are continued by the curve; ``to_bytes`` clips them. float32 stays float32.
    """
    x = np.maximum(_floats(linear), 0)
    srgb: Floats = np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.power(x, 1 / 2.4) - 0.055)
    return srgb


def neutral(linear: ArrayLike) -> Floats:
    """Khronos PBR Neutral of linear radiance [..., 3]: in [0, 1], base colours nearly kept, highlights compressed.

    Negative numbers and NaN count as 0. float32 stays float32.
    Source: https://github.com/KhronosGroup/ToneMapping, PBR_Neutral.
    """
    x = np.clip(np.nan_to_num(_floats(linear), nan=0.0), 0, MAX_RADIANCE)
    low = x.min(axis=-1, keepdims=True)
    toe = low - low * low / (4 * NEUTRAL_OFFSET)
    x = x - np.where(low < 2 * NEUTRAL_OFFSET, toe, NEUTRAL_OFFSET)
    peak, room = np.maximum(x.max(axis=-1, keepdims=True), NEUTRAL_START), 1 - NEUTRAL_START
    compressed = 1 - room * room / (peak - NEUTRAL_START + room)
    saturation = 1 / (NEUTRAL_DESATURATION * (peak - compressed) + 1)
    toned: Floats = compressed + saturation * (x / peak * compressed - compressed)
    return np.where(peak > NEUTRAL_START, toned, x)


def srgb_to_linear(srgb: ArrayLike) -> Floats:
    """The inverse of ``linear_to_srgb``, for values in [0, 1]. float32 stays float32."""
    x = np.maximum(_floats(srgb), 0)
    linear: Floats = np.where(x <= 0.04045, x / 12.92, np.power((x + 0.055) / 1.055, 2.4))
    return linear


def to_bytes(values: ArrayLike) -> NDArray[np.uint8]:
    """8-bit values of numbers in [0, 1]: clipped, halves rounded up, NaN becomes 0."""
    x = np.nan_to_num(np.asarray(values), nan=0.0, posinf=1.0, neginf=0.0)
    rounded: NDArray[np.uint8] = np.floor(np.clip(x, 0, 1) * 255 + 0.5).astype(np.uint8)
    return rounded


@dataclass(frozen=True)
class ImageHeader:
    """The header of an image file."""

    width: int
    height: int
    channels: tuple[str, ...]
    pixel_type: str  # uint8, uint16, half, float, …
    chromaticities: tuple[float, ...] | None = None  # x, y of red, green, blue and white, of an EXR
    left_out: tuple[str, ...] = ()  # further images of the file, as an EXR's parts, by name


def read_header(path: str | Path) -> ImageHeader:
    """The size and channel names of an image file, without decoding it."""
    with _opened(path) as source:
        header = _checked_header(source.spec(), path)
        others = list[str]()
        while len(others) < _MOST_PARTS and source.seek_subimage(len(others) + 1, 0):
            others.append(source.spec().getattribute("oiio:subimagename") or f"part {len(others) + 2}")
    return replace(header, left_out=tuple(map(str, others)))


def read_image(path: str | Path) -> Image:
    """The pixels [H, W, C] exactly as the file stores them: uint8, uint16, or float32 for HALF and FLOAT.

    Nothing is converted: no colour management, no multiplication by alpha (OpenImageIO does that to PNGs
    by default). Only the first image of a file is read.

    Raises:
        InputError: not a file, not an image, cut short, rotated by EXIF, a crop of a larger canvas, or with a channel
            of another type, such as an EXR's UINT.
    """
    with _opened(path) as source:
        spec = source.spec()
        _checked_header(spec, path)
        kind = _read_type(spec, path)
        Budget.of(path).take(spec.width * spec.height * spec.nchannels * _PIXEL_BYTES[kind], "image")
        pixels = source.read_image(0, 0, 0, spec.nchannels, kind)
        if pixels is None:
            raise InputError("image cannot be read", got=_reason(source.geterror()), file=path)
    return np.ascontiguousarray(pixels).reshape(spec.height, spec.width, spec.nchannels)


def read_strips(path: str | Path, channels: Sequence[int]) -> Iterator[tuple[int, NDArray[np.float32]]]:
    """First row and pixels [rows, W, C] of each strip of an EXR or a .hdr, from the top; never the full image.

    Args:
        channels: indices of the C channels.

    Raises:
        InputError: as ``read_image``; or one strip expands to more than the file's budget, or all take too long.
    """
    budget = Budget.of(path)
    with _opened(path) as source:
        spec = source.spec()
        _checked_header(spec, path)
        _read_type(spec, path)
        # numpy converts halves in a third of OpenImageIO's time
        kind = "half" if {str(of) for of in (spec.format, *spec.channelformats)} == {"half"} else "float"
        tile: int = spec.tile_height or 1
        rows = -(-_STRIP // tile) * tile
        budget.take(rows * spec.width * spec.nchannels * _PIXEL_BYTES["float"], "strip of the image")
        low, high = min(channels), max(channels) + 1
        in_order = list(channels) == list(range(low, high))
        for top in range(0, spec.height, rows):
            bottom = min(top + rows, spec.height)
            if spec.tile_width:
                pixels = source.read_tiles(0, 0, 0, spec.width, top, bottom, 0, 1, low, high, kind)
            else:
                pixels = source.read_scanlines(0, 0, top, bottom, 0, low, high, kind)
            if pixels is None:
                raise InputError("image cannot be read", got=_reason(source.geterror()), file=path)
            budget.check_time("image")
            strip = np.asarray(pixels, np.float32).reshape(bottom - top, spec.width, high - low)
            yield top, strip if in_order else strip[..., [channel - low for channel in channels]]


def _read_type(spec: Any, path: str | Path) -> str:
    """The type as which pixels are read; raises ``InputError`` for types that would be converted."""
    kinds = [str(kind) for kind in (spec.format, *spec.channelformats)]
    if other := next((kind for kind in kinds if kind not in _PIXEL_TYPES), None):
        raise InputError("type of pixels", expected=" or ".join(_PIXEL_TYPES), got=other, file=path)
    return kinds[0] if kinds[0] in ("uint8", "uint16") else "float"


def write_image(
    path: str | Path,
    array: ArrayLike,
    *,
    channel_names: tuple[str, ...] | None = None,
    half: tuple[bool, ...] = (),
    attributes: Mapping[str, Attribute] | None = None,
) -> None:
    """Write [H, W] or [H, W, C] pixels as they are: uint8 or uint16 to PNG, float32 to EXR as FLOAT.

    FLOAT and not HALF, because sun texels exceed HALF's 65 504. Equal pixels give equal bytes. A PNG's
    alpha is straight by its specification, so hand over colours that are not multiplied by it.

    Args:
        channel_names: C names for an EXR's channels, such as ``("albedo.R", "albedo.G", "albedo.B")``.
        half: which of an EXR's C channels are stored as HALF, clipped to its range.
        attributes: of an EXR: text, or OpenImageIO's name of a type with its numbers.
    """
    path, pixels = Path(path), np.asarray(array)
    pixels = pixels[..., None] if pixels.ndim == 2 else pixels
    suffix = path.suffix.lower()
    kinds = {".png": ("uint8", "uint16"), ".exr": ("float32",)}
    if suffix not in kinds:
        raise InputError("image format", expected=" or ".join(kinds), got=suffix or "no suffix", file=path)
    assert pixels.ndim == 3 and pixels.dtype.name in kinds[suffix], (pixels.shape, pixels.dtype)
    height, width, channels = pixels.shape
    spec = oiio.ImageSpec(width, height, channels, "float" if suffix == ".exr" else pixels.dtype.name)
    if channel_names is not None:
        assert len(channel_names) == channels, (channel_names, channels)
        spec.channelnames = channel_names
    if suffix == ".exr":
        spec.attribute("compression", "zip")
        spec.attribute("DateTime", "1970:01:01 00:00:00")  # otherwise the time of writing gets in
        for name, value in (attributes or {}).items():
            spec.attribute(name, *((value,) if isinstance(value, str) else value))
        if any(half):
            spec.channelformats = tuple("half" if low else "float" for low in half)
            pixels = np.where(np.array(half), np.clip(pixels, -_MAX_HALF, _MAX_HALF), pixels)
    else:
        spec.attribute("oiio:UnassociatedAlpha", 1)  # otherwise colours are divided by alpha
        spec.attribute("png:compressionLevel", _PNG_LEVEL)
        spec.attribute("png:filter", _PNG_UP)
    with atomic_path(path) as temporary:
        target: Any = oiio.ImageOutput.create(_text(temporary))
        written = target.open(_text(temporary), spec) and target.write_image(np.ascontiguousarray(pixels))
        reason = target.geterror()
        if not (target.close() and written):
            raise InputError("image cannot be written", got=_reason(reason or target.geterror()), file=path)
        # its writer does not report a full disk
        if suffix == ".png" and not temporary.read_bytes().endswith(_PNG_END):
            raise InputError("image cannot be written", got="half a file: the disk may be full", file=path)


def _text(path: str | Path) -> str:
    """``path`` as OpenImageIO takes names; raises ``InputError`` where it is not UTF-8."""
    try:
        return str(path).encode().decode()
    except UnicodeEncodeError as error:
        raise InputError("name of an image", expected="UTF-8", got="other bytes", file=path) from error


def _floats(values: ArrayLike) -> Floats:
    array = np.asarray(values)
    return array if array.dtype in (np.float32, np.float64) else array.astype(np.float64)


@contextmanager
def _opened(path: str | Path) -> Iterator[Any]:
    existing_file(path, what="image")
    settings = oiio.ImageSpec()
    settings.attribute("oiio:UnassociatedAlpha", 1)
    source = None
    try:
        source = oiio.ImageInput.open(_text(path), settings)
        if source is None:
            reason = _reason(oiio.geterror())
            raise InputError("image cannot be read", got=_other_format(Path(path)) or reason, file=path)
        yield source
    except UnicodeDecodeError as error:  # names and complaints of a damaged file need not be text
        raise InputError("image is damaged", got="names that are not text", file=path) from error
    finally:
        if source is not None:
            source.close()


def _checked_header(spec: Any, path: str | Path) -> ImageHeader:
    orientation = spec.get_int_attribute("Orientation", 1)
    if orientation != 1:
        raise InputError(
            "image is stored rotated",
            expected="EXIF orientation 1",
            got=orientation,
            file=path,
            hint="save it upright: cameras are calibrated to the pixels as stored",
        )
    stored = (spec.x, spec.y, spec.width, spec.height)
    canvas = (spec.full_x, spec.full_y, spec.full_width, spec.full_height)
    if stored != canvas or spec.deep or spec.depth != 1:
        raise InputError(
            "image layout",
            expected="one flat image that fills its canvas",
            got=f"pixels {stored} of canvas {canvas}" + (", deep" if spec.deep else ""),
            file=path,
        )
    claimed = spec.width * spec.height * spec.nchannels * spec.format.size()
    file_bytes = Path(path).stat().st_size
    unbounded = spec.get_string_attribute("compression").startswith(_UNBOUNDED_CODECS)
    if claimed > (_MAX_UNBOUNDED if unbounded else _MAX_COMPRESSION * file_bytes + _SMALL_IMAGE):
        expected = f"{claimed} bytes of pixels"
        raise InputError("image is cut short or damaged", expected=expected, got=f"{file_bytes} stored", file=path)
    primaries = spec.getattribute("chromaticities")
    return ImageHeader(
        spec.width,
        spec.height,
        tuple(spec.channelnames),
        str(spec.format),
        tuple(primaries) if isinstance(primaries, tuple) and len(primaries) == 8 else None,
    )


_BEGINNINGS = {
    ".png": b"\x89PNG",
    ".exr": b"\x76\x2f\x31\x01",
    ".hdr": b"#?",
    ".jpg": b"\xff\xd8",
    ".jpeg": b"\xff\xd8",
}


def _other_format(path: Path) -> str | None:
    """A description of ``path`` if its first bytes do not fit its suffix."""
    suffix = path.suffix.lower()
    with path.open("rb") as file:
        head = file.read(4)
    if not head:
        return "an empty file"
    return None if head.startswith(_BEGINNINGS.get(suffix, b"")) else f"something else than a {suffix} file"


def _reason(message: str) -> str:
    """OpenImageIO's words in one line."""
    return " ".join(message.split()) or "no reason given by OpenImageIO"
