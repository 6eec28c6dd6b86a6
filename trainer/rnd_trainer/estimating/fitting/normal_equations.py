"""Gauss-Newton normal equations of a clip: a banded matrix in time with a border of what all frames share."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, cho_solve_banded, cholesky_banded

Floats = NDArray[np.float64]


class NormalEquations:
    """½ Σ w r² about a state of T frames with D unknowns each and G shared ones.

    Args:
        reach: frames ahead that a residual may tie a frame to.
    """

    def __init__(self, frames: int, unknowns: int, shared: int, reach: int = 2) -> None:
        self.blocks = [np.zeros((max(frames - k, 0), unknowns, unknowns)) for k in range(reach + 1)]
        self.border = np.zeros((frames, unknowns, shared))
        self.corner = np.zeros((shared, shared))
        self.gradient = np.zeros((frames, unknowns))
        self.shared_gradient = np.zeros(shared)

    def add(self, residual: Floats, weight: Floats, local: Floats, shared: Floats | None = None) -> None:
        """Residuals [T, m] of single frames with ``weight`` [T, m], derivatives [T, m, D] and [T, m, G]."""
        weighted = local * weight[..., None]
        turned = np.swapaxes(weighted, 1, 2)
        self.blocks[0] += turned @ local
        self.gradient += (turned @ residual[..., None])[..., 0]
        if shared is not None:
            self.border += turned @ shared
            flat = (shared * weight[..., None]).reshape(-1, shared.shape[-1])
            self.corner += flat.T @ shared.reshape(flat.shape)
            self.shared_gradient += flat.T @ residual.ravel()

    def add_chain(self, residual: Floats, weight: Floats, parts: list[Floats], gap: int = 1) -> None:
        """Residuals [N, m] of frames t, t + gap, …, t = 0…N − 1; ``parts[i]`` [N, m, D] of the i-th of them."""
        count = len(residual)
        for i, first in enumerate(parts):
            turned = np.swapaxes(first * weight[..., None], 1, 2)
            here = slice(i * gap, i * gap + count)
            self.gradient[here] += (turned @ residual[..., None])[..., 0]
            for j in range(i, len(parts)):
                self.blocks[(j - i) * gap][here] += turned @ parts[j]

    def add_shared(self, residual: Floats, weight: Floats, derivative: Floats) -> None:
        """Residuals [m] of the shared unknowns alone, with derivative [m, G]."""
        weighted = derivative * weight[:, None]
        self.corner += weighted.T @ derivative
        self.shared_gradient += weighted.T @ residual

    def solve(self, damping: float) -> tuple[Floats, Floats]:
        """The step [T, D], [G] that minimises the quadratic model, diagonals raised by ``damping`` of themselves."""
        frames, unknowns = self.gradient.shape
        factor = self._factor(damping)
        right = np.concatenate([self.gradient.reshape(-1, 1), self.border.reshape(frames * unknowns, -1)], axis=1)
        solved = cho_solve_banded((factor, True), right, check_finite=False)
        border = right[:, 1:]
        corner = self.corner * (1 + damping * np.eye(len(self.corner))) - border.T @ solved[:, 1:]
        corner += 1e-9 * np.eye(len(corner))
        shared = -cho_solve(cho_factor(corner), self.shared_gradient - border.T @ solved[:, 0])
        local = -solved[:, 0] - solved[:, 1:] @ shared
        return local.reshape(frames, unknowns), shared

    def variances(self) -> Floats:
        """Variance [T, D] of each unknown given the frame's neighbours: inverse of the banded matrix' own blocks.

        Neighbours' certainty enters by the smoothness terms; shared unknowns count as known.
        """
        blocks = self.blocks[0] + 1e-6 * np.eye(self.blocks[0].shape[-1])
        return np.diagonal(np.linalg.inv(blocks), axis1=1, axis2=2).copy()

    def _factor(self, damping: float) -> Floats:
        frames, unknowns = self.gradient.shape
        band = np.zeros((unknowns * len(self.blocks), frames * unknowns))  # lower form: band[i − j, j] = A[i, j]
        rows, columns = np.indices((unknowns, unknowns))
        for k, blocks in enumerate(self.blocks):
            if not len(blocks):
                continue
            turned = np.swapaxes(blocks, 1, 2) if k else blocks  # A[t + k, t]
            below = rows - columns + k * unknowns
            keep = below >= 0
            start = np.arange(len(blocks))[:, None] * unknowns
            band[below[keep][None], start + columns[keep][None]] = turned[:, keep]
        band[0] = band[0] * (1 + damping) + 1e-6
        return np.asarray(cholesky_banded(band, lower=True, check_finite=False))
