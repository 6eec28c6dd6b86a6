"""The training loop: two stages, one picture a step. Read it top to bottom."""

from __future__ import annotations

import json
import math
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

import numpy as np
import torch
from torch import Tensor

from rnd_runtime.capture import Capture
from rnd_runtime.errors import InputError
from rnd_runtime.files import atomic_path
from rnd_runtime.light import texel_directions

from .checkpoint import read_tensors, save_checkpoint, write_tensors
from .config import TrainConfig, to_dict
from .data import View, load_views, pose_input
from .light import PROBE_SHAPE, LightProbe, all_texels, as_probe, draw_texels
from .losses import geometry_prior, grey_prior, image_loss, linear_to_srgb, skinning_divergence
from .model import APPEARANCE_COLUMNS, AvatarModel, Posed, PoseInput
from .render import shade_visible, splat
from .shading import sh_basis, traced_visibility
from .template import sample_template

STATE_SCHEMA = "rnd-training/1"
MAX_BAD_STEPS = 10
"""non-finite steps in a row after which training stops: it will not recover"""


@dataclass
class Step:
    """What one step did: the loss terms by name, its stage, and whether it was skipped as not finite."""

    index: int
    stage: int
    terms: dict[str, float]
    skipped: bool


class Training:
    """All that changes while an avatar is trained, and how it is saved and resumed.

    Args:
        capture: the pictures, poses and body to learn from.
        config: schedule and weights.
    """

    def __init__(self, capture: Capture, config: TrainConfig) -> None:
        self.capture, self.config = capture, config
        torch.manual_seed(config.seed)
        self.generator = torch.Generator().manual_seed(config.seed)
        self.views, self.bad_masks = load_views(capture, "train", config.image_scale)
        template = sample_template(capture.body, config.model.gaussians, config.model.nodes, config.seed)
        self.model = AvatarModel(config.model, template)
        self.probe = LightProbe()
        self.fixed_light = self._capture_light() if config.light == "capture" else None
        self.poses = [self._pose(view) for view in self.views]
        self.optimizer = self._optimizer()
        self.step_index = 0
        self.bad_steps = 0
        self.seconds = 0.0

    # -- one step ------------------------------------------------------------------------------------------

    def step(self) -> Step:
        """Optimise on the next picture. Raises :class:`InputError` after ten non-finite steps in a row."""
        started = time.perf_counter()
        stage = self.stage
        if self.step_index == self.stage1_steps:
            self._start_albedo_from_colour()
        self._set_rates()
        view_index = self._next_view()
        terms = self._losses(self.views[view_index], self._noisy(self.poses[view_index]), stage)
        total = torch.stack(list(terms.values())).sum()
        self.optimizer.zero_grad(set_to_none=True)
        finite = bool(torch.isfinite(total))
        if finite:
            total.backward()
            finite = all(bool(torch.isfinite(p.grad).all()) for p in self._parameters() if p.grad is not None)
        if finite:
            self.optimizer.step()
        self.bad_steps = 0 if finite else self.bad_steps + 1
        if self.bad_steps >= MAX_BAD_STEPS:
            raise InputError(
                f"training: {MAX_BAD_STEPS} steps in a row were not finite",
                frame=self.views[view_index].frame.frame,
            )
        done = Step(
            self.step_index, stage, {name: float(value.detach()) for name, value in terms.items()}, not finite
        )
        self.step_index += 1
        self.seconds += time.perf_counter() - started
        return done

    def _losses(self, view: View, pose: PoseInput, stage: int) -> dict[str, Tensor]:
        """Weighted loss terms of one picture."""
        config, model = self.config, self.model
        posed = model(pose)
        terms = {
            "visibility": config.weight_visibility * self._visibility_loss(posed, pose),
            "skinning": config.weight_skinning
            * self._decay()
            * skinning_divergence(posed.weights, model.log_weights),
            "geometry": geometry_prior(posed, config.weight_offset, config.weight_residual),
        }
        if stage == 1:
            radiance = posed.attributes.colour
        else:
            light = self.light()
            maps = (light, self.probe.directions, self.probe.solid_angles)
            full = self.step_index >= config.steps * (1 - config.full_light_fraction)
            texels = all_texels(*maps) if full else draw_texels(*maps, config.light_texels, self.generator)
            radiance = shade_visible(
                posed, pose, texels, view.camera, float(model.spacing), config.traced_texels
            )
            if self.fixed_light is None:
                terms["grey"] = config.weight_light_grey * grey_prior(light, self.probe.solid_angles)
        picture = splat(posed, radiance, view.camera)
        background = torch.rand(3, generator=self.generator)
        target, mask = view.target(background)
        image = picture.image + (1 - picture.alpha[..., None]) * background
        terms["image"] = image_loss(linear_to_srgb(image), linear_to_srgb(target), config.weight_dssim)
        terms["mask"] = config.weight_mask * (picture.alpha - mask).abs().mean()
        normals = view.normals()
        if normals is not None:
            terms["normal"] = config.weight_normal * (picture.normals - normals).abs().mean()
        return terms

    def _visibility_loss(self, posed: Posed, pose: PoseInput) -> Tensor:
        """Square error of the harmonics against shadow-mapped visibility at the nodes, in random directions."""
        nodes = self.config.model.nodes
        directions = torch.randn(self.config.visibility_directions, 3, generator=self.generator)
        directions = torch.nn.functional.normalize(directions, dim=-1)
        spacing = float(self.model.spacing) * math.sqrt(self.config.model.gaussians / nodes)
        means, normals = posed.means[:nodes], posed.normals[:nodes]
        truth = traced_visibility(means, normals, directions, spacing)
        above = (normals.detach() @ directions.T).clamp(min=0)  # what is below the horizon is never asked for
        predicted = posed.visibility[:nodes] @ sh_basis(directions @ pose.bones[0, :, :3]).T
        return (above * (predicted - truth).square()).mean()

    # -- schedule ------------------------------------------------------------------------------------------

    @property
    def stage1_steps(self) -> int:
        """Steps of the first stage."""
        return round(self.config.stage1_fraction * self.config.steps)

    @property
    def stage(self) -> int:
        """Of the next step: 1 geometry under plain colours, 2 the light."""
        return 1 if self.step_index < self.stage1_steps else 2

    def light(self) -> Tensor:
        """The light [32, 64, 3] of the training pictures: learned, or the capture's own."""
        return self.probe.radiance() if self.fixed_light is None else self.fixed_light

    def _decay(self) -> float:
        """1 at the start, 0.1 at the end, exponential."""
        return 0.1 ** (self.step_index / self.config.steps)

    def _set_rates(self) -> None:
        for group in self.optimizer.param_groups:
            group["lr"] = group["start_rate"] * self._decay()

    def _next_view(self) -> int:
        """Every picture once an epoch, in an order that depends on the seed and the epoch alone."""
        epoch, position = divmod(self.step_index, len(self.views))
        order = np.random.default_rng((self.config.seed, epoch)).permutation(len(self.views))
        return int(order[position])

    def _noisy(self, pose: PoseInput) -> PoseInput:
        """The encoders' input with noise; the bones, which place the picture, stay exact."""
        sigma = self.config.pose_noise
        noise = sigma * torch.randn(pose.window.shape[1:], generator=self.generator)
        velocity = pose.velocity + 10 * sigma * torch.randn(pose.velocity.shape, generator=self.generator)
        return PoseInput(pose.window + noise, velocity, pose.bones)

    def _start_albedo_from_colour(self) -> None:
        """The first stage's colour is the best first albedo there is: copy it, network and residual alike."""
        columns = list(APPEARANCE_COLUMNS)
        sizes = list(APPEARANCE_COLUMNS.values())
        start = [sum(sizes[:k]) for k in range(len(sizes))]
        colour, albedo = (slice(start[k], start[k] + 3) for k in map(columns.index, ("colour", "albedo")))
        last = self.model.appearance.out
        with torch.no_grad():
            last.weight[albedo] = last.weight[colour]
            last.bias[albedo] = last.bias[colour] + 1.0  # undoes the −1 of the albedo's activation
            self.model.appearance_residual[:, albedo] = self.model.appearance_residual[:, colour]

    def _parameters(self) -> list[Tensor]:
        return [p for group in self.optimizer.param_groups for p in group["params"]]

    def _optimizer(self) -> torch.optim.Adam:
        residuals = [self.model.geometry_residual, self.model.appearance_residual]
        networks = [p for p in self.model.parameters() if all(p is not r for r in residuals)]
        rates = self.config.rate_networks, self.config.rate_residuals, self.config.rate_light
        groups = [
            {"params": params, "lr": rate, "start_rate": rate}
            for params, rate in zip((networks, residuals, [self.probe.raw]), rates)
        ]
        return torch.optim.Adam(groups, betas=(0.9, 0.99), eps=1e-15)

    def _pose(self, view: View) -> PoseInput:
        time_s = view.frame.frame / self.capture.motion.fps
        return pose_input(self.capture.motion, self.capture.body.skeleton, time_s, self.config.model)

    def _capture_light(self) -> Tensor:
        names = {view.frame.light or "unknown" for view in self.views}
        if len(names) != 1:
            raise InputError("training light", expected="one light in the train split", got=sorted(names))
        light = self.capture.load_light(names.pop()).resized(
            *PROBE_SHAPE
        )  # before turning: a sun stays whole
        return as_probe(light.sample(texel_directions(*PROBE_SHAPE)))

    # -- saving and resuming -------------------------------------------------------------------------------

    def save(self, folder: Path) -> None:
        """Write the resumable state, then the avatar."""
        tensors = {f"model.{k}": v.contiguous() for k, v in self.model.state_dict().items()}
        tensors |= {f"probe.{k}": v.contiguous() for k, v in self.probe.state_dict().items()}
        for index, values in self.optimizer.state_dict()["state"].items():
            tensors |= {f"adam.{index}.{k}": torch.as_tensor(v).contiguous() for k, v in values.items()}
        tensors["generator"] = self.generator.get_state()
        header = {
            "schema": STATE_SCHEMA,
            "config": to_dict(self.config),
            "step": self.step_index,
            "seconds": self.seconds,
            "bad_steps": self.bad_steps,
        }
        write_tensors(folder / "training.state", tensors, header)
        save_checkpoint(
            folder / "avatar.ckpt",
            self.model,
            self.light(),
            self.capture.body.skeleton,
            self.config,
            self.info(),
        )

    def resume(self, path: Path) -> None:
        """Continue from a saved state as if never stopped; the configuration must be the same."""
        tensors, header = read_tensors(path, STATE_SCHEMA)
        if header.get("config") != to_dict(self.config):
            wrong = sorted(k for k, v in to_dict(self.config).items() if header.get("config", {}).get(k) != v)
            raise InputError(
                "--resume", expected="the configuration it was started with", got=f"other {wrong}", file=path
            )
        try:
            self.model.load_state_dict(_strip(tensors, "model."))
            self.probe.load_state_dict(_strip(tensors, "probe."))
            moments: dict[int, dict[str, Tensor]] = {}
            for name, value in _strip(tensors, "adam.").items():
                index, key = name.split(".")
                moments.setdefault(int(index), {})[key] = value
            self.optimizer.load_state_dict({**self.optimizer.state_dict(), "state": moments})
            self.generator.set_state(tensors["generator"])
            self.step_index, self.seconds = int(header["step"]), float(header["seconds"])
            self.bad_steps = int(header["bad_steps"])
        except (KeyError, RuntimeError, ValueError, TypeError) as error:
            raise InputError("not a training state", got=str(error).splitlines()[0], file=path) from error

    def info(self) -> dict[str, Any]:
        """Provenance for the checkpoint."""
        return {
            "capture": self.capture.folder.name,
            "body_license": self.capture.body.license,
            "step": self.step_index,
            "minutes": round(self.seconds / 60, 3),
            "pictures": len(self.views),
            "spacing_m": float(self.model.spacing),
        }


def run(
    training: Training, folder: Path, *, on_step: Callable[[Step], None], on_preview: Callable[[], None]
) -> bool:
    """Train to the last step, saving every ``save_every`` steps and at the end.

    Ctrl-C finishes the step in hand, saves, and returns True: resuming continues the very same curve.
    """
    config = training.config
    with (
        _keep_until(folder / "metrics.jsonl", training.step_index) as log,
        _deferred_interrupt() as interrupted,
    ):
        while training.step_index < config.steps and not interrupted():
            step = training.step()
            row = {
                "step": step.index,
                "stage": step.stage,
                "seconds": round(training.seconds, 3),
                **step.terms,
            }
            log.write(json.dumps(row | ({"skipped": True} if step.skipped else {})) + "\n")
            on_step(step)
            if training.step_index % config.save_every == 0:
                log.flush()
                training.save(folder)
            if training.step_index % config.preview_every == 0 or training.step_index == config.steps:
                on_preview()
        training.save(folder)
        return interrupted()


def _keep_until(path: Path, step: int) -> TextIO:
    """The metrics log, without rows at or after ``step``: those steps will be done again."""
    kept = []
    if path.exists():
        kept = [
            line
            for line in path.read_text(encoding="utf-8").splitlines()
            if line and json.loads(line)["step"] < step
        ]
    with atomic_path(path) as temporary:
        temporary.write_text("".join(line + "\n" for line in kept), encoding="utf-8")
    return path.open("a", encoding="utf-8")


@contextmanager
def _deferred_interrupt() -> Iterator[Callable[[], bool]]:
    """Turn the first Ctrl-C into a flag; a second one interrupts at once."""
    pressed = False

    def handle(number: int, frame: object) -> None:
        nonlocal pressed
        if pressed:
            raise KeyboardInterrupt
        pressed = True

    if threading.current_thread() is not threading.main_thread():  # only the main thread may handle signals
        yield lambda: False
        return
    before = signal.signal(signal.SIGINT, handle)
    try:
        yield lambda: pressed
    finally:
        signal.signal(signal.SIGINT, before)


def _strip(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}
