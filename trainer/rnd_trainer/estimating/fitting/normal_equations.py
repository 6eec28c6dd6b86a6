"""Gauss-Newton normal equations of a clip: a banded matrix in time with a border of what all frames share."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, solve_triangular

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
        right = np.concatenate([self.gradient[..., None], self.border], axis=2)
        solved = self._solved(right, damping).reshape(frames * unknowns, -1)
        border = right[..., 1:].reshape(frames * unknowns, -1)
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

    def _solved(self, right: Floats, damping: float) -> Floats:
        """The banded matrix' inverse times ``right`` [T, D, R], by a Cholesky factor of its blocks."""
        rows: list[list[Floats]] = []  # rows[t][k]: the factor's block of the frames t and t − k
        solved = np.empty_like(right)
        for t in range(len(right)):
            row = [blocks[t - k].T for k, blocks in enumerate(self.blocks[: t + 1])]
            row[0] = row[0] + np.diag(damping * np.diagonal(row[0]) + 1e-6)
            rows.append(row)
            for k in reversed(range(len(row))):
                for j in range(k + 1, len(row)):
                    row[k] = row[k] - row[j] @ rows[t - k][j - k].T
                row[k] = _divided(row[k].T, rows[t - k][0]).T if k else np.linalg.cholesky(row[0])
            solved[t] = _divided(right[t] - sum(row[k] @ solved[t - k] for k in range(1, len(row))), row[0])
        for t in reversed(range(len(right))):
            later = range(1, min(len(self.blocks), len(right) - t))
            left = solved[t] - sum(rows[t + k][k].T @ solved[t + k] for k in later)
            solved[t] = _divided(left, rows[t][0], transposed=True)
        return solved


def _divided(right: Floats, factor: Floats, transposed: bool = False) -> Floats:
    """``right`` by a lower triangular ``factor``."""
    return np.asarray(solve_triangular(factor, right, trans=int(transposed), lower=True, check_finite=False))
