"""Held-out quality of a trained avatar: novel views, novel poses, new lights."""

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
from rnd_trainer.losses.perceptual import Perceptual
from rnd_trainer.model.checkpoint import Checkpoint
from rnd_trainer.training.data import pose_input, usable

from .evaluator import Rendered, render_runtime
from .scores import frame_scores, to_srgb8

HELD_OUT: tuple[Split, ...] = ("novel_view", "novel_pose", "relight")
FLICKER_FRAMES = 24
"""consecutive frames of the held-out motion that the flicker figure looks at"""


@dataclass
class SplitScore:
    """Means over the frames of one split of what ``evaluation.scores.frame_scores`` names.

    Each is of the frames that have it: a sliver of a person may have no normals to compare, and none for LPIPS.
    """

    split: str
    frames: int
    scores: dict[str, float]


class Evaluator:
    """Renders a trained avatar for the frames of a capture, each under its light.

    The light that the avatar was trained under is the learned probe, others come from the capture: both are what a
    player has.

    Args:
        mode: shading of the runtime.
        motion: poses to render, the capture's own unless given (exact ones for an avatar trained on noisy poses).
        cull: as of the player.
    """

    def __init__(
        self,
        checkpoint: Checkpoint,
        capture: Capture,
        mode: str = "table+sun",
        motion: Motion | None = None,
        cull: float | None = None,
    ) -> None:
        self.checkpoint, self.capture, self.mode, self.cull = checkpoint, capture, mode, cull
        self.motion = capture.motion_for(checkpoint.skeleton) if motion is None else motion
        self._trained = checkpoint.learned_under(capture)
        self._shaders: dict[str | None, Shader | None] = {}

    def render(self, frame: Frame, albedo_scale: Tensor | None = None, index: int | None = None) -> Rendered:
        """``frame``'s camera and light; ``index`` shows another motion frame instead of its own."""
        index = frame.frame if index is None else index
        if frame.split == "relight" and frame.light is None:
            expected = "the name of the light it was taken under"
            raise InputError(
                "light of a relight picture", expected=expected, got="none", frame=frame.frame, file=self.capture.file
            )
        model = self.checkpoint.config.model
        pose = pose_input(self.motion, self.checkpoint.skeleton, index / self.motion.fps, model)
        camera = self.capture.cameras[frame.camera]
        shader = self._shader(frame.light)
        return render_runtime(self.checkpoint.model, pose, camera, shader, albedo_scale, self.cull)

    def _shader(self, name: str | None) -> Shader | None:
        if name not in self._shaders:
            known = name is not None and name not in self._trained
            light = self.capture.load_light(name) if name and known else Light(self.checkpoint.probe.numpy())
            plain = self.checkpoint.config.light == "none"  # colours that no light changes
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
    """Score one split; pictures that show nobody are left out, as in training.

    Args:
        albedo_scale: [3] factor on the albedo, for relighting with the albedo–light ambiguity taken out.
        shown_scale: [3] factor on the albedo picture alone, where that is compared with the truth.
        perceptual: LPIPS of these weights is reported too.
        on_frame: called with each frame, its rendering and the true image [H, W, 3] (sRGB).
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
        expected = "a person in one picture at least"
        raise InputError(f"split {split!r}", expected=expected, got="none", file=evaluator.capture.folder)
    figures: dict[str, list[float]] = {}
    for row in rows:
        for name, value in row.items():
            figures.setdefault(name, []).append(value)
    return SplitScore(split, len(rows), {name: float(np.mean(values)) for name, values in figures.items()})


def flicker(evaluator: Evaluator, split: Split = "novel_pose") -> float | None:
    """Mean |I₋₁ − 2 I₀ + I₊₁| / 2 over the person, in 8-bit sRGB levels, over consecutive frames of the motion.

    From the split's first frame on, whether all of them are held out or not: nothing is compared with a picture.
    Motion at constant speed cancels in the second difference to first order; what jumps does not. None where the
    motion has fewer than three frames from there on, or nobody is seen.
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
    """Per-channel least-squares factor [3] from the learned to the true albedo, over training frames that have it.

    Albedo and light are known up to this factor; IntrinsicAvatar's protocol fits it before relighting.
    None where the capture has no albedo, or nothing there is covered by both.
    """
    ours, theirs = [], []
    for frame in evaluator.capture.split("train"):
        if frame.albedo is None:
            continue
        truth = evaluator.capture.load_frame(frame)
        assert truth.albedo_srgb is not None
        rendered = evaluator.render(frame)
        inside = (torch.from_numpy(truth.mask) > 0.99) & (rendered.alpha > 0.99)
        ours.append(rendered.albedo[inside])
        theirs.append(torch.from_numpy(srgb_to_linear(truth.albedo_srgb)).float()[inside])
    if not ours:
        return None
    x, y = torch.cat(ours), torch.cat(theirs)
    scale = (x * y).sum(0) / (x * x).sum(0)
    return scale if bool(torch.isfinite(scale).all()) else None
