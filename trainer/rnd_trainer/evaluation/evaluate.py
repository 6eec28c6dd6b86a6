"""Evaluation on held-out frames: novel views, novel poses, new lights."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from rnd_runtime.capture.capture import Capture, Frame
from rnd_runtime.capture.format import Split
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.images import srgb_to_linear
from rnd_runtime.motion.motion import Motion
from rnd_runtime.shading.light import Light
from rnd_runtime.shading.shader import Shader
from rnd_trainer.config import TrainConfig
from rnd_trainer.losses.perceptual import Perceptual
from rnd_trainer.model.checkpoint import Checkpoint
from rnd_trainer.training.data import pose_input, usable

from .evaluator import Rendered, render_runtime
from .scores import frame_scores, to_srgb8

HELD_OUT: tuple[Split, ...] = ("novel_view", "novel_pose", "relight")
"""test splits"""
FLICKER_FRAMES = 24
"""consecutive frames over which flicker is measured"""


def scored_splits(config: TrainConfig) -> tuple[Split, ...]:
    """The splits that a trained avatar is scored on: one that held frames out never sees a test split."""
    return ("validation",) if config.hold_out else HELD_OUT


@dataclass
class SplitScore:
    """Means of ``evaluation.scores.frame_scores`` over a split, each over the frames that have it."""

    split: str
    frames: int
    scores: dict[str, float]


class Evaluator:
    """Renders a trained avatar for the frames of a capture, each under its light.

    Of an avatar that held frames out, the capture has the split ``validation``. Frames under a training light are lit
    by the probe learned of it, others by the capture's light maps.

    Args:
        mode: shading of the runtime.
        motion: poses to render, by default the capture's.
        cull: as of ``rnd_runtime.playback.frame.FrameRenderer``.
    """

    def __init__(
        self,
        checkpoint: Checkpoint,
        capture: Capture,
        mode: str = "table+sun",
        motion: Motion | None = None,
        cull: float | None = None,
    ) -> None:
        capture = capture.holding_out() if checkpoint.config.hold_out else capture
        self.checkpoint, self.capture, self.mode, self.cull = checkpoint, capture, mode, cull
        self.motion = capture.motion_for(checkpoint.skeleton) if motion is None else motion
        self._trained = checkpoint.learned_under(capture)
        self._shaders: dict[str | None, Shader | None] = {}

    def render(self, frame: Frame, albedo_scale: Tensor | None = None, index: int | None = None) -> Rendered:
        """Render ``frame``, or with its camera and light motion frame ``index``."""
        index = frame.frame if index is None else index
        if frame.split == "relight" and frame.light is None:
            expected = "the name of its light"
            raise InputError(
                "light of a relight image", expected=expected, got="none", frame=frame.frame, file=self.capture.file
            )
        model = self.checkpoint.config.model
        pose = pose_input(self.motion, self.checkpoint.skeleton, index / self.motion.fps, model)
        camera = self.capture.cameras[frame.camera]
        shader = self._shader(frame.light)
        return render_runtime(self.checkpoint.model, pose, camera, shader, albedo_scale, self.cull)

    def _shader(self, name: str | None) -> Shader | None:
        if name not in self._shaders:
            known = name is not None and name not in self._trained
            light = self.capture.load_light(name) if name and known else Light(self.checkpoint.probe_of(name).numpy())
            plain = self.checkpoint.config.light == "none"
            self._shaders[name] = None if plain else Shader(light, self.mode)
        return self._shaders[name]


def evaluate(
    evaluator: Evaluator,
    split: Split,
    *,
    albedo_scale: Tensor | None = None,
    shown_scale: Tensor | None = None,
    perceptual: Perceptual | None = None,
    on_frame: Callable[[Frame, Rendered, Tensor], None] | None = None,
) -> SplitScore:
    """Score one split, without frames whose masks are empty or full.

    Args:
        albedo_scale: [3] factor on the albedo, which removes the albedo–light ambiguity from relighting.
        shown_scale: [3] factor on the albedo image alone, for its score.
        perceptual: network of LPIPS.
        on_frame: called with each frame, its rendering and the true image [H, W, 3] sRGB.
    """
    rows: list[dict[str, float]] = []
    frames = evaluator.capture.split(split)
    for frame in frames:
        truth = evaluator.capture.load_frame(frame)
        if not usable(truth.mask):
            continue
        rendered = evaluator.render(frame, albedo_scale)
        rows.append(frame_scores(rendered, truth, perceptual, None if albedo_scale is not None else shown_scale))
        if on_frame is not None:
            on_frame(frame, rendered, torch.from_numpy(truth.image_srgb))
    if not rows:
        expected = "a person in one image at least"
        raise InputError(f"split {split!r}", expected=expected, got="none", file=evaluator.capture.folder)
    by_name: dict[str, list[float]] = {}
    for row in rows:
        for name, value in row.items():
            by_name.setdefault(name, []).append(value)
    return SplitScore(split, len(rows), {name: float(np.mean(values)) for name, values in by_name.items()})


def flicker(evaluator: Evaluator, split: Split = "novel_pose") -> float | None:
    """Mean |I₋₁ − 2 I₀ + I₊₁| / 2 over the person, in 8-bit sRGB levels, over consecutive motion frames.

    Starts at the first frame of ``split``. Motion at constant speed cancels to first order. None with fewer than three
    frames or without visible pixels.
    """
    frames = sorted(evaluator.capture.split(split), key=lambda frame: (frame.camera, frame.frame))
    if not frames:
        return None
    first = frames[0]
    last = min(first.frame + FLICKER_FRAMES, evaluator.motion.frame_count)
    if last - first.frame < 3:
        return None
    shown = [evaluator.render(first, index=k) for k in range(first.frame, last)]
    images = torch.stack([to_srgb8(r.image) for r in shown])
    covered = torch.stack([r.alpha for r in shown])[1:-1] > 0.5
    if not covered.any():
        return None
    second = (images[:-2] - 2 * images[1:-1] + images[2:]).abs().mean(-1) / 2
    return float(255 * second[covered].mean())


def albedo_scale(evaluator: Evaluator) -> Tensor | None:
    """Per-channel least-squares factor [3] from learned to true albedo, over training frames with albedo.

    Removes the albedo–light ambiguity as in IntrinsicAvatar's protocol. None without true albedo.
    """
    learned, true = [], []
    for frame in evaluator.capture.split("train"):
        if frame.albedo is None:
            continue
        truth = evaluator.capture.load_frame(frame)
        assert truth.albedo_srgb is not None
        rendered = evaluator.render(frame)
        inside = (torch.from_numpy(truth.mask) > 0.99) & (rendered.alpha > 0.99)
        learned.append(rendered.albedo[inside])
        true.append(torch.from_numpy(srgb_to_linear(truth.albedo_srgb)).float()[inside])
    if not learned:
        return None
    x, y = torch.cat(learned), torch.cat(true)
    scale = (x * y).sum(0) / (x * x).sum(0)
    return scale if bool(torch.isfinite(scale).all()) else None
