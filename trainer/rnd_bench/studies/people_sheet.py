"""A picture of people who were trained on: each in the place that they were filmed at and in another one."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from rnd_runtime.capture.capture import Capture
from rnd_runtime.capture.format import Split
from rnd_runtime.core.images import linear_to_srgb, to_bytes, write_image
from rnd_runtime.shading.light import REC709_LUMINANCE, Light
from rnd_trainer.evaluation.evaluate import Evaluator
from rnd_trainer.evaluation.preview import captions
from rnd_trainer.model.checkpoint import Checkpoint

Bytes = NDArray[np.uint8]

SHOWN: tuple[Split, ...] = ("novel_view", "relight")
GREY = 0.3  # mean luminance at which both lights are shown
WORDS = ("novel view", "ours", "albedo", "ours", "another light", "ours", "its light", "learned")


def write_people_sheet(path: Path, people: Sequence[tuple[Checkpoint, Capture]]) -> None:
    """Write a row for each person: truth and ours by turns, the middle frame of each of ``SHOWN``, then the lights."""
    rows = [_row(*person) for person in people]
    tile = rows[0].shape[0]
    write_image(path, np.concatenate([captions(WORDS, tile), *rows]))


def _row(checkpoint: Checkpoint, capture: Capture) -> Bytes:
    """[H, 8·H, 3] in the order of ``WORDS``, of a capture of the light stage: square images, true albedo and light."""
    evaluator, tiles = Evaluator(checkpoint, capture), []
    for split in SHOWN:
        frames = capture.split(split)
        frame = frames[len(frames) // 2]
        truth, ours = capture.load_frame(frame), evaluator.render(frame)
        tiles += [truth.image_srgb, linear_to_srgb(ours.image.numpy())]
        if split == SHOWN[0]:
            assert truth.albedo_srgb is not None
            tiles += [truth.albedo_srgb, linear_to_srgb(ours.albedo.numpy())]
    name = capture.split("train")[0].light
    assert name is not None
    learned = Light(checkpoint.probe_of(name).numpy())
    tiles += [_map(light, len(tiles[0])) for light in (capture.load_light(name), learned)]
    return np.concatenate([to_bytes(tile) for tile in tiles], axis=1)


def _map(light: Light, side: int) -> NDArray[np.float32]:
    """``light`` [side, side, 3] in sRGB, above black: its level is not compared here."""
    shown = light.resized(side // 2, side).radiance
    scaled = shown * (GREY / max(float((shown @ REC709_LUMINANCE).mean()), 1e-9))
    return cv2.copyMakeBorder(linear_to_srgb(scaled).astype(np.float32), 0, side - side // 2, 0, 0, cv2.BORDER_CONSTANT)
