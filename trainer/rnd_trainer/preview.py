"""Contact strips: input, render, normals and albedo side by side."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from rnd_runtime.images import linear_to_srgb, to_bytes, write_image
from rnd_runtime.light import Light
from rnd_runtime.shading import Shader

from .data import View
from .judge import Rendered, render_runtime
from .model import AvatarModel, PoseInput


def strip(rendered: Rendered, target_srgb: np.ndarray) -> np.ndarray:
    """[H, 4·W, 3] uint8: target | render | normals (n + 1)/2 | albedo."""
    covered = rendered.alpha.numpy()[..., None]
    tiles = [
        target_srgb,
        linear_to_srgb(rendered.image.numpy()),
        0.5 * (rendered.normals.numpy() + covered),
        linear_to_srgb(rendered.albedo.numpy()),
    ]
    return np.concatenate([to_bytes(tile) for tile in tiles], axis=1)


def save_preview(
    path: Path, model: AvatarModel, probe: torch.Tensor | None, views: list[tuple[View, PoseInput]]
) -> None:
    """A picture with one row for each view: what the player would show of the training so far.

    Without a ``probe`` [32, 64, 3] (in the first stage) the plain colours are shown.
    """
    shader = None if probe is None else Shader(Light(probe.detach().numpy()), "table+sun")
    rows = []
    for view, pose in views:
        target = view.image.astype(np.float32) / 255
        rows.append(strip(render_runtime(model, pose, view.camera, shader), target))
    width = max(row.shape[1] for row in rows)
    padded = [np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0))) for row in rows]
    write_image(path, np.concatenate(padded, axis=0))
