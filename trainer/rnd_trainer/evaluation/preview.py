"""Contact strips: truth, render, normals, albedo and error side by side."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from rnd_runtime.core.images import linear_to_srgb, to_bytes, write_image
from rnd_runtime.shading.light import Light
from rnd_runtime.shading.shader import Shader
from rnd_trainer.model.model import AvatarModel, PoseInput
from rnd_trainer.training.data import TrainingView
from rnd_trainer.training.lighting.lights import TrainingLights, light_name

from .evaluator import Rendered, render_runtime

ERROR_GAIN = 4
"""gain of the error image: an error of 64/255 is white"""
TILES = ("truth", "render", "normals", "albedo", f"error x {ERROR_GAIN}")
"""images side by side in a strip"""
CAPTION = 24
"""height of the captions, pixels"""
FONT, LETTERS = cv2.FONT_HERSHEY_SIMPLEX, 0.45


def strip(rendered: Rendered, target_srgb: np.ndarray) -> np.ndarray:
    """[H, 5·W, 3] uint8: ``TILES`` side by side in sRGB; normals as (n + 1)/2."""
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
    path: Path, model: AvatarModel, lights: TrainingLights | None, views: list[tuple[TrainingView, PoseInput]]
) -> None:
    """Write an image with a strip per view under its light; without ``lights`` of plain colours."""
    probes = {} if lights is None else lights.by_name()
    shaders = {name: Shader(Light(probe.cpu().numpy()), "table+sun") for name, probe in probes.items()}
    rows = []
    for view, pose in views:
        shader = shaders.get(light_name(view.frame))
        target = view.image.astype(np.float32) / 255
        rows.append(strip(render_runtime(model, pose, view.camera, shader), target))
    _write_sheet(path, rows)


def contact_sheet(path: Path, strips: list[np.ndarray], rows: int = 6) -> None:
    """Write ``rows`` evenly spaced strips [H, 5·W, 3] below one another."""
    count = min(rows, len(strips))
    _write_sheet(path, [strips[k * len(strips) // count] for k in range(count)])


def captions(words: Sequence[str], tile: int) -> np.ndarray:
    """[CAPTION, tile·words, 3] uint8: a caption for each tile of ``tile`` pixels, grey on black."""
    image = np.zeros((CAPTION, tile * len(words), 3), np.uint8)
    for number, word in enumerate(words):
        (wide, _), _ = cv2.getTextSize(word, FONT, LETTERS, 1)
        scale = LETTERS * min(1.0, 0.9 * tile / wide)
        left = number * tile + round((tile - wide * scale / LETTERS) / 2)
        cv2.putText(image, word, (left, CAPTION - 8), FONT, scale, (170, 170, 170), 1, cv2.LINE_AA)
    return image


def _write_sheet(path: Path, strips: list[np.ndarray]) -> None:
    """Write strips below captions; narrower images are centred in their columns."""
    tile = max(strip.shape[1] for strip in strips) // len(TILES)
    columns = [_centred(strip, tile) for strip in strips]
    write_image(path, np.concatenate([captions(TILES, tile), *columns], axis=0))


def _centred(strip: np.ndarray, tile: int) -> np.ndarray:
    """Strip [H, 5·W, 3] with each image padded to ``tile`` ≥ W pixels: [H, 5·tile, 3]."""
    images = strip.reshape(len(strip), len(TILES), -1, 3)
    left, right = (tile - images.shape[2]) // 2, (tile - images.shape[2] + 1) // 2
    return np.pad(images, ((0, 0), (0, 0), (left, right), (0, 0))).reshape(len(strip), -1, 3)
