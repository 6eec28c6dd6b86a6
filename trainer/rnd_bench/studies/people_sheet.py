"""A picture of people who were trained on: each in the place that they were filmed at and in another one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from rnd_runtime.capture.capture import Capture
from rnd_runtime.capture.format import Frame, Split
from rnd_runtime.core.camera import Camera
from rnd_runtime.core.images import linear_to_srgb, to_bytes, write_image
from rnd_runtime.shading.light import REC709_LUMINANCE, Light
from rnd_stage.film.film import TRUTH_SAMPLES, Production
from rnd_stage.people.dressing import Wearer
from rnd_stage.render import RenderSet
from rnd_trainer.evaluation.evaluate import Evaluator
from rnd_trainer.evaluation.preview import captions
from rnd_trainer.model.checkpoint import Checkpoint
from rnd_viewer.report.renders import CLOSE_UPS

Bytes = NDArray[np.uint8]

SHOWN: tuple[Split, ...] = ("novel_view", "relight")
GREY = 0.3  # mean luminance at which both lights are shown
WORDS = ("novel view", "ours", "albedo", "ours", "palm", "ours", "another light", "ours", "its light", "learned")
PALM_DISTANCE, PALM_FOV = 0.48, 0.5  # m, rad


def write_people_sheet(path: Path, people: Sequence[tuple[Checkpoint, Capture, Production]]) -> None:
    """Write a row for each person: truth and ours by turns, the middle frame of each of ``SHOWN``, then the lights.

    ``Production`` is of the capture.
    """
    rows = [_row(*person) for person in people]
    tile = rows[0].shape[0]
    write_image(path, np.concatenate([captions(WORDS, tile), *rows]))


def _row(checkpoint: Checkpoint, capture: Capture, production: Production) -> Bytes:
    """[H, 10·H, 3] in the order of ``WORDS``, of a capture of the light stage: square images, true albedo and light."""
    evaluator, tiles = Evaluator(checkpoint, capture), []
    for split in SHOWN:
        frames = capture.split(split)
        frame = frames[len(frames) // 2]
        truth, ours = capture.load_frame(frame), evaluator.render(frame)
        tiles += [truth.image_srgb, linear_to_srgb(ours.image.numpy())]
        if split == SHOWN[0]:
            assert truth.albedo_srgb is not None
            tiles += [truth.albedo_srgb, linear_to_srgb(ours.albedo.numpy())]
            tiles += _palms(checkpoint, capture, production, frame, len(truth.image_srgb))
    name = capture.split("train")[0].light
    assert name is not None
    learned = Light(checkpoint.probe_of(name).numpy())
    tiles += [_map(light, len(tiles[0])) for light in (capture.load_light(name), learned)]
    return np.concatenate([to_bytes(tile) for tile in tiles], axis=1)


def _palms(
    checkpoint: Checkpoint, capture: Capture, production: Production, frame: Frame, side: int
) -> list[NDArray[np.floating]]:
    """True and learned albedo [side, side, 3] sRGB of the left palm in ``frame``."""
    joint, offset, towards = CLOSE_UPS["left palm"]
    skeleton, motion, at = capture.body.skeleton, capture.motion, frame.frame
    moved = skeleton.joint_transforms(motion.rotations[at], motion.translations[at])
    wrist = moved[skeleton.names.index(joint)]
    target = wrist[:3, 3] + wrist[:3, :3] @ offset
    eye = target + PALM_DISTANCE * wrist[:3, :3] @ towards / np.linalg.norm(towards)
    camera = Camera.look_at(eye, target, width=side, height=side, fov_y=PALM_FOV)
    seen = replace(capture, cameras={**capture.cameras, "palm": camera})
    ours = Evaluator(checkpoint, seen).render(msgspec.structs.replace(frame, camera="palm"))
    surface = Wearer(production.dressed, production.motion, [at]).surface(at)
    truth = RenderSet(surface).truth(camera, samples=TRUTH_SAMPLES, seed=0)
    return [linear_to_srgb(np.clip(albedo, 0, 1)) for albedo in (truth.albedo, ours.albedo.numpy())]


def _map(light: Light, side: int) -> NDArray[np.float32]:
    """``light`` [side, side, 3] in sRGB, above black: its level is not compared here."""
    shown = light.resized(side // 2, side).radiance
    scaled = shown * (GREY / max(float((shown @ REC709_LUMINANCE).mean()), 1e-9))
    return cv2.copyMakeBorder(linear_to_srgb(scaled).astype(np.float32), 0, side - side // 2, 0, 0, cv2.BORDER_CONSTANT)
