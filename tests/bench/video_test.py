"""Figures of ``rnd-bench study video``."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from rnd_bench.studies.video import LIMBS, _errors, camera_landmarks, outline_iou
from rnd_runtime.core.camera import Camera
from rnd_runtime.motion.motion import Motion
from rnd_trainer.estimating.fitting.figure import default_figure
from rnd_trainer.estimating.fitting.marks import marks_of
from rnd_trainer.estimating.fitting.state import State
from support.tiny import body


def test_errors_are_millimetres_from_the_camera_and_from_the_root():
    truth = np.random.default_rng(1).normal(size=(4, 12, 3))
    found = truth + np.array([0.0, 0.0, 0.05])
    errors = _errors(found, truth, found[:, 0], truth[:, 0])
    assert errors["absolute_mm"] == pytest.approx(50)
    assert errors["root_relative_mm"] == pytest.approx(0, abs=1e-6) and errors["pa_mm"] == pytest.approx(0, abs=1e-6)


def test_outlines_overlap_where_the_body_is():
    figure = body()
    joints = len(figure.skeleton)
    motion = Motion(np.tile(np.eye(3), (1, joints, 1, 1)), np.zeros((1, 3)), 30.0, figure.skeleton.names)
    camera = Camera.look_at([0, 0.9, 4], [0, 0.9, 0], width=64, height=64, fov_y=0.6)
    found = SimpleNamespace(body=figure, motion=motion, camera=camera)
    empty = np.zeros((64, 64), bool)
    assert outline_iou(found, [empty], 1) == 0
    seen = figure.vertices @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    pixels = (seen[:, :2] / seen[:, 2:] * camera.K[0, 0] + 32).astype(int)
    box = empty.copy()
    box[pixels[:, 1].min() : pixels[:, 1].max(), pixels[:, 0].min() : pixels[:, 0].max()] = True
    assert 0.1 < outline_iou(found, [box], 1) < 0.9


def test_landmarks_lie_near_the_joints_of_their_names_in_the_cameras_axes():
    figure = default_figure()
    names = figure.body.skeleton.names
    state = State(
        np.tile(np.eye(3), (1, len(names), 1, 1)),
        np.array([[0.0, 0.0, -4.0]]),
        np.zeros(len(figure.names)),
        np.zeros_like(marks_of(figure).places),
        6.0,
        np.zeros(3),
    )
    landmarks = camera_landmarks(SimpleNamespace(state=state), LIMBS)[0]
    joints = figure.body.skeleton.rest_joints[[names.index(name) for name in LIMBS]] + [0, 0, -4]
    apart = np.linalg.norm(landmarks - joints * [1, -1, -1], axis=1)
    assert apart.max() < 0.06 and landmarks[:, 2].min() > 3.7
