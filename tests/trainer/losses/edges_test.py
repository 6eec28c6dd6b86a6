"""The third stage: unseen poses, edge stretch in them, and distillation."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from rnd_bench.scenes.poses import EXTREMES
from rnd_runtime.capture.body import skin
from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_runtime.motion.motion import Motion
from rnd_trainer.config import ModelConfig, TrainConfig
from rnd_trainer.losses.edges import BETWEEN_BONES, MIN_LENGTH, EdgeLengths
from rnd_trainer.losses.losses import ALLOWED_STRETCH, stretch_penalty
from rnd_trainer.model.model import AvatarModel, PoseInput
from rnd_trainer.model.template import sample_template
from rnd_trainer.training.data import pose_input
from rnd_trainer.training.sampled_poses import (
    JITTER,
    MAX_PERTURBATION,
    MAX_ROTATION,
    ROTATED_JOINTS,
    VELOCITY_JITTER,
    jittered_pose,
    perturbed_pose,
    sampled_pose,
)
from rnd_trainer.training.unseen import MM2, NODE_STRIDE, UnseenPoses
from support.tiny import body

COUNT = 3000
CONFIG = ModelConfig(gaussians=COUNT, nodes=750, width=32, window_poses=4)


@pytest.fixture(scope="module")
def template():
    return sample_template(body(), COUNT, CONFIG.nodes, seed=0)


@pytest.fixture
def model(template) -> AvatarModel:
    torch.manual_seed(0)
    return AvatarModel(CONFIG, template)


def _poses(count: int, seed: int) -> list[PoseInput]:
    return [sampled_pose(body().skeleton, CONFIG, np.random.default_rng((seed, k))) for k in range(count)]


def _stretch(lengths: EdgeLengths, model: AvatarModel, pose: PoseInput) -> torch.Tensor:
    return lengths.stretch(lengths.weights(model, pose), model.points, pose)


def _squat() -> PoseInput:
    skeleton = body().skeleton
    angles = np.zeros((2, len(skeleton), 3))
    for name, rotation in EXTREMES["squat"].items():
        angles[:, skeleton.names.index(name)] = rotation
    motion = Motion(axis_angle_to_matrix(angles), np.zeros((2, 3)), 30.0, skeleton.names)
    return pose_input(motion, skeleton, 0.0, CONFIG)


def test_a_sampled_pose_rotates_a_few_joints_within_bounds_and_grows_over_the_window() -> None:
    skeleton = body().skeleton
    for seed in range(8):
        pose = sampled_pose(skeleton, CONFIG, np.random.default_rng(seed))
        rotated = (pose.window[-1] - pose.window.new_tensor([1, 0, 0, 0, 1, 0])).abs().amax(-1) > 1e-4
        assert 1 <= int(rotated.sum()) <= ROTATED_JOINTS
        assert pose.velocity[~rotated].abs().max() < 1e-4
        assert pose.velocity.norm(dim=-1).max() < MAX_ROTATION / CONFIG.window_seconds
        assert torch.allclose(pose.bones[0, :, :3], torch.eye(3), atol=1e-6)  # the root stays


def test_a_perturbed_pose_is_near_the_training_pose_with_its_root_and_speed() -> None:
    skeleton = body().skeleton
    rng = np.random.default_rng(3)
    angles = np.cumsum(0.03 * rng.standard_normal((40, len(skeleton), 3)), axis=0)
    motion = Motion(axis_angle_to_matrix(angles), rng.standard_normal((40, 3)), 30.0, skeleton.names)
    training_pose = pose_input(motion, skeleton, 0.9, CONFIG)
    for seed in range(8):
        perturbed = perturbed_pose(motion, skeleton, 0.9, CONFIG, np.random.default_rng(seed))
        # where the person stands and looks
        assert torch.allclose(perturbed.bones[0], training_pose.bones[0], atol=1e-5)
        perturbed_speed, speed = (pose.velocity.norm(dim=-1) for pose in (perturbed, training_pose))
        assert torch.allclose(perturbed_speed, speed, atol=1e-3)  # one rotation for the whole window
        moved = perturbed.bones[1:, :, :3] - training_pose.bones[1:, :, :3]
        assert float(moved.abs().max()) > 0
        own = (perturbed.window - training_pose.window).abs().amax(-1)
        assert float(own.mean()) < 2 * MAX_PERTURBATION
    twice = [perturbed_pose(motion, skeleton, 0.9, CONFIG, np.random.default_rng(1)).window for _ in range(2)]
    assert torch.equal(*twice)


@pytest.mark.parametrize("generator", [np.random.default_rng(0), torch.Generator().manual_seed(0)])
def test_jitter_has_the_stated_standard_deviations(model, generator) -> None:
    pose = _poses(1, seed=4)[0]
    nudged = jittered_pose(pose, generator)
    moved, faster = nudged.window - pose.window, nudged.velocity - pose.velocity
    assert torch.allclose(moved, moved[:1].expand_as(moved), atol=1e-6)  # the window as a whole
    assert float(moved[0].std()) == pytest.approx(JITTER, rel=0.3)
    assert float(faster.std()) == pytest.approx(VELOCITY_JITTER, rel=0.3)
    assert torch.equal(nudged.bones, pose.bones)


def test_descent_smooths_skinning_weights(model) -> None:
    """A network that varies fast with the pose learns not to, in poses that were never sampled."""
    with torch.no_grad():
        model.skinning.logits.weight.copy_(3 * torch.randn(model.skinning.logits.weight.shape))
    unseen = UnseenPoses(model, body().skeleton, TrainConfig(model=CONFIG))
    lengths, far, training_pose = EdgeLengths(model), _poses(12, seed=6), _poses(2, seed=5)

    @torch.no_grad()
    def jump() -> float:
        pairs = ((pose, jittered_pose(pose, np.random.default_rng(k))) for k, pose in enumerate(far))
        return float(
            np.mean(
                [float((lengths.weights(model, a) - lengths.weights(model, b)).abs().sum(-1).mean()) for a, b in pairs]
            )
        )

    before = jump()
    optimizer = torch.optim.Adam(model.skinning.parameters(), lr=2e-3)
    for step in range(60):
        unseen(model, training_pose[step % 2], step)["smoothness"].backward()
        optimizer.step()
        optimizer.zero_grad()
    assert jump() < 0.5 * before


def test_initial_stretch_is_the_templates(model, template) -> None:
    pose = _squat()
    stretch = _stretch(EdgeLengths(model), model, pose).detach().numpy()
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
                expected.append(np.linalg.norm(posed[i] - posed[j]) / max(rest, MIN_LENGTH))
    assert abs(len(stretch) - len(expected)) <= 5  # the floor under the weights decides a few
    for share in (1, 50, 99, 99.9):
        assert np.percentile(stretch, share) == pytest.approx(np.percentile(expected, share), rel=0.01)


def test_stretch_costs_beyond_the_allowed_only() -> None:
    stretch = torch.tensor([0.2, 1.0, ALLOWED_STRETCH, ALLOWED_STRETCH + 2])
    assert float(stretch_penalty(stretch)) == pytest.approx(1.0)
    assert float(stretch_penalty(stretch[:0])) == 0


def test_the_step_determines_the_samples_and_only_the_skinning_gets_gradients(model) -> None:
    training_pose = _poses(4, seed=1)
    unseen, same = (UnseenPoses(model, body().skeleton, TrainConfig(model=CONFIG)) for _ in range(2))
    first, again, other = (unseen(model, training_pose[0], step) for step in (8, 8, 9))
    assert first == again == same(model, training_pose[0], 8)
    assert first["edges"] != other["edges"]
    torch.stack(list(first.values())).sum().backward()
    felt = {name.split(".")[0] for name, p in model.named_parameters() if p.grad is not None}
    assert felt == {"skinning"}
    assert all(p.grad is None for p in unseen.teacher.parameters())


def test_distillation_measures_offsets_from_the_teacher(model) -> None:
    """Against skinning node by node in float64."""
    pose = _poses(1, seed=2)[0]
    unseen = UnseenPoses(model, body().skeleton, TrainConfig(model=CONFIG))
    assert [unseen(model, pose, k)["distillation"] for k in range(NODE_STRIDE)] == [0] * NODE_STRIDE
    with torch.no_grad():
        model.skinning.logits.bias += 0.3 * torch.randn(model.skinning.logits.bias.shape)
        logits = model.skinning.logits.bias.double().numpy()
    bones = pose.bones.double().numpy()
    points = model.attributes(model.encoded_nodes()).points.detach().double().numpy()
    squares = []
    for log_template, point in zip(model.log_weights[: CONFIG.nodes].double().numpy(), points):
        placed = []
        for change in (logits, 0 * logits):
            weights = np.exp(log_template + change)
            blend = np.einsum("j,jrc->rc", weights / weights.sum(), bones)
            placed.append(blend[:, :3] @ point + blend[:, 3])
        squares.append(((placed[0] - placed[1]) ** 2).sum())
    for k in range(NODE_STRIDE):
        assert unseen(model, pose, k)["distillation"].item() == pytest.approx(
            MM2 * np.mean(squares[k::NODE_STRIDE]), rel=1e-3
        )


def test_descent_improves_unsampled_poses_and_keeps_training_poses(model) -> None:
    training_pose, far = _poses(6, seed=5), _poses(24, seed=6)
    # poses other than the samples
    training_pose = [dataclasses.replace(pose, window=pose.window.roll(1, 1)) for pose in training_pose]
    lengths = EdgeLengths(model)
    config = dataclasses.replace(TrainConfig(model=CONFIG), weight_edges=1e5)
    unseen = UnseenPoses(model, body().skeleton, config)

    @torch.no_grad()
    def torn() -> float:
        stretches = (_stretch(lengths, model, pose) for pose in far)
        return float(np.mean([float(stretch_penalty(stretch)) for stretch in stretches]))

    before = torn()
    optimizer = torch.optim.Adam(model.skinning.parameters(), lr=2e-3)
    for step in range(120):
        terms = unseen(model, training_pose[step % len(training_pose)], step)
        torch.stack(list(terms.values())).sum().backward()
        optimizer.step()
        optimizer.zero_grad()
    with torch.no_grad():
        moved = np.mean([float(unseen(model, pose, 0)["distillation"]) for pose in training_pose])
    assert torn() < 0.7 * before
    assert moved < 5**2  # mm²
