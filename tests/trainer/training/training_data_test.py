"""Training views: crops with their cameras, exact colours, shrunk images."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from msgspec.structs import replace

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.images import linear_to_srgb
from rnd_trainer.config import TrainConfig
from rnd_trainer.training.data import CROP_MARGIN, load_views
from rnd_trainer.training.training import Training


def test_a_crop_is_the_image_and_its_camera_agrees(tiny_capture) -> None:
    views, bad = load_views(tiny_capture, "train")
    assert bad == [] and len(views) == 6
    for view in views:
        whole = tiny_capture.load_frame(view.frame)
        camera = tiny_capture.cameras[view.frame.camera]
        left, top = (np.round(camera.K[:2, 2] - view.camera.K[:2, 2])).astype(int)
        rows, columns = slice(top, top + view.camera.height), slice(left, left + view.camera.width)
        assert np.array_equal(view.image, np.round(whole.image_srgb[rows, columns] * 255))
        assert view.mask.sum() == np.round(whole.mask * 255).sum()  # nothing of the person is cut off
        inside = np.argwhere(view.mask > 0)
        edges = [inside.min(0), np.array(view.mask.shape) - 1 - inside.max(0)]
        touching = [top == 0, left == 0]
        for axis in range(2):
            assert touching[axis] or edges[0][axis] == CROP_MARGIN


def test_targets_composite_light_not_bytes(tiny_capture) -> None:
    view = load_views(tiny_capture, "train")[0][0]
    black, mask = view.target(torch.zeros(3))
    white, _ = view.target(torch.ones(3))
    assert torch.allclose(white - black, (1 - mask)[..., None].expand_as(black), atol=1e-6)
    assert np.abs(linear_to_srgb(black.numpy()) * 255 - view.image).max() < 1e-3


def test_normals_are_unit_inside_and_zero_outside(tiny_capture) -> None:
    view = load_views(tiny_capture, "train")[0][0]
    estimate = view.normals()
    assert estimate is not None
    normals, known = estimate
    assert known.all()
    solid = torch.from_numpy(view.mask) == 255
    assert (normals[solid].norm(dim=-1).median() - 1).abs() < 0.05
    assert (normals[torch.from_numpy(view.mask) == 0] == 0).all()
    assert normals[solid][:, 2].mean() < -0.5  # towards the camera


def test_normals_without_data_are_not_in_the_loss(tiny_capture, monkeypatch) -> None:
    original = type(tiny_capture).load_frame

    def holed(capture, frame):
        images = original(capture, frame)
        normal = images.normal.copy()
        normal[: len(normal) // 2] = 0
        return dataclasses.replace(images, normal=normal)

    whole = load_views(tiny_capture, "train")[0][0]
    monkeypatch.setattr(type(tiny_capture), "load_frame", holed)
    view = load_views(tiny_capture, "train")[0][0]
    (all_normals, _), (normals, known) = whole.normals(), view.normals()
    middle = tiny_capture.cameras["front"].height // 2
    top = int(whole.camera.K[1, 2] - tiny_capture.cameras["front"].K[1, 2]) + middle  # where the hole ends
    person = torch.from_numpy(view.mask > 127)
    rows = (torch.arange(len(person)) < top)[:, None].expand_as(person)
    assert torch.equal(~known[..., 0], person & rows) and 0 < (~known).sum() < person.sum()
    assert torch.equal(normals[known[..., 0]], all_normals[known[..., 0]])


def test_shrinking_keeps_light_and_view(tiny_capture) -> None:
    whole, half = (load_views(tiny_capture, "train", scale)[0][0] for scale in (1.0, 0.5))
    assert half.camera.K[0, 0] == pytest.approx(whole.camera.K[0, 0] / 2)
    total = [view.target(torch.zeros(3))[0].sum() for view in (whole, half)]
    assert float(total[1] * 4) == pytest.approx(float(total[0]), rel=0.01)  # rounding to bytes


def test_missing_true_normals_are_refused(tiny_capture) -> None:
    without = tuple(replace(frame, normal_gt=None) for frame in tiny_capture.frames)
    with pytest.raises(InputError, match="--normals true: expected normal_gt of every training image, got none"):
        load_views(dataclasses.replace(tiny_capture, frames=without), "train", true_normals=True)


def test_an_empty_split_is_refused(tiny_capture) -> None:
    with pytest.raises(InputError, match="split 'relight': expected at least one frame, got none"):
        load_views(tiny_capture, "relight")


def test_a_capture_without_training_images_is_refused(tiny_capture) -> None:
    frames = tuple(replace(frame, split="relight") for frame in tiny_capture.frames)
    with pytest.raises(InputError, match="split 'train': expected at least one frame, got none"):
        Training(dataclasses.replace(tiny_capture, frames=frames), TrainConfig())
