"""SOAP against its equations in numpy, and beside Adam on a badly conditioned least-squares problem."""

from __future__ import annotations

import numpy as np
import torch

from rnd_trainer.training.soap import BASIS_EVERY, COVARIANCE_DECAY, FLOOR, Soap

BETAS, RATE = (0.9, 0.99), 0.02


def _by_numpy(start: np.ndarray, grads: list[np.ndarray]) -> np.ndarray:
    """Algorithm 3 of the paper, with the basis corrected by a power iteration."""
    matrix, first = start.copy(), grads[0]
    left, right = first @ first.T, first.T @ first
    left_basis, right_basis = (np.linalg.eigh(c)[1][:, ::-1] for c in (left, right))
    mean, square = np.zeros_like(first), np.zeros_like(first)
    for step, grad in enumerate(grads[1:], 1):
        left = COVARIANCE_DECAY * left + (1 - COVARIANCE_DECAY) * grad @ grad.T
        right = COVARIANCE_DECAY * right + (1 - COVARIANCE_DECAY) * grad.T @ grad
        mean = BETAS[0] * mean + (1 - BETAS[0]) * grad
        square = BETAS[1] * square + (1 - BETAS[1]) * (left_basis.T @ grad @ right_basis) ** 2
        root = np.sqrt(square / (1 - BETAS[1] ** step))
        rotated = left_basis.T @ (mean / (1 - BETAS[0] ** step)) @ right_basis
        matrix -= RATE * left_basis @ (rotated / (root + FLOOR * root.max())) @ right_basis.T
        if step % BASIS_EVERY == 0:
            rows = np.argsort(-np.diag(left_basis.T @ left @ left_basis), kind="stable")
            columns = np.argsort(-np.diag(right_basis.T @ right @ right_basis), kind="stable")
            square = square[rows][:, columns]
            left_basis = np.linalg.qr(left @ left_basis[:, rows])[0]
            right_basis = np.linalg.qr(right @ right_basis[:, columns])[0]
    return matrix


def test_steps_are_the_papers() -> None:
    rng = np.random.default_rng(0)
    start, grads = rng.normal(size=(4, 4)), [rng.normal(size=(4, 4)) for _ in range(2 * BASIS_EVERY + 3)]
    matrix = torch.nn.Parameter(torch.from_numpy(start.copy()))
    soap = Soap([matrix], RATE, BETAS)
    for grad in grads:
        matrix.grad = torch.from_numpy(grad)
        soap.step()
    np.testing.assert_allclose(matrix.detach().numpy(), _by_numpy(start, grads), atol=1e-10)


def test_a_rotated_valley_is_descended_faster_than_by_adam() -> None:
    generator = torch.Generator().manual_seed(0)
    inputs = torch.randn(64, 8, generator=generator) * torch.logspace(0, -2, 8)
    inputs = inputs @ torch.linalg.qr(torch.randn(8, 8, generator=generator))[0]
    outputs = inputs @ torch.randn(8, 6, generator=generator)

    def loss_after(optimizer: str) -> float:
        matrix = torch.nn.Parameter(torch.zeros(8, 6))
        ours = Soap([matrix], RATE, BETAS) if optimizer == "soap" else torch.optim.Adam([matrix], RATE, BETAS)
        for _ in range(400):
            ours.zero_grad()
            loss = (inputs @ matrix - outputs).square().mean()
            loss.backward()
            ours.step()
        return float(loss.detach())

    assert loss_after("soap") < 0.01 * loss_after("adam")


def test_a_matrix_without_gradient_stays_where_it_is() -> None:
    matrix = torch.nn.Parameter(torch.ones(4, 4))
    soap = Soap([matrix], RATE, BETAS)
    for _ in range(BASIS_EVERY + 2):
        matrix.grad = torch.zeros(4, 4)
        soap.step()
    assert torch.equal(matrix, torch.ones(4, 4))
