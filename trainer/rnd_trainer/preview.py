"""Contact strips: input, render, normals, albedo and error side by side."""

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

ERROR_GAIN = 4
"""of the error picture: an error of 64/255 is white"""


def strip(rendered: Rendered, target_srgb: np.ndarray) -> np.ndarray:
    """[H, 5·W, 3] uint8: target | render | normals (n + 1)/2 | albedo | ERROR_GAIN × error, in sRGB."""
    covered = rendered.alpha.numpy()[..., None]
    image = linear_to_srgb(rendered.image.numpy())
    tiles = [
        target_srgb,
        image,
        0.5 * (rendered.normals.numpy() + covered),
        linear_to_srgb(rendered.albedo.numpy()),
        ERROR_GAIN * np.abs(np.clip(image, 0, 1) - target_srgb),
    ]
    return np.concatenate([to_bytes(tile) for tile in tiles], axis=1)


def save_preview(
    path: Path, model: AvatarModel, probe: torch.Tensor | None, views: list[tuple[View, PoseInput]]
) -> None:
    """A picture with one row for each view: what the player would show of the training so far.

    Without a ``probe`` [32, 64, 3] (in the first stage) the plain colours are shown.
    """
    shader = None if probe is None else Shader(Light(probe.detach().cpu().numpy()), "table+sun")
    rows = []
    for view, pose in views:
        target = view.image.astype(np.float32) / 255
        rows.append(strip(render_runtime(model, pose, view.camera, shader), target))
    width = max(row.shape[1] for row in rows)
    padded = [np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0))) for row in rows]
    write_image(path, np.concatenate(padded, axis=0))


def contact_sheet(path: Path, strips: list[np.ndarray], rows: int = 6) -> None:
    """``rows`` of the strips [H, 5·W, 3], evenly chosen, under one another."""
    count = min(rows, len(strips))
    chosen = [strips[k * len(strips) // count] for k in range(count)]
    width = max(strip.shape[1] for strip in chosen)
    padded = [np.pad(strip, ((0, 0), (0, width - strip.shape[1]), (0, 0))) for strip in chosen]
    write_image(path, np.concatenate(padded, axis=0))
