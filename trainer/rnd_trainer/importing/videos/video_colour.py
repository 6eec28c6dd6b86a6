"""Decoded video frames as 8-bit sRGB: colour matrix, transfer function and primaries (ITU-T H.273)."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.images import linear_to_srgb, srgb_to_linear, to_bytes
from rnd_trainer.importing.images import Bytes

Floats32 = NDArray[np.float32]

WHITE = 203.0
"""cd/m² of reference white in HDR (ITU-R BT.2408); 255 in sRGB"""
_PEAK = 1000.0  # cd/m², the display for which HLG's system gamma is 1.2
_HLG_GAMMA = 1.2
_LUMINANCE_2020 = np.array([0.2627, 0.6780, 0.0593], np.float32)
_PQ, _HLG = 16, 18  # transfer characteristics
_HDR = {_PQ: "PQ", _HLG: "HLG"}
_BT709, _BT2020, _P3 = 1, 9, 12  # primaries
_UNSPECIFIED = 2
# Linear RGB → linear BT.709, from the primaries of BT.2020 (BT.2087) and of Display P3, both with D65
_TO_BT709 = {
    _BT2020: np.array(
        [[1.660491, -0.587641, -0.072850], [-0.124550, 1.132900, -0.008349], [-0.018151, -0.100579, 1.118730]],
        np.float32,
    ),
    _P3: np.array(
        [[1.224940, -0.224940, 0.0], [-0.042057, 1.042057, 0.0], [-0.019638, -0.078636, 1.098274]], np.float32
    ),
}
_MATRICES = {1: "itu709", 4: "fcc", 5: "itu601", 6: "itu601", 7: "smpte240m", 9: "bt2020"}
_UNREAD_TRANSFERS = {8: "linear", 9: "logarithmic", 10: "logarithmic", 17: "SMPTE ST 428"}
_UNREAD = {8: "YCgCo", 10: "BT.2020 of constant luminance", 11: "YDzDx", 12: "chromaticity-derived", 14: "ICtCp"}


def colour_notes(frame: Any) -> tuple[str, ...]:
    """What the conversion of ``frame`` changes beyond SDR's usual one, one sentence.

    Raises:
        InputError: a colour matrix or transfer function that is not read, or Dolby Vision without a base layer that
            others can show.
    """
    if (matrix := int(frame.colorspace)) in _UNREAD:
        raise InputError("colour matrix of the video", expected="BT.601, BT.709 or BT.2020", got=_UNREAD[matrix])
    transfer, primaries = int(frame.color_trc), int(frame.color_primaries)
    if transfer in _UNREAD_TRANSFERS:
        expected, got = "BT.709, sRGB, HLG or PQ", _UNREAD_TRANSFERS[transfer]
        raise InputError("transfer function of the video", expected=expected, got=got)
    dolby = any("DOVI" in str(data.type) for data in frame.side_data)
    if dolby and transfer == _UNSPECIFIED:
        hint = "export it as HLG or SDR"
        raise InputError("colours of the video", expected="HLG, PQ or SDR", got="Dolby Vision alone", hint=hint)
    if transfer in _HDR:
        what = f"{_HDR[transfer]} at {WHITE:g} cd/m² for white"
        return (f"HDR video: {what} is converted to sRGB; what is brighter than white is cut",)
    if primaries in _TO_BT709:
        return ("a video of wide gamut: converted to sRGB; colours beyond it are cut",)
    return ()


def to_srgb(frame: Any) -> Bytes:
    """Pixels [H, W, 3] of ``frame``, a PyAV video frame, as stored.

    HLG and PQ are linearised to display light (BT.2100), divided by ``WHITE`` and clipped. BT.2020 and Display P3
    become BT.709. The colour matrix is the stream's; by default BT.709 from 720 lines on, else BT.601.
    """
    transfer, primaries = int(frame.color_trc), int(frame.color_primaries)
    default = "itu709" if frame.height >= 720 else "itu601"
    matrix = _MATRICES.get(int(frame.colorspace), "bt2020" if primaries == _BT2020 else default)
    if transfer not in _HDR and primaries not in _TO_BT709:
        pixels: Bytes = frame.reformat(format="rgb24", src_colorspace=matrix).to_ndarray()
        return pixels
    linear = _linear_table(transfer)[frame.reformat(format="rgb48le", src_colorspace=matrix).to_ndarray()]
    if transfer == _HLG:  # the display's OOTF, of scene light
        luminance = (linear @ _LUMINANCE_2020)[..., None]
        linear *= _PEAK / WHITE * np.power(luminance, _HLG_GAMMA - 1)
    return to_bytes(linear_to_srgb(linear @ _to_bt709(transfer, primaries).T))


def _to_bt709(transfer: int, primaries: int) -> Floats32:
    """BT.2100 has BT.2020's primaries, where a stream does not state others."""
    if transfer in _HDR and primaries == _UNSPECIFIED:
        primaries = _BT2020
    return _TO_BT709.get(primaries, np.eye(3, dtype=np.float32))


@cache
def _linear_table(transfer: int) -> Floats32:
    """Linear light of every 16-bit value: relative to ``WHITE``; HLG's is the scene's, 1 at its peak."""
    signal = np.arange(1 << 16) / 65535
    if transfer == _PQ:  # BT.2100-2, table 4
        m1, m2, c1, c2, c3 = 2610 / 16384, 2523 / 32, 3424 / 4096, 2413 / 128, 2392 / 128
        root = signal ** (1 / m2)
        linear = 1e4 / WHITE * (np.maximum(root - c1, 0) / (c2 - c3 * root)) ** (1 / m1)
    elif transfer == _HLG:  # BT.2100-2, table 5
        a, b, c = 0.17883277, 0.28466892, 0.55991073
        linear = np.where(signal <= 0.5, signal**2 / 3, (np.exp((signal - c) / a) + b) / 12)
    else:
        linear = np.asarray(srgb_to_linear(signal), np.float64)
    return np.asarray(linear, np.float32)
