"""The learnable probe, sampling of its texels, and the trainer's shading against the runtime's oracle."""

from __future__ import annotations

import math

import numpy as np
import torch

from rnd_runtime.core.gaussians import Gaussians
from rnd_runtime.shading.light import Light
from rnd_runtime.shading.reference import shade_reference
from rnd_trainer.render.probe import LightProbes, all_texels, luminance, sample_texels
from rnd_trainer.render.shading import light_visibility, shade

FLOAT32_RELATIVE = 2e-4  # a sum of 2 048 float32 terms, GGX peaks among them


def _sunny() -> torch.Tensor:
    radiance = 0.2 + torch.rand(32, 64, 3, generator=torch.Generator().manual_seed(0))
    radiance[9, 40] = 3e4
    return radiance


def test_probe_starts_white_with_mean_luminance_one() -> None:
    probe = LightProbes()
    assert torch.allclose(probe.radiance(), torch.ones(1, 32, 64, 3), atol=1e-5)
    with torch.no_grad():
        probe.raw.add_(5 * torch.randn_like(probe.raw))
    mean = (luminance(probe.radiance().detach()) * probe.solid_angles).sum() / (4 * math.pi)
    assert abs(float(mean) - 1) < 1e-5


def test_the_exposed_luminance_of_all_lights_is_constant() -> None:
    probe, radiance = LightProbes(lights=2), torch.stack([_sunny(), 3 * _sunny().flip(1)])
    exposure = torch.rand(2, 32, 64, generator=torch.Generator().manual_seed(1)) * probe.solid_angles
    probe.start_from(radiance, exposure)
    assert torch.allclose(probe.radiance(), radiance, rtol=1e-5)
    with torch.no_grad():
        probe.raw.add_(torch.randn_like(probe.raw))
    reaches = [float((luminance(light.detach()) * exposure).sum()) for light in (probe.radiance(), radiance)]
    assert abs(reaches[0] / reaches[1] - 1) < 1e-5


def test_sampled_texels_are_unbiased_and_always_include_the_sun() -> None:
    probe, radiance = LightProbes(), _sunny()
    generator = torch.Generator().manual_seed(0)
    # any function of direction will do: the average over draws must be its full sum
    weight = torch.rand(32 * 64, generator=generator)
    truth = ((radiance * probe.solid_angles[..., None]).reshape(-1, 3) * weight[:, None]).sum(0)
    sky = truth - radiance[9, 40] * probe.solid_angles[9, 40] * weight[9 * 64 + 40]
    estimates = []
    for _ in range(400):
        texels = sample_texels(radiance, probe.directions, probe.solid_angles, 64, generator)
        assert torch.equal(texels.directions[0], probe.directions[9, 40])
        assert torch.allclose(texels.power[0], radiance[9, 40] * probe.solid_angles[9, 40])
        assert abs(len(texels.directions) - 64) <= 1
        index = (texels.directions @ probe.directions.reshape(-1, 3).T).argmax(1)
        estimates.append((texels.power[1:] * weight[index[1:], None]).sum(0))
    mean, spread = torch.stack(estimates).mean(0), torch.stack(estimates).std(0) / math.sqrt(400)
    assert ((mean - sky).abs() < 4 * spread).all()  # a false alarm in 16 000
    assert (spread < 0.02 * sky).all()


def test_shading_equals_the_runtimes_oracle() -> None:
    generator = np.random.default_rng(0)
    count = 40
    normals = generator.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    means = generator.normal(size=(count, 3))
    root = np.linalg.qr(generator.normal(size=(3, 3)))[0]
    root *= np.sign(np.linalg.det(root))
    arrays = [
        means,
        np.zeros((count, 6)),
        np.ones(count),
        normals,
        generator.uniform(0, 0.8, (count, 3)),
        generator.uniform(0.1, 0.9, count),
        0.3 * generator.normal(size=(count, 16)),
        root,
    ]
    gaussians = Gaussians(*(a.astype(np.float32) for a in arrays))
    eye = np.array([0.0, 1.0, 8.0])
    light = _sunny()
    expected = shade_reference(gaussians, Light(light.numpy()), eye)

    probe = LightProbes()
    texels = all_texels(light, probe.directions, probe.solid_angles)
    view = torch.nn.functional.normalize(torch.as_tensor(eye - means), dim=-1).float()
    visibility = light_visibility(
        torch.from_numpy(gaussians.visibility), texels.directions, torch.from_numpy(gaussians.root_rotation)
    )
    ours = shade(
        torch.from_numpy(gaussians.normals),
        view,
        torch.from_numpy(gaussians.albedo),
        torch.from_numpy(gaussians.roughness),
        visibility,
        texels,
    )
    assert np.abs(ours.numpy() - expected).max() < FLOAT32_RELATIVE * np.abs(expected).max()


def test_traced_columns_replace_the_brightest() -> None:
    coefficients, directions = torch.randn(5, 16), torch.nn.functional.normalize(torch.randn(6, 3), dim=-1)
    traced = torch.rand(5, 2)
    visibility = light_visibility(coefficients, directions, torch.eye(3), traced)
    assert torch.equal(visibility[:, :2], traced)
    assert torch.equal(visibility[:, 2:], light_visibility(coefficients, directions, torch.eye(3))[:, 2:])
