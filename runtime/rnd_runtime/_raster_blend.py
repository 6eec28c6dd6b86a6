"""Blending of tiles, front to back, and its gradient (numba over sixteen lanes).

A tile is 4×4 blocks of 4×4 pixels; a block is one value of sixteen lanes. Tiles are handed to threads one
by one, the fullest first; which thread draws a tile changes no bit of it.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from ._raster_lanes import (
    WIDTH,
    aligned_floats,
    any_lane,
    block_x,
    block_y,
    exp2,
    fetch_add,
    lanes,
    load,
    select,
    store,
    total,
)
from ._raster_project import TILE

BLOCK = 4
BLOCKS = TILE // BLOCK
PIXELS = TILE * TILE
LOG2_ALPHA_MIN = np.float32(-math.log2(255.0))
LOG2_ALPHA_MAX = np.float32(math.log2(0.99))
TRANSMITTANCE_MIN = np.float32(1e-4)
LN2 = np.float32(math.log(2.0))
ZERO = np.float32(0)
ONE = np.float32(1)
MOMENTS = 6
CHECK_EVERY = 32  # Gaussians between two looks at whether the tile is saturated


@njit(inline="always")
def _block_range(box, tile_x, tile_y):  # type: ignore[no-untyped-def]
    """First and last block of the tile that the pixel box touches: x0, x1, y0, y1."""
    return (
        max(box[0] - tile_x, 0) // BLOCK,
        min(box[2] - tile_x, TILE - 1) // BLOCK,
        max(box[1] - tile_y, 0) // BLOCK,
        min(box[3] - tile_y, TILE - 1) // BLOCK,
    )


@njit(inline="always")
def _start_transmittance(transmittance, tile_x, tile_y, width, height):  # type: ignore[no-untyped-def]
    """1 inside the picture, 0 (as if saturated) outside."""
    for by in range(BLOCKS):
        for bx in range(BLOCKS):
            inside_x = block_x() + np.float32(tile_x + bx * BLOCK) < np.float32(width)
            inside_y = block_y() + np.float32(tile_y + by * BLOCK) < np.float32(height)
            store(transmittance, (by * BLOCKS + bx) * WIDTH, select(inside_x & inside_y, ONE, ZERO))


@njit(inline="always")
def _saturated(transmittance):  # type: ignore[no-untyped-def]
    left = lanes(ZERO)
    for block in range(BLOCKS * BLOCKS):
        left += load(transmittance, block * WIDTH)
    return not any_lane(left > ZERO)


@njit
def _blend_tile(tile_x, tile_y, first, last, splats, width, height, transmittance, sums):  # type: ignore[no-untyped-def]
    """Fill ``sums``: for each block K blended attributes, then alpha (sixteen lanes each)."""
    channels = splats.attributes.shape[1]
    stride = (channels + 1) * WIDTH
    _start_transmittance(transmittance, tile_x, tile_y, width, height)
    sums[: BLOCKS * BLOCKS * stride] = ZERO
    x_in_block, y_in_block = block_x() + np.float32(0.5), block_y() + np.float32(0.5)
    for pair in range(first, last):
        if (pair - first) % CHECK_EVERY == CHECK_EVERY - 1 and _saturated(transmittance):
            return
        g = splats.pair_gaussians[pair]
        x = np.float32(splats.centers[g, 0] - tile_x)
        y = np.float32(splats.centers[g, 1] - tile_y)
        shear, fall_y, fall_x, peak = splats.shapes[g]
        bx0, bx1, by0, by1 = _block_range(splats.boxes[g], tile_x, tile_y)
        for by in range(by0, by1 + 1):
            dy = y_in_block + (np.float32(by * BLOCK) - y)
            top = peak - fall_y * dy * dy
            dx = x_in_block - x - shear * dy
            for bx in range(bx0, bx1 + 1):
                block = by * BLOCKS + bx
                before = load(transmittance, block * WIDTH)
                d = dx + np.float32(bx * BLOCK)
                power = top - fall_x * d * d
                hit = (power >= LOG2_ALPHA_MIN) & (before > ZERO)
                if any_lane(hit):
                    alpha = exp2(select(power < LOG2_ALPHA_MAX, power, LOG2_ALPHA_MAX))
                    weight = before * select(hit, alpha, ZERO)
                    after = before - weight
                    open_ = after >= TRANSMITTANCE_MIN
                    weight = select(open_, weight, ZERO)
                    store(transmittance, block * WIDTH, select(open_, after, ZERO))
                    at = block * stride
                    for c in range(channels):
                        store(sums, at, load(sums, at) + weight * splats.attributes[g, c])
                        at += WIDTH
                    store(sums, at, load(sums, at) + weight)


@njit(inline="always")
def _fullest_first(starts):  # type: ignore[no-untyped-def]
    return np.argsort(starts[:-1] - starts[1:], kind="mergesort")


@njit(parallel=True, error_model="numpy", nogil=True, cache=True)
def blend(splats, width, height, threads):  # type: ignore[no-untyped-def]
    """Pictures [H, W, K] of the attributes and [H, W] of alpha."""
    channels = splats.attributes.shape[1]
    image, coverage = np.zeros((height, width, channels), np.float32), np.zeros((height, width), np.float32)
    tiles_x = (width + TILE - 1) // TILE
    starts = splats.tile_starts
    tiles = _fullest_first(starts)
    counter = np.zeros(1, np.int64)
    for _ in prange(threads):
        transmittance = aligned_floats(PIXELS)
        sums = aligned_floats((channels + 1) * PIXELS)
        while True:
            n = fetch_add(counter)
            if n >= tiles.size or starts[tiles[n]] == starts[tiles[n] + 1]:
                break
            tile = tiles[n]
            tile_x, tile_y = tile % tiles_x * TILE, tile // tiles_x * TILE
            _blend_tile(
                tile_x, tile_y, starts[tile], starts[tile + 1], splats, width, height, transmittance, sums
            )
            for y in range(min(TILE, height - tile_y)):
                for x in range(min(TILE, width - tile_x)):
                    block, lane = y // BLOCK * BLOCKS + x // BLOCK, y % BLOCK * BLOCK + x % BLOCK
                    at = block * (channels + 1) * WIDTH + lane
                    for c in range(channels):
                        image[tile_y + y, tile_x + x, c] = sums[at + c * WIDTH]
                    coverage[tile_y + y, tile_x + x] = sums[at + channels * WIDTH]
    return image, coverage


@njit
def _blend_tile_backward(tile_x, tile_y, first, last, splats, buffers, slots):  # type: ignore[no-untyped-def]
    """Replay the tile front to back; one scalar a pixel (what is still to come behind, weighted by the
    incoming gradients) replaces the transmittance's recovery by division.

    ``wanted`` holds, for each block, the incoming gradients of K attributes, then of alpha.
    """
    transmittance, behind, wanted, gathered = buffers
    channels = splats.attributes.shape[1]
    stride = (channels + 1) * WIDTH
    x_in_block, y_in_block = block_x() + np.float32(0.5), block_y() + np.float32(0.5)
    for pair in range(first, last):
        slot = splats.pair_slots[pair]
        if (pair - first) % CHECK_EVERY == CHECK_EVERY - 1 and _saturated(transmittance):
            for rest in range(pair, last):
                slots[splats.pair_slots[rest]] = ZERO
            return
        g = splats.pair_gaussians[pair]
        x = np.float32(splats.centers[g, 0] - tile_x)
        y = np.float32(splats.centers[g, 1] - tile_y)
        shear, fall_y, fall_x, peak = splats.shapes[g]
        bx0, bx1, by0, by1 = _block_range(splats.boxes[g], tile_x, tile_y)
        s, sd, sdd = lanes(ZERO), lanes(ZERO), lanes(ZERO)
        sy, syy, sdy = lanes(ZERO), lanes(ZERO), lanes(ZERO)
        for c in range(channels):
            store(gathered, c * WIDTH, lanes(ZERO))
        for by in range(by0, by1 + 1):
            dy = y_in_block + (np.float32(by * BLOCK) - y)
            top = peak - fall_y * dy * dy
            dx = x_in_block - x - shear * dy
            for bx in range(bx0, bx1 + 1):
                block = by * BLOCKS + bx
                before = load(transmittance, block * WIDTH)
                d = dx + np.float32(bx * BLOCK)
                power = top - fall_x * d * d
                hit = (power >= LOG2_ALPHA_MIN) & (before > ZERO)
                if any_lane(hit):
                    alpha = exp2(select(power < LOG2_ALPHA_MAX, power, LOG2_ALPHA_MAX))
                    weight = before * select(hit, alpha, ZERO)
                    after = before - weight
                    open_ = after >= TRANSMITTANCE_MIN
                    weight = select(open_, weight, ZERO)
                    store(transmittance, block * WIDTH, select(open_, after, ZERO))
                    at = block * stride
                    value = load(wanted, at + channels * WIDTH)
                    for c in range(channels):
                        gradient = load(wanted, at)
                        value += gradient * splats.attributes[g, c]
                        store(gathered, c * WIDTH, load(gathered, c * WIDTH) + weight * gradient)
                        at += WIDTH
                    rest = load(behind, block * WIDTH) - weight * value
                    store(behind, block * WIDTH, rest)
                    # ∂L/∂log2 α = ln2·(w·value − rest·α/(1 − α)), the second by every Gaussian behind
                    gradient = LN2 * (weight * value - rest * (alpha / (ONE - alpha)))
                    gradient = select(hit & open_ & (power < LOG2_ALPHA_MAX), gradient, ZERO)
                    s += gradient
                    gd, gy = gradient * d, gradient * dy
                    sd += gd
                    sdd += gd * d
                    sy += gy
                    syy += gy * dy
                    sdy += gd * dy
        slots[slot, 0], slots[slot, 1], slots[slot, 2] = total(s), total(sd), total(sdd)
        slots[slot, 3], slots[slot, 4], slots[slot, 5] = total(sy), total(syy), total(sdy)
        for c in range(channels):
            slots[slot, MOMENTS + c] = total(load(gathered, c * WIDTH))


@njit(parallel=True, error_model="numpy", nogil=True, cache=True)
def blend_backward(splats, image, coverage, grad_image, grad_coverage, threads):  # type: ignore[no-untyped-def]
    """Gradients of each (Gaussian, tile) pair: slots [P, 6 + K].

    Six moments of g = ∂L/∂log2 α over the tile's pixels (Σg, Σg·d, Σg·d², Σg·dy, Σg·dy², Σg·d·dy), then K
    gradients of the attributes. ``image`` and ``coverage`` are :func:`blend`'s.
    """
    height, width, channels = image.shape
    slots = np.empty((splats.pair_slots.size, MOMENTS + channels), np.float32)
    tiles_x = (width + TILE - 1) // TILE
    starts = splats.tile_starts
    tiles = _fullest_first(starts)
    counter = np.zeros(1, np.int64)
    for _ in prange(threads):
        transmittance, behind = aligned_floats(PIXELS), aligned_floats(PIXELS)
        wanted, gathered = aligned_floats((channels + 1) * PIXELS), aligned_floats(channels * WIDTH)
        buffers = (transmittance, behind, wanted, gathered)
        while True:
            n = fetch_add(counter)
            if n >= tiles.size or starts[tiles[n]] == starts[tiles[n] + 1]:
                break
            tile = tiles[n]
            tile_x, tile_y = tile % tiles_x * TILE, tile // tiles_x * TILE
            _start_transmittance(transmittance, tile_x, tile_y, width, height)
            wanted[:] = ZERO
            behind[:] = ZERO
            for y in range(min(TILE, height - tile_y)):
                for x in range(min(TILE, width - tile_x)):
                    block, lane = y // BLOCK * BLOCKS + x // BLOCK, y % BLOCK * BLOCK + x % BLOCK
                    at = block * (channels + 1) * WIDTH + lane
                    row, column = tile_y + y, tile_x + x
                    value = grad_coverage[row, column] * coverage[row, column]
                    for c in range(channels):
                        wanted[at + c * WIDTH] = grad_image[row, column, c]
                        value += grad_image[row, column, c] * image[row, column, c]
                    wanted[at + channels * WIDTH] = grad_coverage[row, column]
                    behind[block * WIDTH + lane] = value
            _blend_tile_backward(tile_x, tile_y, starts[tile], starts[tile + 1], splats, buffers, slots)
    return slots
