"""Metrics and losses against independent implementations and literal numbers."""

from __future__ import annotations

import math

import numpy as np
import pytest
import skimage.metrics
import torch

from rnd_runtime.core import images
from rnd_trainer.losses.losses import (
    chroma_prior,
    image_loss,
    linear_to_srgb,
    multiscale_dssim,
    skinning_divergence,
    sky_prior,
)
from rnd_trainer.losses.metrics import mask_box, mean_ssim, normal_degrees, psnr, ssim, ssim_map
from rnd_trainer.render.probe import LightProbes, natural_sky

SSIM_AGREEMENT = 1e-6  # float64 on both sides; the border is cut on both sides


def _pair() -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    smooth = torch.rand(1, 3, 8, 8, dtype=torch.float64, generator=generator)
    image = torch.nn.functional.interpolate(smooth, size=(40, 50), mode="bilinear")[0].permute(1, 2, 0)
    return image, (image + 0.1 * torch.randn(40, 50, 3, dtype=torch.float64, generator=generator)).clamp(0, 1)


def test_psnr_is_scikit_images() -> None:
    image, noisy = _pair()
    expected = skimage.metrics.peak_signal_noise_ratio(image.numpy(), noisy.numpy(), data_range=1)
    assert abs(psnr(image, noisy) - expected) < 1e-9
    assert psnr(image, image) == math.inf
    assert psnr(torch.zeros(2, 2, 1), torch.full((2, 2, 1), 0.1)) == pytest.approx(20)


def test_psnr_of_a_region_sees_only_the_region() -> None:
    image, noisy = _pair()
    where = torch.zeros(40, 50, dtype=torch.bool)
    where[5:9] = True
    assert psnr(image, noisy, where) == pytest.approx(psnr(image[5:9], noisy[5:9]))


def test_ssim_is_scikit_images() -> None:
    image, noisy = _pair()
    _, full = skimage.metrics.structural_similarity(
        image.numpy(),
        noisy.numpy(),
        data_range=1,
        channel_axis=2,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        win_size=11,
        full=True,
    )
    expected = full[5:-5, 5:-5]
    assert np.abs(ssim_map(image, noisy).numpy() - expected).max() < SSIM_AGREEMENT
    assert ssim(image, noisy) == pytest.approx(expected.mean(), abs=SSIM_AGREEMENT)
    assert ssim(image, image) == pytest.approx(1)


@pytest.mark.parametrize("size", [(11, 11), (24, 31), (12, 90)])
def test_compiled_ssim_equals_the_map_forward_and_by_gradient(size) -> None:
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(*size, 3, generator=generator)
    target = (image + 0.2 * torch.randn(image.shape, generator=generator)).clamp(0, 1)
    fast, slow = image.clone().requires_grad_(), image.double().requires_grad_()
    ours, expected = mean_ssim(fast, target), ssim_map(slow, target.double()).mean()
    (1 - 3 * ours).backward()
    (1 - 3 * expected).backward()
    assert float(ours.detach()) == pytest.approx(float(expected.detach()), abs=SSIM_AGREEMENT)
    assert float((fast.grad - slow.grad).norm() / slow.grad.norm()) < 1e-5


def test_normal_angle_is_exact_where_arccos_is_not() -> None:
    angle = math.radians(1e-4)
    a = torch.tensor([[[0.0, 0.0, -1.0]]], dtype=torch.float64)
    b = 3 * torch.tensor([[[math.sin(angle), 0.0, -math.cos(angle)]]], dtype=torch.float64)
    assert normal_degrees(a, b, torch.ones(1, 1, dtype=torch.bool)) == pytest.approx(1e-4, rel=1e-6)


def test_mask_box_is_tight_and_grows_by_its_margin() -> None:
    mask = torch.zeros(20, 30, dtype=torch.bool)
    mask[4:7, 10:20] = True
    assert mask_box(mask) == (slice(4, 7), slice(10, 20))
    assert mask_box(mask, 6) == (slice(0, 13), slice(4, 26))
    assert mask_box(torch.zeros(5, 6, dtype=torch.bool)) == (slice(0, 5), slice(0, 6))


def test_training_transfer_function_is_the_runtimes_below_one() -> None:
    linear = torch.linspace(0, 1, 257, dtype=torch.float64)
    assert np.abs(linear_to_srgb(linear).numpy() - images.linear_to_srgb(linear.numpy())).max() < 1e-12
    bright = torch.tensor([0.0, 0.001, 0.5, 1.5, 100.0], requires_grad=True)
    linear_to_srgb(bright).sum().backward()
    assert torch.isfinite(bright.grad).all() and (bright.grad > 0).all()
    assert linear_to_srgb(torch.tensor(2.0)) < 1.01


def test_image_loss_is_zero_for_equal_images_only() -> None:
    image, noisy = _pair()
    assert image_loss(image, image, 0.2) == pytest.approx(0, abs=1e-12)
    expected = (image - noisy).abs().mean() + 0.2 * (1 - ssim(image, noisy))
    assert image_loss(image, noisy, 0.2) == pytest.approx(float(expected))


def test_skinning_divergence_is_kullback_leibler() -> None:
    weights = torch.tensor([[0.5, 0.5], [1.0, 0.0]])
    template = torch.tensor([[0.5, 0.5], [0.5, 0.5]])
    assert float(skinning_divergence(weights, template.log())) == pytest.approx(0.5 * math.log(2))


def test_chroma_prior_sees_colour_in_every_direction_but_no_brightness() -> None:
    start = 0.1 + torch.rand(4, 8, 3)
    angles = torch.rand(4, 8)
    assert float(chroma_prior(start * (1 + torch.rand(4, 8, 1)), start, angles)) == pytest.approx(0, abs=1e-6)
    red, blue = torch.tensor([math.e, 1.0, 1.0]), torch.tensor([1.0, 1.0, math.e])
    assert float(chroma_prior(start * red, start, angles)) == pytest.approx(0.5, rel=1e-5)
    half = torch.stack([red, blue]).repeat(4, 4, 1)  # grey in the mean
    assert float(chroma_prior(start * half, start, angles)) == pytest.approx(0.5, rel=1e-5)


def test_sky_prior_is_zero_for_a_natural_sky_and_a_sun_costs_little() -> None:
    probe = LightProbes()
    sky = natural_sky(probe.directions[..., 1])[..., None].expand(-1, -1, 3)
    maps = probe.directions, probe.solid_angles
    assert float(sky_prior(3 * sky, *maps)) == pytest.approx(0, abs=1e-6)
    assert float(sky_prior(sky.flip(0), *maps)) > 0.05
    sunny = sky.clone()
    sunny[10, 20] *= 1e4
    share = float(probe.solid_angles[10, 20] / probe.solid_angles.sum())
    assert 0 < float(sky_prior(sunny, *maps)) < share


def test_multiscale_dssim_averages_the_scales_that_fit() -> None:
    image, noisy = _pair()  # 40 × 50: halves to 20 × 25, whose half is smaller than the window
    small = [x.unflatten(0, (20, 2)).unflatten(2, (25, 2)).mean((1, 3)) for x in (image, noisy)]
    expected = [1 - ssim(image, noisy), 1 - ssim(*small)]
    assert float(multiscale_dssim(image, noisy, 1)) == pytest.approx(expected[0])
    assert float(multiscale_dssim(image, noisy, 5)) == pytest.approx(np.mean(expected))
