"""Surface without evidence takes after its neighbours and its mirrored side; what was seen stays."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from rnd_runtime.capture.capture import load_capture
from rnd_trainer.config import ModelConfig
from rnd_trainer.model.model import AvatarModel
from rnd_trainer.model.template import sample_template
from rnd_trainer.training.unseen_surface import SEEN, fill_in
from support.paths import ASSETS


@pytest.fixture
def model() -> AvatarModel:
    torch.manual_seed(0)
    config = ModelConfig(gaussians=1_500, nodes=180)
    template = sample_template(load_capture(ASSETS / "capture").body, config.gaussians, config.nodes, 0)
    return AvatarModel(config, template)


def _albedo(model: AvatarModel) -> np.ndarray:
    with torch.no_grad():
        return model.attributes(model.encoded_nodes()).albedo.numpy().astype(float)


def test_a_patch_takes_after_its_surroundings_and_its_mirror(model) -> None:
    points = model.points.numpy()
    with torch.no_grad():
        model.appearance_residual[:, 3:6] = 1.0
        patch = np.linalg.norm(points - points[np.argmax(points[:, 0])], axis=1) < 0.25
        model.appearance_residual[torch.as_tensor(patch), 3:6] = -2.0
    before = _albedo(model)
    seen = np.where(patch, 0.0, 100.0)
    assert fill_in(model, seen) == patch.sum() > 20
    after = _albedo(model)
    assert np.array_equal(after[~patch], before[~patch])
    lightest = before[~patch].min(0)
    assert (after[patch] > 0.97 * lightest).all()


def test_little_evidence_counts_in_proportion(model) -> None:
    patch = np.zeros(len(model.points), bool)
    patch[::7] = True
    with torch.no_grad():
        model.appearance_residual[torch.as_tensor(patch), 3:6] = 3.0
    before, changes, start = _albedo(model), [], model.appearance_residual.detach().clone()
    for count in (0.1, 1.0, 7.0):
        with torch.no_grad():
            model.appearance_residual.copy_(start)
        fill_in(model, np.where(patch, count, SEEN))
        changes.append(np.abs(_albedo(model) - before)[patch].mean())
    assert changes[0] > changes[1] > changes[2] > 0


def test_nothing_to_go_by_changes_nothing(model) -> None:
    before = _albedo(model)
    assert fill_in(model, np.zeros(len(model.points))) == 0
    assert fill_in(model, np.full(len(model.points), SEEN)) == 0
    assert np.array_equal(_albedo(model), before)
