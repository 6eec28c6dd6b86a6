"""Surface without evidence takes after its neighbours and its mirrored side; what was seen stays."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from rnd_runtime.capture.capture import load_capture
from rnd_trainer.config import ModelConfig
from rnd_trainer.model.model import AvatarModel
from rnd_trainer.model.template import sample_template
from rnd_trainer.render.render import splat
from rnd_trainer.training.unseen_surface import SEEN, evidence, fill_in
from support.ball import front_camera, splat_ball
from support.paths import ASSETS


class Ball:
    """A model that is a ball in any pose."""

    posed = splat_ball()
    points = posed.means
    spacing = torch.tensor(0.011)  # m: √(4π RADIUS² / 4000)

    def __call__(self, pose: object) -> object:
        return self.posed


def test_evidence_is_the_share_of_a_patch_that_images_show() -> None:
    view = SimpleNamespace(camera=front_camera())
    seen = evidence(Ball(), [view, view], [None, None])  # type: ignore[arg-type]
    towards = np.array(view.camera.position) - Ball.points.numpy()
    cosine = (Ball.posed.normals.numpy() * towards).sum(1) / np.linalg.norm(towards, axis=1)
    assert seen[cosine < -0.2].max() == 0  # unlit
    shares = [seen[abs(cosine - c) < 0.1].mean() / 2 for c in (0.9, 0.5)]
    np.testing.assert_allclose(shares, (0.9, 0.5), rtol=0.3)  # splats reach beyond their patch
    one = int(np.argmax(seen))
    red = torch.zeros(len(seen), 3)
    red[one, 0] = 1
    pixels = float(splat(Ball.posed, red, view.camera).image[..., 0].sum())
    depth = float((view.camera.world_to_camera @ [*Ball.points[one].tolist(), 1])[2])
    patch = (view.camera.K[0, 0] * float(Ball.spacing) / depth) ** 2
    assert seen[one] == pytest.approx(2 * pixels / patch, rel=1e-4)


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
