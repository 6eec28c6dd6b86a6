"""The avatar model: initial state, invariances, bounds and gradients."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from rnd_runtime.capture.body import skin
from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_runtime.shading.brdf import ROUGHNESS_RANGE
from rnd_trainer.config import ModelConfig
from rnd_trainer.model.encoders import SH_DC_OF_ONE, JointAttention, positional_encoding
from rnd_trainer.model.model import ALBEDO_RANGE, MIN_ROUGHNESS_RESIDUAL, AvatarModel, PoseInput
from rnd_trainer.model.template import sample_template
from rnd_trainer.training.data import pose_input
from support.tiny import body, motion

FLOAT32_POSITION_M = 2e-6  # float32 sums of metres
WEIGHT_FLOOR_M = 1e-4  # what the floor under the template's weights may move a point


@pytest.fixture(scope="module")
def template():
    return sample_template(body(), 600, 150, seed=0)


@pytest.fixture
def model(template) -> AvatarModel:
    torch.manual_seed(0)
    return AvatarModel(ModelConfig(gaussians=600, nodes=150, width=32, window_poses=4), template)


def _randomised(model: AvatarModel) -> AvatarModel:
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.2 * torch.randn_like(parameter))
    return model


def _pose(model: AvatarModel, time: float = 0.08) -> PoseInput:
    return pose_input(motion(body()), body().skeleton, time, model.config)


def test_an_untrained_avatar_is_the_template_skinned(model, template) -> None:
    pose = _pose(model)
    posed = model(pose)
    expected = skin(template.points, template.weights, pose.bones.double().numpy())
    assert np.abs(posed.means.detach().numpy() - expected).max() < WEIGHT_FLOOR_M
    assert torch.equal(posed.offset, torch.zeros_like(posed.offset))
    sh_of_one = torch.zeros(16)
    sh_of_one[0] = SH_DC_OF_ONE
    assert torch.allclose(posed.visibility, sh_of_one.expand(600, 16), atol=1e-5)


def test_a_rigid_motion_of_the_root_moves_everything(model) -> None:
    _randomised(model)
    pose = _pose(model)
    rotation = torch.as_tensor(axis_angle_to_matrix(np.array([0.4, -1.9, 0.7])), dtype=torch.float32)
    shift = torch.tensor([1.0, -2.0, 0.5])
    bones = rotation @ pose.bones
    bones[:, :, 3] += shift
    before, after = model(pose), model(PoseInput(pose.window, pose.velocity, bones))
    assert (before.means @ rotation.T + shift - after.means).abs().max() < FLOAT32_POSITION_M
    assert (before.normals @ rotation.T - after.normals).abs().max() < 1e-5
    assert torch.equal(before.weights, after.weights)
    assert (before.visibility - after.visibility).abs().max() < 1e-4  # its normals were rotated


def test_attributes_are_valid_for_any_weights(model) -> None:
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.mul_(0).add_(100 * torch.randn_like(parameter))
    static = model.attributes(model.encoded_nodes())
    assert ((static.opacity >= 0) & (static.opacity <= 1)).all()
    assert ((static.albedo >= ALBEDO_RANGE[0]) & (static.albedo <= ALBEDO_RANGE[1])).all()
    assert ((static.roughness >= ROUGHNESS_RANGE[0]) & (static.roughness <= ROUGHNESS_RANGE[1])).all()
    assert (static.scales > 0).all() and (static.scales <= 2.01 * model.spacing).all()
    assert torch.allclose(static.normals.norm(dim=-1), torch.ones(600), atol=1e-5)
    weights = model(_pose(model)).weights
    assert (weights >= 0).all() and torch.allclose(weights.sum(1), torch.ones(600), atol=1e-5)


def test_evaluation_bounds_the_roughness_residual(model) -> None:
    with torch.no_grad():
        model.appearance_residual[:, -1] = torch.tensor([-9, -0.3, 0, 9.0]).repeat(150)
        trained = model.attributes(model.encoded_nodes()).roughness
        played = model.eval().attributes(model.encoded_nodes()).roughness
        model.appearance_residual[:, -1].clamp_(min=MIN_ROUGHNESS_RESIDUAL)
        bounded = model.train().attributes(model.encoded_nodes()).roughness
    assert torch.equal(played, bounded)
    drifted = torch.tensor([True, False, False, False]).repeat(150)
    assert (played[drifted] > trained[drifted] + 0.1).all() and torch.equal(played[~drifted], trained[~drifted])


def test_skinning_weights_change_with_motion_not_only_with_pose(model) -> None:
    _randomised(model)
    pose = _pose(model)
    stopped = PoseInput(pose.window[-1:].expand_as(pose.window), torch.zeros_like(pose.velocity), pose.bones)
    assert (model(pose).weights - model(stopped).weights).abs().max() > 1e-3


def test_gradients_reach_every_parameter(model) -> None:
    _randomised(model)
    posed = model(_pose(model))
    static = posed.attributes
    weighted = [
        posed.means,
        1e4 * posed.covariances,
        posed.normals,
        posed.visibility,
        posed.weights,
        static.opacity,
        static.albedo,
        static.roughness,
        static.colour,
    ]
    generator = torch.Generator().manual_seed(0)
    sum((value * torch.randn(value.shape, generator=generator)).sum() for value in weighted).backward()
    silent = [name for name, p in model.named_parameters() if p.grad is None or not p.grad.abs().max() > 0]
    assert silent == []


def test_static_skinning_ignores_the_window(template) -> None:
    config = ModelConfig(gaussians=600, nodes=150, width=32, window_poses=4, dynamic_skinning=False)
    model = _randomised(AvatarModel(config, template))
    weights = model(_pose(model)).weights
    assert torch.equal(weights, model(_pose(model, 0.0)).weights)


def test_attention_equals_torchs_own() -> None:
    torch.manual_seed(0)
    ours = JointAttention(inputs=5, joints=7, width=16, heads=4)
    theirs = torch.nn.MultiheadAttention(16, 4, batch_first=True)
    tokens, queries = torch.randn(7, 5), torch.randn(9, 16)
    with torch.no_grad():
        embedded = ours.embed(tokens) + ours.joint
        theirs.in_proj_weight.copy_(ours.self_qkv.weight)
        theirs.in_proj_bias.copy_(ours.self_qkv.bias)
        theirs.out_proj.load_state_dict(ours.self_out.state_dict())
        normed = ours.norm(embedded)[None]
        mixed = embedded + theirs(normed, normed, normed)[0][0]
        theirs.in_proj_weight.copy_(torch.cat([ours.query.weight, ours.key_value.weight]))
        theirs.in_proj_bias.copy_(torch.cat([ours.query.bias, ours.key_value.bias]))
        theirs.out_proj.load_state_dict(ours.out.state_dict())
        expected = theirs(queries[None], mixed[None], mixed[None])[0][0]
        assert torch.allclose(ours(tokens, queries), expected, atol=1e-6)


def test_positional_encoding_has_octaves_of_half_waves_per_metre() -> None:
    encoded = positional_encoding(torch.tensor([[0.5, 0.0, 0.25]], dtype=torch.float64), 2)[0]
    expected = [0.5, 0, 0.25, 1, 0, 0.5**0.5, 0, 0, 1, 0, 1, 0.5**0.5, -1, 1, 0]
    assert torch.allclose(encoded, torch.tensor(expected, dtype=torch.float64), atol=1e-12)
