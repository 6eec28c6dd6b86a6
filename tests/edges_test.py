"""The edge-length term: poses that nobody filmed, the stretch of skin in them, and what descending on it does."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from rnd_runtime.motion import Motion
from rnd_runtime.rotations import axis_angle_to_matrix
from rnd_trainer.config import ModelConfig
from rnd_trainer.data import pose_input
from rnd_trainer.edges import BETWEEN_BONES, LEAST_LENGTH, PARTS, WIDEST_TURN, EdgeLengths, drawn_pose
from rnd_trainer.losses import ALLOWED_STRETCH, skinning_divergence, stretch_penalty
from rnd_trainer.model import AvatarModel, PoseInput
from rnd_trainer.stability.subject import EXTREMES
from rnd_trainer.template import sample_template, skin
from rnd_trainer.train import Training
from tiny import body

COUNT = 3000
CONFIG = ModelConfig(gaussians=COUNT, nodes=750, width=32, window_poses=4)


@pytest.fixture(scope="module")
def template():
    return sample_template(body(), COUNT, CONFIG.nodes, seed=0)


@pytest.fixture
def model(template) -> AvatarModel:
    torch.manual_seed(0)
    return AvatarModel(CONFIG, template)


@pytest.fixture
def edges(model) -> EdgeLengths:
    return EdgeLengths(model, body().skeleton, seed=3)


def _squat() -> PoseInput:
    skeleton = body().skeleton
    angles = np.zeros((2, len(skeleton), 3))
    for name, turn in EXTREMES["squat"].items():
        angles[:, skeleton.names.index(name)] = turn
    motion = Motion(axis_angle_to_matrix(angles), np.zeros((2, 3)), 30.0, skeleton.names)
    return pose_input(motion, skeleton, 0.0, CONFIG)


def test_a_drawn_pose_turns_a_few_joints_within_bounds_and_comes_there_from_less() -> None:
    skeleton = body().skeleton
    for seed in range(8):
        pose = drawn_pose(skeleton, CONFIG, np.random.default_rng(seed))
        turned = (pose.window[-1] - pose.window.new_tensor([1, 0, 0, 0, 1, 0])).abs().amax(-1) > 1e-4
        assert 1 <= int(turned.sum()) <= 5
        assert pose.velocity[~turned].abs().max() < 1e-4
        assert pose.velocity.norm(dim=-1).max() < WIDEST_TURN / CONFIG.window_seconds
        assert torch.allclose(pose.bones[0, :, :3], torch.eye(3), atol=1e-6)  # the root stays


def test_the_step_gives_the_pose(model, edges) -> None:
    points = model.points
    first, again, other = (edges(model, points, step).stretch for step in (8, 8, 8 + PARTS))
    assert torch.equal(first, again) and len(first) == len(other) and not torch.equal(first, other)
    same = EdgeLengths(model, body().skeleton, seed=3)(model, points, 8)
    assert torch.equal(first, same.stretch)


def test_stretch_is_the_templates_before_anything_is_learned(model, template, edges) -> None:
    pose = _squat()
    stretch = edges.stretch(model, model.points, pose).detach().numpy()
    posed = skin(template.points, template.weights, pose.bones.double().numpy())
    expected = []
    codes = template.codes.astype(np.float32)
    found = set()
    for i in range(COUNT):  # by brute force: the six nearest, those between bones, each pair once
        distances = np.linalg.norm(codes - codes[i], axis=1)
        for j in np.argsort(distances, kind="stable")[1:7]:
            pair = min(i, int(j)), max(i, int(j))
            differ = np.abs(template.weights[i] - template.weights[j]).sum()
            if pair not in found and differ > BETWEEN_BONES:
                found.add(pair)
                rest = np.linalg.norm(template.points[i] - template.points[j])
                expected.append(np.linalg.norm(posed[i] - posed[j]) / max(rest, LEAST_LENGTH))
    assert abs(len(stretch) - len(expected)) <= 5  # the floor under the weights decides a few
    for share in (1, 50, 99, 99.9):
        assert np.percentile(stretch, share) == pytest.approx(np.percentile(expected, share), rel=0.01)


def test_only_what_is_beyond_skins_own_stretch_costs() -> None:
    stretch = torch.tensor([0.2, 1.0, ALLOWED_STRETCH, ALLOWED_STRETCH + 2])
    assert float(stretch_penalty(stretch)) == pytest.approx(1.0)
    assert float(stretch_penalty(stretch[:0])) == 0


def test_only_the_skinning_feels_it(model, edges) -> None:
    skin_now = edges(model, model.attributes(model.encoded_nodes()).points, 0)
    (
        stretch_penalty(skin_now.stretch) + skinning_divergence(skin_now.weights, skin_now.log_template)
    ).backward()
    felt = {name.split(".")[0] for name, p in model.named_parameters() if p.grad is not None}
    assert felt == {"skinning"}


def test_descending_on_it_mends_poses_that_were_never_drawn(model, edges) -> None:
    others = EdgeLengths(model, body().skeleton, seed=4)

    def torn() -> float:
        with torch.no_grad():
            return float(
                np.mean([float(stretch_penalty(others(model, model.points, k).stretch)) for k in range(24)])
            )

    before = torn()
    optimizer = torch.optim.Adam(model.skinning.parameters(), lr=2e-3)
    for step in range(60 * PARTS):
        drawn = edges(model, model.points, step)
        kept = 0.01 * skinning_divergence(drawn.weights, drawn.log_template)
        (stretch_penalty(drawn.stretch) + kept).backward()
        if step % PARTS == PARTS - 1:  # once round the body
            optimizer.step()
            optimizer.zero_grad()
    assert torn() < 0.7 * before


def test_training_counts_it_where_it_is_asked_for_and_skinning_is_learned(tiny_capture, tiny_config) -> None:
    asked = dataclasses.replace(tiny_config, weight_edges=0.1)
    still = dataclasses.replace(tiny_config.model, dynamic_skinning=False)
    assert "edges" in Training(tiny_capture, asked).step().terms
    for config in (tiny_config, dataclasses.replace(asked, model=still)):
        assert "edges" not in Training(tiny_capture, config).step().terms
