"""Compiled structural similarity: the mean over an image and its gradient, in two passes."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor

_FAST = {"reassoc", "contract", "arcp", "nsz"}  # not nnan, ninf: a NaN must stay one
BANDS = 8
"""bands of rows per channel, with separate sums: deterministic for any number of threads"""


class MeanSsim(torch.autograd.Function):
    """Mean over the valid region of the SSIM of two images [H, W, C] float32; arguments as ``losses.metrics.ssim_map``.

    ``taps`` [T] is the symmetric window. Differentiable in the first image.
    """

    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor, taps: Tensor, c1: float, c2: float) -> Tensor:
        x, y = (np.ascontiguousarray(t.detach().permute(2, 0, 1).numpy()) for t in (image, target))
        window = taps.numpy()
        total, by_mean, by_square, by_product = _similarity(x, y, window, np.float32(c1), np.float32(c2))
        ctx.saved = x, y, window, by_mean, by_square, by_product
        return torch.tensor(total / by_mean.size, dtype=torch.float32)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        x, y, window, *partial = ctx.saved
        by_image = _gradient(x, y, window, *partial)
        scale = float(grad) / partial[0].size
        return torch.from_numpy(by_image).mul_(scale).permute(1, 2, 0), None, None, None, None


@numba.njit(parallel=True, cache=True, fastmath=_FAST, error_model="numpy")
def _similarity(x, y, taps, c1, c2):
    """Sum of SSIM (Wang et al. 2004, eq. 13) of images [C, H, W], and its derivatives [C, H', W'] by the windowed
    means of x, x² and x·y."""
    channels, height, width = x.shape
    length = taps.shape[0]
    rows, columns = height - length + 1, width - length + 1
    by_mean = np.empty((channels, rows, columns), np.float32)
    by_square, by_product = np.empty_like(by_mean), np.empty_like(by_mean)
    sums = np.zeros(channels * BANDS)
    two = np.float32(2)
    for job in numba.prange(channels * BANDS):
        c, band = job // BANDS, job % BANDS
        vertical, moments = np.empty((5, width), np.float32), np.empty((5, columns), np.float32)
        for row in range(band * rows // BANDS, (band + 1) * rows // BANDS):
            vertical[:] = np.float32(0)
            for t in range(length):
                a, b, weight = x[c, row + t], y[c, row + t], taps[t]
                for k in range(width):
                    wa, wb = weight * a[k], weight * b[k]
                    vertical[0, k] += wa
                    vertical[1, k] += wb
                    vertical[2, k] += wa * a[k]
                    vertical[3, k] += wb * b[k]
                    vertical[4, k] += wa * b[k]
            moments[:] = np.float32(0)
            for m in range(5):
                source, target = vertical[m], moments[m]
                for t in range(length):
                    weight = taps[t]
                    for k in range(columns):
                        target[k] += weight * source[k + t]
            total = np.float32(0)
            for k in range(columns):
                mean_x, mean_y = moments[0, k], moments[1, k]
                luminance = two * mean_x * mean_y + c1
                contrast = two * (moments[4, k] - mean_x * mean_y) + c2
                squares = mean_x * mean_x + mean_y * mean_y
                luminance_norm = squares + c1
                contrast_norm = moments[2, k] + moments[3, k] - squares + c2
                norm = np.float32(1) / (luminance_norm * contrast_norm)
                similarity = luminance * contrast * norm
                by_product[c, row, k] = two * luminance * norm
                by_square[c, row, k] = -similarity / contrast_norm
                by_mean[c, row, k] = two * mean_y * (contrast - luminance) * norm - two * mean_x * similarity * (
                    np.float32(1) / luminance_norm - np.float32(1) / contrast_norm
                )
                total += similarity
            sums[job] += total
    return sums.sum(), by_mean, by_square, by_product


@numba.njit(parallel=True, cache=True, fastmath=_FAST, error_model="numpy")
def _gradient(x, y, taps, by_mean, by_square, by_product):
    """Gradient [C, H, W] of the sum of SSIM by x: the window's transpose of the three derivatives."""
    channels, height, width = x.shape
    length = taps.shape[0]
    rows, columns = by_mean.shape[1:]
    grad = np.empty_like(x)
    for job in numba.prange(channels * BANDS):
        c, band = job // BANDS, job % BANDS
        vertical, full = np.empty((3, columns), np.float32), np.empty((3, width), np.float32)
        for row in range(band * height // BANDS, (band + 1) * height // BANDS):
            vertical[:] = np.float32(0)
            for t in range(max(0, row - rows + 1), min(length, row + 1)):
                weight = taps[t]
                mean, square, product = by_mean[c, row - t], by_square[c, row - t], by_product[c, row - t]
                for k in range(columns):
                    vertical[0, k] += weight * mean[k]
                    vertical[1, k] += weight * square[k]
                    vertical[2, k] += weight * product[k]
            full[:] = np.float32(0)
            for m in range(3):
                source, target = vertical[m], full[m]
                for t in range(length):
                    weight = taps[t]
                    for k in range(columns):
                        target[k + t] += weight * source[k]
            for k in range(width):
                grad[c, row, k] = full[0, k] + np.float32(2) * x[c, row, k] * full[1, k] + y[c, row, k] * full[2, k]
    return grad
