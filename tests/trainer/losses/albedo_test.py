"""The loss between splatted and estimated albedo: its value, what it ignores, and its robustness."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from rnd_trainer.losses.losses import ALBEDO_BLOCKS, MIN_ALBEDO, albedo_loss

SIDE = 3
HEIGHT, WIDTH = ALBEDO_BLOCKS * SIDE + 2, 5 * SIDE + 1  # more than whole blocks: the rest does not count


@pytest.fixture
def images() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Albedo, estimate and what is known of it."""
    rng = np.random.default_rng(3)
    albedo = rng.uniform(0.03, 0.8, (HEIGHT, WIDTH, 3))
    estimate = albedo * np.exp(rng.normal(0, 0.2, albedo.shape))
    known = rng.uniform(size=(HEIGHT, WIDTH)) < 0.7
    estimate[6:9] = 0.001  # below the floor
    return torch.from_numpy(albedo).float(), torch.from_numpy(estimate).float(), torch.from_numpy(known)


def _formula(albedo: np.ndarray, estimate: np.ndarray, known: np.ndarray) -> float:
    ratios = []
    for row in range(0, HEIGHT - SIDE + 1, SIDE):
        for column in range(0, WIDTH - SIDE + 1, SIDE):
            block = slice(row, row + SIDE), slice(column, column + SIDE)
            inside = known[block]
            if inside.sum() >= SIDE**2 / 2:
                first, second = (x[block][inside].sum(0) / SIDE**2 for x in (albedo, estimate))
                ratios.append(np.log(np.maximum(first, MIN_ALBEDO)) - np.log(np.maximum(second, MIN_ALBEDO)))
    ordered = np.sort(ratios, axis=0)
    return float(np.abs(ordered - ordered[(len(ordered) - 1) // 2]).mean())


def test_value_is_that_of_the_formula_in_float64(images) -> None:
    expected = _formula(*(x.numpy().astype(np.float64) for x in images[:2]), images[2].numpy())
    assert expected > 0.05
    assert float(albedo_loss(*images)) == pytest.approx(expected, rel=1e-5)


def test_brightness_and_tint_of_the_estimate_do_not_matter(images) -> None:
    albedo, estimate, known = images
    estimate = estimate.clamp(min=0.03)
    tinted = estimate * torch.tensor([1.4, 0.7, 1.1])
    assert float(albedo_loss(albedo, tinted, known)) == pytest.approx(float(albedo_loss(albedo, estimate, known)), 1e-5)
    assert float(albedo_loss(albedo, 0.5 * albedo, known)) == pytest.approx(0, abs=1e-6)


def test_details_of_the_estimate_do_not_matter(images) -> None:
    """Shuffled inside its blocks it is another image, and the same estimate."""
    albedo, estimate, _ = images
    shuffled = estimate.clone()
    for row in range(0, HEIGHT - SIDE + 1, SIDE):
        shuffled[row : row + SIDE] = estimate[row : row + SIDE].flip(0)
    known = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    assert not torch.equal(shuffled, estimate)
    assert float(albedo_loss(albedo, shuffled, known)) == pytest.approx(
        float(albedo_loss(albedo, estimate, known)), 1e-5
    )


def test_the_level_of_the_albedo_is_left_alone(images) -> None:
    """The derivative by a common factor per channel is at most one block's; by a single pixel it is not zero."""
    albedo, estimate, known = images
    level = torch.zeros(3, requires_grad=True)
    pixels = albedo.clone().requires_grad_()
    albedo_loss(pixels * level.exp(), estimate, known).backward()
    blocks = ALBEDO_BLOCKS * (WIDTH // SIDE)
    assert level.grad.abs().max() < 1.01 / (3 * 0.8 * blocks)
    assert ((pixels.grad != 0).any(-1) & known).sum() > 0.7 * known.sum()


def test_gross_errors_count_no_more_than_their_share(images) -> None:
    """A tenth of the estimate a hundred times too bright: the other blocks keep their gradients' signs."""
    albedo, estimate, known = images
    wrong = estimate.clone()
    wrong[: 2 * SIDE] *= 100
    gradients = []
    for target in (estimate, wrong):
        pixels = albedo.clone().requires_grad_()
        albedo_loss(pixels, target, known).backward()
        gradients.append(pixels.grad[2 * SIDE :].sign())
    assert (gradients[0] != gradients[1]).float().mean() < 0.2  # a mean instead of the median: 0.5


def test_without_blocks_it_is_zero(images) -> None:
    albedo, estimate, known = images
    assert float(albedo_loss(albedo, estimate, torch.zeros_like(known))) == 0
