"""SOAP (Vyas et al. 2024, arXiv:2409.11321): Adam in the eigenbasis of each matrix's gradients."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

COVARIANCE_DECAY = 0.95
"""of the running means of G Gᵀ and Gᵀ G"""
BASIS_EVERY = 10
"""steps between two corrections of the bases, each by one power iteration"""
FLOOR, TINY = 1e-5, 1e-30
"""least divisor of a change, as a share of the largest and absolutely: the rotation's rounding must not move directions
without gradient"""


class Soap(torch.optim.Optimizer):
    """SOAP for matrices; the first step only initialises their bases.

    Args:
        params: matrices, or groups of them.
        lr: learning rate.
        betas: decay of the running means of the gradient and of its square.
    """

    def __init__(self, params: Any, lr: float, betas: tuple[float, float]) -> None:
        super().__init__(params, {"lr": lr, "betas": betas})

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> None:  # type: ignore[override]
        """Update all matrices that have a gradient."""
        assert closure is None
        for group in self.param_groups:
            for matrix in group["params"]:
                if matrix.grad is not None:
                    self._update(matrix, matrix.grad, group["lr"], group["betas"])

    def _update(self, matrix: Tensor, grad: Tensor, rate: float, betas: tuple[float, float]) -> None:
        state = self.state[matrix]
        if not state:
            state["left"], state["right"] = grad @ grad.T, grad.T @ grad
            state["left_basis"], state["right_basis"] = _eigenvectors(state["left"]), _eigenvectors(state["right"])
            state["mean"], state["square"] = torch.zeros_like(grad), torch.zeros_like(grad)
            state["step"] = torch.zeros(())
            return
        state["step"] += 1
        steps = int(state["step"])
        state["left"].lerp_(grad @ grad.T, 1 - COVARIANCE_DECAY)
        state["right"].lerp_(grad.T @ grad, 1 - COVARIANCE_DECAY)
        left, right = state["left_basis"], state["right_basis"]

        # Adam on the rotated gradient
        mean, square = state["mean"].lerp_(grad, 1 - betas[0]), state["square"]
        square.lerp_((left.T @ grad @ right).square_(), 1 - betas[1])
        root = (square / (1 - betas[1] ** steps)).sqrt_()
        root += FLOOR * root.max() + TINY
        change = left.T @ mean @ right / (1 - betas[0] ** steps) / root
        matrix.add_(left @ change @ right.T, alpha=-rate)

        if steps % BASIS_EVERY == 0:
            rows, columns = (_order(state[side], state[f"{side}_basis"]) for side in ("left", "right"))
            state["square"] = square[rows][:, columns]
            state["left_basis"] = torch.linalg.qr(state["left"] @ left[:, rows])[0]
            state["right_basis"] = torch.linalg.qr(state["right"] @ right[:, columns])[0]


def _eigenvectors(covariance: Tensor) -> Tensor:
    """Eigenvectors as columns, the largest eigenvalue's first."""
    return torch.linalg.eigh(covariance)[1].flip(1)


def _order(covariance: Tensor, basis: Tensor) -> Tensor:
    """Columns of ``basis`` by falling variance."""
    return torch.argsort((basis * (covariance @ basis)).sum(0), descending=True, stable=True)
