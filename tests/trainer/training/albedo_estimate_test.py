"""Estimated albedo in training: read, shrunk, compared in the second stage; nothing changes without it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from msgspec.structs import replace

from rnd_runtime.capture.capture import Capture
from rnd_runtime.core.images import srgb_to_linear
from rnd_trainer.losses.losses import albedo_loss
from rnd_trainer.training import objective
from rnd_trainer.training.data import load_views
from rnd_trainer.training.training import Training


@pytest.fixture
def estimated(tiny_capture) -> Capture:
    """The tiny capture, lit by white light, with its images as estimates of the albedo."""
    frames = (replace(frame, albedo_estimate=frame.image) for frame in tiny_capture.frames)
    return dataclasses.replace(tiny_capture, frames=tuple(frames))


def _terms(capture: Capture, config, stage: int = 2) -> dict[str, torch.Tensor]:
    training = Training(capture, config)
    return training.objective(training.model, training.views[0], training.poses[0], 0, stage)


@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_estimates_are_linear_and_not_premultiplied(estimated, scale) -> None:
    view = load_views(estimated, "train", scale)[0][0]
    albedo, known = view.estimated_albedo()
    assert known.sum() > 100 and (view.mask[known] > 127).all()
    expected = srgb_to_linear(view.image / 255) / (view.mask[..., None] / 255).clip(0.5)
    assert np.abs(albedo.numpy() - expected).max() < 1e-5
    assert load_views(dataclasses.replace(estimated, frames=_bare(estimated)), "train")[0][0].estimated_albedo() is None


def _bare(capture: Capture) -> tuple:
    return tuple(replace(frame, albedo_estimate=None) for frame in capture.frames)


def test_black_pixels_of_an_estimate_are_unknown(estimated, monkeypatch) -> None:
    view = load_views(estimated, "train")[0][0]
    view.albedo_estimate[: len(view.mask) // 2] = 0
    _, known = view.estimated_albedo()
    assert not known[: len(known) // 2].any() and known[len(known) // 2 :].any()


def test_the_term_is_the_loss_of_the_splatted_albedo(estimated, tiny_config, monkeypatch) -> None:
    seen = []
    monkeypatch.setattr(objective, "albedo_loss", lambda *given: seen.append(given) or albedo_loss(*given))
    terms = _terms(estimated, tiny_config)
    ((albedo, estimate, known),) = seen
    expected = tiny_config.weight_albedo_estimate * albedo_loss(albedo, estimate, known)
    assert float(terms["albedo"].detach()) == float(expected.detach()) > 0
    assert albedo.shape == estimate.shape and known.sum() > 100
    # of the Gaussians, not darkened by their coverage
    assert albedo[known].min() >= 0.03 and albedo[known].max() <= 0.8
    assert "albedo" not in _terms(estimated, tiny_config, stage=1)


def test_nothing_changes_without_estimates(estimated, tiny_capture, tiny_config, monkeypatch) -> None:
    """Neither the values nor the channels that are rasterised; the true albedo never counts."""
    frames = tuple(replace(frame, albedo=frame.image) for frame in tiny_capture.frames)
    off = dataclasses.replace(tiny_config, weight_albedo_estimate=0.0)
    plain, scored, unweighted = (
        _terms(*given)
        for given in (
            (tiny_capture, tiny_config),
            (dataclasses.replace(tiny_capture, frames=frames), tiny_config),
            (estimated, off),
        )
    )
    with_it = _terms(estimated, tiny_config)
    assert plain == scored == unweighted and "albedo" not in plain
    assert set(with_it) == {*plain, "albedo"}
    assert all(torch.allclose(with_it[name], value) for name, value in plain.items())


def test_training_moves_albedo_towards_the_estimate(estimated, tiny_config) -> None:
    """The estimate is four times as bright at the top as at the bottom, which the images do not say."""
    config = dataclasses.replace(tiny_config, steps=24, weight_albedo_estimate=5.0)
    losses = []
    for weight in (0.0, 5.0):
        training = Training(estimated, dataclasses.replace(config, weight_albedo_estimate=weight))
        for view in training.views:
            ramp = np.linspace(200, 100, len(view.mask))[:, None, None] * (view.mask > 0)[..., None]
            view.albedo_estimate = np.repeat(ramp, 3, axis=2).astype(np.uint8)
        for _ in range(config.steps):
            training.step()
        training.objective.config = config
        view, pose = training.views[0], training.poses[0]
        losses.append(float(training.objective(training.model, view, pose, 0, 2)["albedo"].detach()))
    assert losses[1] < 0.8 * losses[0]


def test_another_estimate_is_other_training_data(estimated, tiny_capture, tiny_config) -> None:
    for config in (tiny_config, dataclasses.replace(tiny_config, image_scale=1.0)):
        digests = {Training(capture, config).learned_from_sha256 for capture in (estimated, tiny_capture)}
        assert len(digests) == 2
