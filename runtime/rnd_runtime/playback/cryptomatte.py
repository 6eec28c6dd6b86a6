"""Coverage of named parts as Cryptomatte stores it: for each pixel the parts that cover most of it, by hashed name.

Source: Psyop, Cryptomatte specification 1.2.0; murmurhash3 (x86, 32 bit) by Appleby, public domain.
"""

from __future__ import annotations

import json
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.arrays import Floats32

LAYER = "CryptoPart"
RANKS = 6
"""parts of a pixel that are stored, two in each layer"""
CHANNELS = tuple(f"{LAYER}{level:02d}.{channel}" for level in range(RANKS // 2) for channel in "RGBA")
_MASK = 0xFFFFFFFF


def murmur3(text: str) -> int:
    """The 32-bit hash of ``text`` with seed 0."""
    data, state = text.encode(), 0
    for start in range(0, len(data) - 3, 4):
        state ^= _scrambled(int.from_bytes(data[start : start + 4], "little"))
        state = (_rotated(state, 13) * 5 + 0xE6546B64) & _MASK
    if tail := len(data) % 4:
        state ^= _scrambled(int.from_bytes(data[-tail:], "little"))
    state ^= len(data)
    state = ((state ^ state >> 16) * 0x85EBCA6B) & _MASK
    state = ((state ^ state >> 13) * 0xC2B2AE35) & _MASK
    return state ^ state >> 16


def identifier(text: str) -> np.float32:
    """The number that stands for ``text``: its hash as a float's bits, with an exponent that is a number's."""
    bits = murmur3(text)
    if bits >> 23 & 255 in (0, 255):
        bits ^= 1 << 23
    return np.float32(np.frombuffer(bits.to_bytes(4, "little"), "<f4")[0])


def layers(coverage: Floats32, names: Sequence[str]) -> Floats32:
    """Values [H, W, 2 · RANKS] of ``CHANNELS`` for the ``coverage`` [H, W, P] of parts with ``names``."""
    ranks = min(RANKS, coverage.shape[2])
    order = np.argsort(-coverage, axis=2, kind="stable")[..., :ranks]
    covered = np.take_along_axis(coverage, order, axis=2)
    ids = np.array([identifier(name) for name in names], np.float32)[order]
    values = np.zeros((*coverage.shape[:2], RANKS, 2), np.float32)
    values[..., :ranks, 0], values[..., :ranks, 1] = np.where(covered > 0, ids, 0), covered
    return values.reshape(*coverage.shape[:2], -1)


def attributes(names: Sequence[str]) -> dict[str, str]:
    """The metadata by which Cryptomatte's readers find the layer and its names."""
    manifest = {name: f"{int(np.array(identifier(name)).view(np.uint32)):08x}" for name in names}
    key = f"cryptomatte/{murmur3(LAYER):08x}"[: len("cryptomatte/") + 7]
    return {
        f"{key}/name": LAYER,
        f"{key}/hash": "MurmurHash3_32",
        f"{key}/conversion": "uint32_to_float32",
        f"{key}/manifest": json.dumps(manifest, separators=(",", ":")),
    }


def colours(coverage: Floats32) -> NDArray[np.uint8]:
    """An 8-bit image [H, W, 3] of ``coverage`` [H, W, P]: a colour for each part, on black."""
    hue = np.arange(coverage.shape[2]) * 0.618034 % 1
    palette = 0.5 + 0.5 * np.cos(2 * np.pi * (hue[:, None] + np.array([0, 1 / 3, 2 / 3])))
    image: NDArray[np.uint8] = np.rint(255 * np.clip(coverage @ palette.astype(np.float32), 0, 1)).astype(np.uint8)
    return image


def _rotated(value: int, count: int) -> int:
    """``value`` rotated left in 32 bits."""
    return (value << count | value >> 32 - count) & _MASK


def _scrambled(block: int) -> int:
    return _rotated(block * 0xCC9E2D51 & _MASK, 15) * 0x1B873593 & _MASK
