"""Terms of the objective that depend on what the images come with, and the far side that it leaves out."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from msgspec.structs import replace

from rnd_trainer.render.render import splat
from rnd_trainer.training.training import Training


def test_normals_stay_near_the_templates_where_nothing_tells_them(tiny_capture, tiny_config) -> None:
    told = Training(tiny_capture, tiny_config)
    assert "tilt" not in told.objective(told.model, told.views[0], told.poses[0], 0, 2)
    frames = tuple(replace(frame, normal=None) for frame in tiny_capture.frames)
    training = Training(dataclasses.replace(tiny_capture, frames=frames), tiny_config)
    model = training.model
    terms = training.objective(model, training.views[0], training.poses[0], 0, 2)
    normals = model.attributes(model.encoded_nodes()).normals
    expected = tiny_config.weight_tilt * (normals - model.rest_normals).square().mean()
    assert "normal" not in terms
    assert float(terms["tilt"].detach()) == pytest.approx(float(expected.detach()), rel=1e-4)
    assert terms["tilt"] > 0


def test_what_faces_away_is_left_out_of_a_culled_image(tiny_capture, tiny_config) -> None:
    training = Training(tiny_capture, tiny_config)
    with torch.no_grad():
        posed = training.model(training.poses[0])
    camera = training.views[0].camera
    view = torch.nn.functional.normalize(torch.as_tensor(camera.position).float() - posed.means, dim=-1)
    away = (posed.normals * view).sum(-1) <= -0.5
    assert 50 < away.sum() < len(away) - 50
    red = torch.where(away[:, None], torch.tensor([1.0, 0.0, 0.0]), torch.tensor([0.0, 1.0, 0.0]))
    whole, near = splat(posed, red, camera), splat(posed, red, camera, cull=-0.5)
    assert whole.image[..., 0].max() > 0.01
    assert near.image[..., 0].max() == 0
    assert 0.5 * whole.alpha.sum() < near.alpha.sum() < whole.alpha.sum()
