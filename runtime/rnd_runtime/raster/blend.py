"""Blending of tiles, front to back, and its gradient (numba, sixteen lanes).

A tile is 4×4 blocks of 4×4 pixels; a block is one 16-lane SIMD vector. Threads take tiles one by one, fullest first;
the result does not depend on the thread, to the bit.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from rnd_runtime.core.simd.arithmetic import (
    any_lane,
    bits,
    block_x,
    block_y,
    exp2,
    lanes,
    lowest_bit,
    magnitude,
    reduce_add,
    select,
)
from rnd_runtime.core.simd.memory import aligned_floats, fetch_add, load, prefetch, store
from rnd_runtime.core.simd.vectors import WIDTH

from . import project
from .outline import sharpening
from .project import TILE

BLOCK = 4
HALF_BLOCK = np.float32(1.5)  # px from a block's centre to its outer pixel centres
BLOCKS = TILE // BLOCK
PIXELS = TILE * TILE
ALL_BLOCKS = (1 << (BLOCKS * BLOCKS)) - 1
LOG2_ALPHA_MIN = np.float32(project.LOG2_ALPHA_MIN)
LOG2_ALPHA_NEARLY_MIN = LOG2_ALPHA_MIN - np.float32(1e-3)  # margin for rounding
LOG2_ALPHA_MAX = np.float32(math.log2(0.99))
TRANSMITTANCE_MIN = np.float32(0.9999e-4)  # see raster.oracle
LN2 = np.float32(math.log(2.0))
ZERO, ONE = np.float32(0), np.float32(1)
NEVER = np.float32(-1e30)  # log2 of opacity 0
MOMENTS = 6
BATCH = 4 * WIDTH  # Gaussians gathered at a time, one bit of an int64 each
_Y, _SHEAR, _FALL_Y, _FALL_X, _PEAK = (BATCH * k for k in range(1, 6))  # offsets in gathered shapes, after x


@njit(inline="always")
def _centers(block):  # type: ignore[no-untyped-def]
    """Columns and rows of a block's pixel centres in the tile."""
    x = block_x() + np.float32(block % BLOCKS * BLOCK + 0.5)
    y = block_y() + np.float32(block // BLOCKS * BLOCK + 0.5)
    return x, y


@njit(inline="always")
def _start_tile(tile_x, tile_y, width, height, transmittance):  # type: ignore[no-untyped-def]
    """Set transmittance to 1 inside the image, 0 outside."""
    for block in range(BLOCKS * BLOCKS):
        x, y = _centers(block)
        inside = (x < np.float32(width - tile_x)) & (y < np.float32(height - tile_y))
        store(transmittance, block * WIDTH, select(inside, ONE, ZERO))


@njit(inline="always")
def _may_reach(dx, dy, shear, fall_y, fall_x, peak):  # type: ignore[no-untyped-def]
    """Bit mask of the sixteen block centres, ``dx``, ``dy`` from a Gaussian, in whose block α may reach 1/255.

    A block's pixel centres are within 1.5 px: |dy| and |dx − shear·dy| are at least those of the block's centre
    less 1.5 and 1.5·(1 + |shear|).
    """
    d = magnitude(dx - shear * dy) - (magnitude(shear) * HALF_BLOCK + HALF_BLOCK)
    dy = magnitude(dy) - HALF_BLOCK
    dy, d = select(dy > ZERO, dy, ZERO), select(d > ZERO, d, ZERO)
    return bits(peak - fall_y * dy * dy - fall_x * d * d >= LOG2_ALPHA_NEARLY_MIN)


@njit(inline="always")
def _gather(first, last, splats, tile_x, tile_y, shapes, colours, columns):  # type: ignore[no-untyped-def]
    """Gather a batch: ``shapes`` by component, ``colours`` [BATCH, columns]; the rest of the batch has opacity 0."""
    channels = splats.attributes.shape[1]
    for k in range(last - first):
        g = splats.pair_gaussians[first + k]
        shapes[k] = np.float32(splats.centers[g, 0] - tile_x)
        shapes[_Y + k] = np.float32(splats.centers[g, 1] - tile_y)
        for c in range(4):
            shapes[_SHEAR + c * BATCH + k] = splats.shapes[g, c]
        for c in range(channels):
            colours[k * columns + c] = splats.attributes[g, c]
    for k in range(last - first, BATCH):
        for c in range(5):
            shapes[c * BATCH + k] = ZERO
        shapes[_PEAK + k] = NEVER


@njit(inline="always")
def _prefetch_batch(first, last, splats):  # type: ignore[no-untyped-def]
    """Prefetch the Gaussians of a later batch."""
    for pair in range(first, last):
        g = splats.pair_gaussians[pair]
        prefetch(splats.centers, 2 * g)
        prefetch(splats.shapes, 4 * g)
        prefetch(splats.attributes, splats.attributes.shape[1] * g)


@njit(inline="always")
def _overlap_mask(block, count, shapes):  # type: ignore[no-untyped-def]
    """Bit mask of the ``count`` gathered Gaussians that may reach a block."""
    row = np.float32(block // BLOCKS * BLOCK + 0.5 * BLOCK)
    column = np.float32(block % BLOCKS * BLOCK + 0.5 * BLOCK)
    reaching = 0
    for k in range(0, count, WIDTH):
        dx, dy = column - load(shapes, k), row - load(shapes, _Y + k)
        shear, peak = load(shapes, _SHEAR + k), load(shapes, _PEAK + k)
        fall_y, fall_x = load(shapes, _FALL_Y + k), load(shapes, _FALL_X + k)
        reaching |= _may_reach(dx, dy, shear, fall_y, fall_x, peak) << k
    return reaching


@njit(inline="always")
def _weights(block, reaching, shapes, transmittance, weights):  # type: ignore[no-untyped-def]
    """Fill ``weights`` [BATCH, 16] of Gaussians ``reaching`` a block; takes and returns its ``transmittance``."""
    columns, rows = _centers(block)
    while reaching != 0:
        k = lowest_bit(reaching)
        reaching &= reaching - 1
        dy = rows - shapes[_Y + k]
        d = columns - shapes[k] - shapes[_SHEAR + k] * dy
        power = shapes[_PEAK + k] - shapes[_FALL_Y + k] * dy * dy - shapes[_FALL_X + k] * d * d
        alpha = exp2(select(power < LOG2_ALPHA_MAX, power, LOG2_ALPHA_MAX))
        weight = transmittance * select(power >= LOG2_ALPHA_MIN, alpha, ZERO)
        after = transmittance - weight
        unfinished = after >= TRANSMITTANCE_MIN
        store(weights, k * WIDTH, select(unfinished, weight, ZERO))
        transmittance = select(unfinished, after, ZERO)
    return transmittance


@njit(inline="always")
def _accumulate(at, reaching, weights, colours, first, columns, sums):  # type: ignore[no-untyped-def]
    """Add four attributes, from ``first`` on, to ``sums`` at ``at``."""
    a, b, c, d = (load(sums, at), load(sums, at + WIDTH), load(sums, at + 2 * WIDTH), load(sums, at + 3 * WIDTH))
    while reaching != 0:
        k = lowest_bit(reaching)
        reaching &= reaching - 1
        weight, row = load(weights, k * WIDTH), k * columns + first
        a += weight * colours[row]
        b += weight * colours[row + 1]
        c += weight * colours[row + 2]
        d += weight * colours[row + 3]
    store(sums, at, a)
    store(sums, at + WIDTH, b)
    store(sums, at + 2 * WIDTH, c)
    store(sums, at + 3 * WIDTH, d)


@njit(error_model="numpy")
def _blend_tile(tile_x, tile_y, first, last, splats, buffers):  # type: ignore[no-untyped-def]
    """Add K blended attributes, then alpha, padded to a multiple of four, to each block's sums.

    Works by batch and block, so that a block's sums stay in registers.
    """
    transmittance, sums, shapes, colours, weights = buffers
    columns = len(colours) // BATCH
    open_blocks = ALL_BLOCKS
    for start in range(first, last, BATCH):
        count = min(BATCH, last - start)
        _gather(start, start + count, splats, tile_x, tile_y, shapes, colours, columns)
        _prefetch_batch(start + count, min(start + count + BATCH, last), splats)
        blocks = open_blocks
        while blocks != 0:
            block = lowest_bit(blocks)
            blocks &= blocks - 1
            reaching = _overlap_mask(block, count, shapes)
            if reaching == 0:
                continue
            after = _weights(block, reaching, shapes, load(transmittance, block * WIDTH), weights)
            store(transmittance, block * WIDTH, after)
            if not any_lane(after > ZERO):
                open_blocks &= ~(1 << block)
            for c in range(0, columns, 4):
                _accumulate((block * columns + c) * WIDTH, reaching, weights, colours, c, columns, sums)
        if open_blocks == 0:
            break


@njit(inline="always")
def _tiles_by_load(starts):  # type: ignore[no-untyped-def]
    return np.argsort(starts[:-1] - starts[1:], kind="mergesort")


@njit(parallel=True, error_model="numpy", nogil=True, cache=True)
def blend(splats, width, height, threads, outlines):  # type: ignore[no-untyped-def]
    """Attributes [H, W, K] and alpha [H, W]; with ``outlines`` they are sharpened (``.outline``)."""
    channels = splats.attributes.shape[1]
    columns = channels // 4 * 4 + 4  # with alpha, padded to a multiple of four
    image, coverage = np.empty((height, width, channels), np.float32), np.empty((height, width), np.float32)
    tiles_x = (width + TILE - 1) // TILE
    starts = splats.tile_starts
    tiles = _tiles_by_load(starts)
    counter = np.zeros(1, np.int64)
    for y in prange(height):  # a seventh of the time that it takes tile by tile
        image[y], coverage[y] = ZERO, ZERO
    for _ in prange(threads):
        transmittance, sums = aligned_floats(PIXELS), aligned_floats(columns * PIXELS)
        shapes, weights = aligned_floats(6 * BATCH), aligned_floats(BATCH * WIDTH)
        colours = aligned_floats(columns * BATCH)
        colours[:] = ZERO
        colours[channels::columns] = ONE  # alpha
        buffers = (transmittance, sums, shapes, colours, weights)
        while True:
            n = fetch_add(counter)
            if n >= tiles.size or starts[tiles[n]] == starts[tiles[n] + 1]:
                break
            tile = tiles[n]
            tile_x, tile_y = tile % tiles_x * TILE, tile // tiles_x * TILE
            _start_tile(tile_x, tile_y, width, height, transmittance)
            sums[:] = ZERO
            _blend_tile(tile_x, tile_y, starts[tile], starts[tile + 1], splats, buffers)
            for y in range(min(TILE, height - tile_y)):
                for x in range(min(TILE, width - tile_x)):
                    block, lane = y // BLOCK * BLOCKS + x // BLOCK, y % BLOCK * BLOCK + x % BLOCK
                    at = block * columns * WIDTH + lane
                    covered = sums[at + channels * WIDTH]
                    factor = sharpening(covered) if outlines else ONE
                    for c in range(channels):
                        image[tile_y + y, tile_x + x, c] = sums[at + c * WIDTH] * factor
                    coverage[tile_y + y, tile_x + x] = covered * factor
    return image, coverage


@njit(error_model="numpy")
def _blend_tile_backward(tile_x, tile_y, first, last, splats, buffers, slots):  # type: ignore[no-untyped-def]
    """Replay a tile front to back and fill the ``slots`` of its pairs.

    ``remaining`` holds the gradient-weighted sum of what is still behind, so no transmittance is recovered by division.
    ``wanted`` holds each block's incoming gradients of K attributes, then alpha.
    """
    transmittance, remaining, wanted, gathered = buffers
    centers, shapes, attributes = splats.centers, splats.shapes, splats.attributes
    pair_gaussians, pair_slots = splats.pair_gaussians, splats.pair_slots
    channels = attributes.shape[1]
    stride = (channels + 1) * WIDTH
    open_blocks = ALL_BLOCKS
    for pair in range(first, last):
        g, slot = pair_gaussians[pair], pair_slots[pair]
        x, y = np.float32(centers[g, 0] - tile_x), np.float32(centers[g, 1] - tile_y)
        shear, fall_y, fall_x, peak = shapes[g, 0], shapes[g, 1], shapes[g, 2], shapes[g, 3]
        dx = block_x() * np.float32(BLOCK) + (np.float32(0.5 * BLOCK) - x)  # of the tile's blocks
        dy = block_y() * np.float32(BLOCK) + (np.float32(0.5 * BLOCK) - y)
        reached = _may_reach(dx, dy, lanes(shear), fall_y, fall_x, peak) & open_blocks
        if reached == 0:
            for k in range(MOMENTS + channels):
                slots[slot, k] = ZERO
            continue
        s, sd, sdd, sy, syy, sdy = (lanes(ZERO), lanes(ZERO), lanes(ZERO), lanes(ZERO), lanes(ZERO), lanes(ZERO))
        for c in range(channels):
            store(gathered, c * WIDTH, lanes(ZERO))
        while reached != 0:
            block = lowest_bit(reached)
            reached &= reached - 1
            columns, rows = _centers(block)
            dy = rows - y
            d = columns - x - shear * dy
            power = peak - fall_y * dy * dy - fall_x * d * d
            alpha = exp2(select(power < LOG2_ALPHA_MAX, power, LOG2_ALPHA_MAX))
            before = load(transmittance, block * WIDTH)
            hit = power >= LOG2_ALPHA_MIN
            weight = before * select(hit, alpha, ZERO)
            after = before - weight
            unfinished = after >= TRANSMITTANCE_MIN
            weight = select(unfinished, weight, ZERO)
            store(transmittance, block * WIDTH, select(unfinished, after, ZERO))
            if not any_lane(unfinished):
                open_blocks &= ~(1 << block)
            at = block * stride
            value = load(wanted, at + channels * WIDTH)
            for c in range(channels):
                gradient = load(wanted, at)
                value += gradient * attributes[g, c]
                store(gathered, c * WIDTH, load(gathered, c * WIDTH) + weight * gradient)
                at += WIDTH
            rest = load(remaining, block * WIDTH) - weight * value
            store(remaining, block * WIDTH, rest)
            # ∂L/∂log2 α = ln2·(w·value − rest·α/(1 − α))
            gradient = LN2 * (weight * value - rest * (alpha / (ONE - alpha)))
            gradient = select(hit & unfinished & (power < LOG2_ALPHA_MAX), gradient, ZERO)
            gd, gy = gradient * d, gradient * dy
            s += gradient
            sd += gd
            sdd += gd * d
            sy += gy
            syy += gy * dy
            sdy += gd * dy
        slots[slot, 0], slots[slot, 1], slots[slot, 2] = reduce_add(s), reduce_add(sd), reduce_add(sdd)
        slots[slot, 3], slots[slot, 4], slots[slot, 5] = reduce_add(sy), reduce_add(syy), reduce_add(sdy)
        for c in range(channels):
            slots[slot, MOMENTS + c] = reduce_add(load(gathered, c * WIDTH))


@njit(parallel=True, error_model="numpy", nogil=True, cache=True)
def blend_backward(splats, image, coverage, grad_image, grad_coverage, threads):  # type: ignore[no-untyped-def]
    """Gradients [P, 6 + K] of each (Gaussian, tile) pair.

    Six moments of g = ∂L/∂log2 α over the tile's pixels (Σg, Σg·d, Σg·d², Σg·dy, Σg·dy², Σg·d·dy), then K attribute
    gradients. ``image`` and ``coverage`` are the results of ``blend``.
    """
    height, width, channels = image.shape
    slots = np.empty((splats.pair_slots.size, MOMENTS + channels), np.float32)
    tiles_x = (width + TILE - 1) // TILE
    starts = splats.tile_starts
    tiles = _tiles_by_load(starts)
    counter = np.zeros(1, np.int64)
    for _ in prange(threads):
        transmittance, remaining = aligned_floats(PIXELS), aligned_floats(PIXELS)
        wanted, gathered = aligned_floats((channels + 1) * PIXELS), aligned_floats(channels * WIDTH)
        buffers = (transmittance, remaining, wanted, gathered)
        while True:
            n = fetch_add(counter)
            if n >= tiles.size or starts[tiles[n]] == starts[tiles[n] + 1]:
                break
            tile = tiles[n]
            tile_x, tile_y = tile % tiles_x * TILE, tile // tiles_x * TILE
            _start_tile(tile_x, tile_y, width, height, transmittance)
            wanted[:] = ZERO
            remaining[:] = ZERO
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
                    remaining[block * WIDTH + lane] = value
            _blend_tile_backward(tile_x, tile_y, starts[tile], starts[tile + 1], splats, buffers, slots)
    return slots
