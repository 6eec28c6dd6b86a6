"""Clips: mp4 whose colours survive, and WebP, WebM and ProRes 4444, which keep transparency.

A player that finds no tags guesses BT.601 for small frames, and ffmpeg's converter assumes BT.601 by
default; either one alone costs 16 dB. So mp4's conversion to BT.709 is written out here, said in the file and tested
through a decoder. WebP has one way to keep colours (BT.601, full chroma range halved), which its encoder does itself.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from fractions import Fraction
from itertools import count
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.cli.extras import install_hint, need_packages
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import atomic_path
from rnd_runtime.playback.doctor import Finding

Bytes = NDArray[np.uint8]

# ITU-R BT.709-6 section 3: luma from R'G'B', then colour differences scaled to ±0.5; 8 bit, limited range.
RED, GREEN, BLUE = (np.float32(weight) for weight in (0.2126, 0.7152, 0.0722))
LUMA_SCALE, LUMA_ZERO = np.float32(219 / 255), np.float32(16)
BLUE_SCALE, RED_SCALE = np.float32(224 / 255 / 1.8556), np.float32(224 / 255 / 1.5748)
CHROMA_ZERO = np.float32(128)

# ITU-T H.273 code points. The pixels are sRGB-coded, so the transfer is named sRGB: players that believe
# "BT.709" there (QuickTime) show everything brighter.
PRIMARIES_BT709, TRANSFER_SRGB, MATRIX_BT709, RANGE_LIMITED = 1, 13, 1, 1

BT709 = {
    "color_primaries": PRIMARIES_BT709,
    "color_trc": TRANSFER_SRGB,
    "colorspace": MATRIX_BT709,
    "color_range": RANGE_LIMITED,
}

# The same frames must give the same bytes. So one thread: x264's output depends on their number. And no macroblock
# tree: its vector code reads past the end of frames narrower than 128 pixels (13 different files in 30 runs).
# CRF 18 then costs 0.1 dB against 16 at 512², where the halved chroma alone holds everything below 46 dB.
X264 = {"preset": "veryfast", "crf": "18", "threads": "1", "x264-params": "mbtree=0"}
PRORES = {"profile": "4444", "vendor": "apl0", "alpha_bits": "16", "threads": "1"}
VP9 = {"crf": "18", "b": "0", "threads": "1", "auto-alt-ref": "0", "deadline": "good", "cpu-used": "4"}  # ref: no alpha
WEBP = {"quality": "85", "compression_level": "4"}

WEBP_MIN_MS = 11  # of a frame: browsers show one of 10 ms or less for 100

_CLIPS = "PyAV (mp4, webp, webm, mov)"


def load_pyav(otherwise: str = "") -> ModuleType:
    """Import PyAV, or say which extra brings it and what could be done ``otherwise``."""
    need_packages("video", "av", what="mp4, webp, webm and mov need", otherwise=otherwise)
    import av

    return av


def finding() -> Finding:
    """The doctor's line on clips."""
    try:
        return Finding(_CLIPS, str(load_pyav().__version__), None)
    except InputError:
        return Finding(_CLIPS, "missing", install_hint("video"))


def rgb_to_yuv420(image_srgb: Bytes) -> Bytes:
    """8-bit R'G'B' [H, W, 3] → planar Y'CbCr 4:2:0 of BT.709, limited range, as [1.5 H', W'] bytes.

    H' and W' are H and W rounded up to even numbers; the last row or column is repeated. Chroma is sited as
    H.264 assumes when a stream says nothing: on the left luma column, between two rows.
    """
    height, width = image_srgb.shape[:2]
    padded = np.pad(image_srgb, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
    height, width = padded.shape[:2]
    rgb = padded.astype(np.float32)
    rows = (rgb[0::2] + rgb[1::2]) / 2
    left = np.concatenate([rows[:, :1], rows[:, 1:-1:2]], axis=1)
    sited = (left + 2 * rows[:, 0::2] + rows[:, 1::2]) / 4
    sited_luma = _luma(sited)
    planes = (
        LUMA_ZERO + LUMA_SCALE * _luma(rgb),
        CHROMA_ZERO + BLUE_SCALE * (sited[..., 2] - sited_luma),
        CHROMA_ZERO + RED_SCALE * (sited[..., 0] - sited_luma),
    )
    flat = np.concatenate([np.rint(plane).astype(np.uint8).ravel() for plane in planes])
    return flat.reshape(height * 3 // 2, width)


def _luma(rgb: NDArray[np.floating[Any]]) -> NDArray[np.floating[Any]]:
    """Y' [...] of R'G'B' [..., 3]. Written out, because BLAS may round by where an array lies in memory."""
    return RED * rgb[..., 0] + GREEN * rgb[..., 1] + BLUE * rgb[..., 2]


def rgb_to_bgra(image_srgb: Bytes) -> Bytes:
    """8-bit R'G'B' or R'G'B'A [H, W, 3 or 4], alpha straight → B'G'R'A [H, W, 4]."""
    opaque = np.full((*image_srgb.shape[:2], 1), 255, np.uint8)
    return np.ascontiguousarray(np.concatenate([image_srgb[..., 2::-1], image_srgb[..., 3:], opaque], axis=-1)[..., :4])


def rgb_to_yuva444(image_srgb: Bytes) -> list[NDArray[np.uint16]]:
    """8-bit R'G'B' or R'G'B'A [H, W, 3 or 4] → 10-bit planes [H, W] Y', Cb, Cr (BT.709, limited range) and A (full)."""
    rgb = image_srgb[..., :3].astype(np.float32)
    luma = _luma(rgb)
    alpha = image_srgb[..., 3] if image_srgb.shape[-1] == 4 else np.full(luma.shape, 255)
    planes = (
        4 * (LUMA_ZERO + LUMA_SCALE * luma),
        4 * (CHROMA_ZERO + BLUE_SCALE * (rgb[..., 2] - luma)),
        4 * (CHROMA_ZERO + RED_SCALE * (rgb[..., 0] - luma)),
        alpha * (1023 / 255),
    )
    return [np.rint(plane).astype(np.uint16) for plane in planes]


def rgb_to_yuva420(image_srgb: Bytes) -> list[Bytes]:
    """8-bit R'G'B' or R'G'B'A [H, W, 3 or 4] → the planes of ``rgb_to_yuv420``, and A in full."""
    flat = rgb_to_yuv420(image_srgb)
    height, width = len(flat) * 2 // 3, flat.shape[1]
    alpha = image_srgb[..., 3] if image_srgb.shape[-1] == 4 else np.full(image_srgb.shape[:2], 255, np.uint8)
    padding = ((0, height - len(alpha)), (0, width - alpha.shape[1]))
    return [flat[:height], *flat[height:].reshape(2, height // 2, width // 2), np.pad(alpha, padding, mode="edge")]


def _frame_of_planes(av: ModuleType, planes: Sequence[NDArray[Any]], pixels: str) -> Any:
    """A frame whose planes PyAV cannot take from an array."""
    frame = av.VideoFrame(*planes[0].shape[::-1], pixels)
    for plane, values in zip(frame.planes, planes):
        rows = np.zeros((plane.buffer_size // plane.line_size, plane.line_size // values.itemsize), values.dtype)
        rows[: len(values), : values.shape[1]] = values
        plane.update(rows.tobytes())
    return frame


class _Kind(NamedTuple):
    """How a clip is made: ``options`` are the encoder's, ``container`` the file's."""

    codec: str
    pixels: str
    planes: Callable[[Bytes], Bytes] | Callable[[Bytes], list[NDArray[Any]]]
    options: dict[str, str]
    container: dict[str, str]
    tags: dict[str, int]


_KINDS = {
    "mp4": _Kind("libx264", "yuv420p", rgb_to_yuv420, X264, {"movflags": "+faststart"}, BT709),
    "mov": _Kind("prores_ks", "yuva444p10le", rgb_to_yuva444, PRORES, {}, BT709),
    "webm": _Kind("libvpx-vp9", "yuva420p", rgb_to_yuva420, VP9, {"fflags": "+bitexact"}, BT709),
    "webp": _Kind("libwebp_anim", "bgra", rgb_to_bgra, WEBP, {"loop": "0"}, {}),
}
CLIPS = tuple(_KINDS)


def clip_notes(kinds: Iterable[str], fps: float) -> list[str]:
    """Notes on clips of ``fps`` frames per second."""
    every = _webp_every(fps)
    if "webp" not in kinds or every == 1:
        return []
    return [f"the WebP keeps one frame in {every}, {fps / every:g} a second: browsers slow down what has more than 90"]


def _webp_every(fps: float) -> int:
    """One frame in how many a WebP keeps."""
    return math.ceil(fps * WEBP_MIN_MS / 1000)


@contextmanager
def clip_writer(path: str | Path, *, fps: float) -> Iterator[Callable[[Bytes], None]]:
    """Yield a function that appends one sRGB frame uint8; the file appears when the block ends.

    Args:
        path: a name in .mp4, which takes frames [H, W, 3], or in .webp, .webm or .mov, which also take [H, W, 4],
            their alpha straight. A .webp plays again and again.
        fps: frames per second; of more than 90 a WebP keeps every second, third, …

    The size is that of the first frame (mp4 and webm: rounded up to even). The same frames give the same bytes. Raises
    InputError when PyAV is missing or the encoder refuses the size.
    """
    av, name = load_pyav(), Path(path).suffix[1:]
    kind = _KINDS[name]
    every, numbers = _webp_every(fps) if name == "webp" else 1, count()
    with atomic_path(path) as temporary, av.open(str(temporary), "w", format=name, options=kind.container) as container:
        stream = container.add_stream(
            kind.codec, rate=Fraction(fps / every).limit_denominator(1001), options=kind.options
        )

        def write(image_srgb: Bytes) -> None:
            if next(numbers) % every:
                return
            planes = kind.planes(image_srgb)
            if isinstance(planes, list):
                frame = _frame_of_planes(av, planes, kind.pixels)
            else:
                frame = av.VideoFrame.from_ndarray(planes, format=kind.pixels)
            size = f"{frame.width}x{frame.height}"
            if not stream.codec_context.is_open:
                stream.width, stream.height, stream.pix_fmt = frame.width, frame.height, kind.pixels
                _tag(stream.codec_context, kind.tags)
            if (frame.width, frame.height) != (stream.width, stream.height):
                expected = f"frames of one size, {stream.width}x{stream.height}"
                raise InputError(name, expected=expected, got=size, file=path)
            _tag(frame, kind.tags)
            try:
                container.mux(stream.encode(frame))
            except av.error.FFmpegError as error:
                raise InputError(f"{name} encoder refuses {size}", got=error.strerror, file=path) from error

        yield write
        container.mux(stream.encode(None))


def _tag(target: object, tags: dict[str, int]) -> None:
    for name, value in tags.items():
        setattr(target, name, value)
