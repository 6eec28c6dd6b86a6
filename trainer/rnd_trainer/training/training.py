"""The training: two stages of one image a step, and a short third without images. Read it top to bottom."""

from __future__ import annotations

import dataclasses
import gc
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor
from torch.nn.utils import get_total_norm

from rnd_runtime.capture.capture import Capture
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import sha256_of
from rnd_runtime.motion.motion import Motion, save_motion
from rnd_runtime.playback.doctor import machine
from rnd_runtime.shading.light import texel_directions
from rnd_trainer.config import TrainConfig, to_dict
from rnd_trainer.losses.perceptual import Perceptual, networks_by_role, networks_sha256
from rnd_trainer.model.checkpoint import save_checkpoint, write_tensors
from rnd_trainer.model.model import APPEARANCE_COLUMNS, AvatarModel, PoseInput
from rnd_trainer.model.template import sample_template
from rnd_trainer.render.probe import PROBE_SHAPE, LightProbe, as_probe

from . import light_search
from .data import TrainingView, load_views, pose_input, training_light, training_light_name
from .objective import Objective, noisy
from .pose_refinement import PoseRefinement
from .sampled_poses import perturbed_pose
from .schedule import Schedule
from .state import STATE_FILE, STATE_SCHEMA, learned_sha256, read_state
from .unseen import UnseenPoses

REFINED_MOTION = "refined_motion.npz"
"""beside the checkpoint: the capture's motion with corrected training frames"""
MAX_BAD_STEPS = 10
"""non-finite steps in a row after which training stops"""
PERTURBED_SHARE = 0.5
"""of the third stage's distillation steps in a perturbed training pose; the rest are in the training pose itself"""


@dataclass
class StepResult:
    """Loss terms of one step by name, its stage, and whether it was skipped as not finite."""

    index: int
    stage: int
    terms: dict[str, float]
    skipped: bool


class Training:
    """The state of a training, its step, and how it is saved and resumed.

    Args:
        capture: images, poses and body to learn from.
        config: schedule and weights.
        perceptual: network of the LPIPS loss; None leaves it out.
        consistency: network whose features the consistency loss compares, by default ``perceptual``.
        device: where the tensors are; random numbers come from the CPU on every device.

    Attributes:
        on_light_search: called with done and total while the light is searched.
    """

    def __init__(
        self,
        capture: Capture,
        config: TrainConfig,
        perceptual: Perceptual | None = None,
        device: torch.device | str = "cpu",
        *,
        consistency: Perceptual | None = None,
    ) -> None:
        if config.light == "learn":
            training_light_name(capture, "learning a light")
        self.capture, self.config, self.schedule = capture, config, Schedule(config)
        torch.manual_seed(config.seed)
        self.generator = torch.Generator().manual_seed(config.seed)
        self.device = torch.device(device)
        self.perceptual = None if perceptual is None else perceptual.to(device=self.device)
        self.consistency = self.perceptual if consistency is None else consistency.to(device=self.device)
        true_normals = config.normals == "true"
        self.views, self.bad_masks = load_views(capture, "train", config.image_scale, true_normals)
        template = sample_template(capture.body, config.model.gaussians, config.model.nodes, config.seed)
        self.model = AvatarModel(config.model, template).to(self.device)
        self.probe = LightProbe(config.probe_channels).to(self.device)
        fixed_light = self._capture_light() if config.light == "capture" else None
        networks = (self.perceptual, self.consistency)
        self.objective = Objective(config, self.probe, fixed_light, *networks, self.generator)
        self.poses = [self.pose(view) for view in self.views]
        self.refinement = self._refinement() if config.refine_poses else None
        self.unseen: UnseenPoses | None = None  # from the third stage on
        self.optimizer = self._optimizer()
        self.step_index = 0
        self.bad_steps = 0
        self.lit = False  # whether the second stage has begun
        self.light_found: bool | None = None  # in the search that it begins with, once that is done
        self.seconds = 0.0
        self.on_light_search: Callable[[int, int], None] = lambda done, total: None

    # -- one step ------------------------------------------------------------------------------------------

    def warm_up(self) -> None:
        """Take the most expensive kind of step without effect: compile its kernels, ask for its memory."""
        started = time.perf_counter()
        draws = self.generator.get_state()
        config = self.config
        period = math.lcm(config.lpips_every, config.consistency_every, config.repulsion_every)
        costliest = (config.steps - 1) // period * period  # all its terms are due
        stage = 1 if config.light == "none" else 2
        terms = self.objective(self.model, self.views[0], self.poses[0], costliest, stage)
        torch.stack(list(terms.values())).sum().backward()
        self.optimizer.zero_grad(set_to_none=True)
        self.generator.set_state(draws)
        if self._searches_light:
            light_search.warm_up()
        gc.collect()
        self.seconds += time.perf_counter() - started

    def step(self) -> StepResult:
        """Optimise on the next image. Raises ``InputError`` after ten non-finite steps in a row."""
        started = time.perf_counter()
        self._light_up()
        stage = self.stage
        self._set_rates()
        view_index = self._next_view()
        view, pose = self.views[view_index], self.poses[view_index]
        pose = noisy(pose, self.config.pose_noise, self.generator)
        terms = self._image_terms(view, pose, stage) if stage < 3 else self._unseen_terms(view, pose)
        values = torch.stack(list(terms.values()))
        total = values.sum()
        self.optimizer.zero_grad(set_to_none=True)
        finite = bool(torch.isfinite(total))
        if finite:
            total.backward()
            grads = [p.grad for p in self._parameters() if p.grad is not None]
            finite = bool(torch.isfinite(get_total_norm(grads)))  # asked once: a GPU must be waited for
        if finite:
            self.optimizer.step()
        self.bad_steps = 0 if finite else self.bad_steps + 1
        if self.bad_steps >= MAX_BAD_STEPS:
            raise InputError(f"training: {MAX_BAD_STEPS} steps in a row were not finite", frame=view.frame.frame)
        done = StepResult(self.step_index, stage, dict(zip(terms, values.tolist())), not finite)
        self.step_index += 1
        self._light_up()  # now, so that what is saved and shown after the first stage is lit
        self.seconds += time.perf_counter() - started
        return done

    def _light_up(self) -> None:
        """Begin the second stage, once: albedo from the first stage's colours, and a light."""
        if self.stage == 2 and not self.lit:
            self._start_albedo_from_colour()
            self._start_light()
            self.lit = True

    def _image_terms(self, view: TrainingView, pose: PoseInput, stage: int) -> dict[str, Tensor]:
        refinement = self.refinement if self.schedule.refines(self.step_index) else None
        if refinement is not None:
            pose = dataclasses.replace(pose, bones=refinement.bones(view.frame.frame))
        terms = self.objective(self.model, view, pose, self.step_index, stage)
        if refinement is not None:
            terms["poses"] = self.config.weight_poses * refinement.prior(view.frame.frame)
        return terms

    def _unseen_terms(self, view: TrainingView, pose: PoseInput) -> dict[str, Tensor]:
        if self.unseen is None:
            self.unseen = self._unseen()
        if self.refinement is not None:
            pose = dataclasses.replace(pose, bones=self.refinement.bones(view.frame.frame).detach())
        rng = np.random.default_rng((self.config.seed, self.step_index, 1))
        if rng.random() < PERTURBED_SHARE:
            pose = self._perturbed(view, rng)
        return self.unseen(self.model, pose, self.step_index)

    # -- schedule ------------------------------------------------------------------------------------------

    @property
    def stage(self) -> int:
        """Of the next step; see ``Schedule``."""
        return self.schedule.stage(self.step_index)

    def light(self) -> Tensor:
        """The light [32, 64, 3] of the training images: learned, or the capture's own."""
        return self.objective.light()

    def motion(self) -> Motion:
        """The capture's motion; with ``refine_poses`` its training frames are corrected."""
        return self.capture.motion if self.refinement is None else self.refinement.apply_to(self.capture.motion)

    def _set_rates(self) -> None:
        for group in self.optimizer.param_groups:
            group["lr"] = group["start_rate"] * self.schedule.decay(self.step_index)

    def _next_view(self) -> int:
        """Index of the next view: each once an epoch, in an order given by seed and epoch."""
        epoch, position = divmod(self.step_index, len(self.views))
        order = np.random.default_rng((self.config.seed, epoch)).permutation(len(self.views))
        return int(order[position])

    def _start_albedo_from_colour(self) -> None:
        """Copy the first stage's colour to the albedo, network and residual."""
        columns = list(APPEARANCE_COLUMNS)
        sizes = list(APPEARANCE_COLUMNS.values())
        start = [sum(sizes[:k]) for k in range(len(sizes))]
        colour, albedo = (slice(start[k], start[k] + 3) for k in map(columns.index, ("colour", "albedo")))
        last = self.model.appearance.out
        with torch.no_grad():
            last.weight[albedo] = last.weight[colour]
            last.bias[albedo] = last.bias[colour] + 1.0  # undoes the −1 of the albedo's activation
            self.model.appearance_residual[:, albedo] = self.model.appearance_residual[:, colour]

    def _start_light(self) -> None:
        """Search the images for a sky and directional lights."""
        if self._searches_light:
            motion = self.motion()
            poses = [self.pose(view, motion) for view in self.views]
            found = light_search.start_light(self.model, self.views, poses, self.on_light_search)
            self.light_found = found is not None
            if found is not None:
                self.probe.start_from(torch.from_numpy(found.radiance), torch.from_numpy(found.exposure))

    @property
    def _searches_light(self) -> bool:
        return self.config.light == "learn" and self.config.light_search

    def _parameters(self) -> list[Tensor]:
        return [p for group in self.optimizer.param_groups for p in group["params"]]

    def _optimizer(self) -> torch.optim.Adam:
        residuals = [self.model.geometry_residual, self.model.appearance_residual]
        networks = [p for p in self.model.parameters() if all(p is not r for r in residuals)]
        config = self.config
        parts = [
            (networks, config.rate_networks),
            (residuals, config.rate_residuals),
            ([self.probe.raw], config.rate_light),
        ]
        if self.refinement is not None:
            parts.append((list(self.refinement.raw), config.rate_poses))
        groups = [{"params": params, "lr": rate, "start_rate": rate} for params, rate in parts]
        return torch.optim.Adam(groups, betas=(0.9, 0.99), eps=1e-15)

    def pose(self, view: TrainingView, motion: Motion | None = None) -> PoseInput:
        """The networks' input for ``view``, in the capture's motion or another."""
        motion = self.capture.motion if motion is None else motion
        time_s = view.frame.frame / motion.fps
        return pose_input(motion, self.capture.body.skeleton, time_s, self.config.model).to(self.device)

    def _perturbed(self, view: TrainingView, rng: np.random.Generator) -> PoseInput:
        motion, skeleton = self.capture.motion, self.capture.body.skeleton
        time_s = view.frame.frame / motion.fps
        return perturbed_pose(motion, skeleton, time_s, self.config.model, rng).to(self.device)

    def _refinement(self) -> PoseRefinement:
        frames = [view.frame.frame for view in self.views]
        return PoseRefinement(self.capture.motion, self.capture.body.skeleton, frames).to(self.device)

    def _unseen(self) -> UnseenPoses:
        return UnseenPoses(self.model, self.capture.body.skeleton, self.config)

    def _capture_light(self) -> Tensor:
        light = training_light(self.capture)[1].resized(*PROBE_SHAPE)  # before rotating, which keeps a sun in one texel
        return as_probe(light.sample(texel_directions(*PROBE_SHAPE))).to(self.device)

    # -- saving and resuming -------------------------------------------------------------------------------

    def save(self, folder: Path) -> None:
        """Write the resumable state, the checkpoint, and the refined motion if there is one."""
        tensors = {f"model.{k}": v.cpu().contiguous() for k, v in self.model.state_dict().items()}
        tensors |= {f"probe.{k}": v.cpu().contiguous() for k, v in self.probe.state_dict().items()}
        if self.refinement is not None:
            tensors |= {f"poses.{k}": v.cpu().contiguous() for k, v in self.refinement.state_dict().items()}
        if self.unseen is not None:
            teacher = self.unseen.teacher.state_dict()
            tensors |= {f"teacher.{k}": v.cpu().contiguous() for k, v in teacher.items()}
        for index, values in self.optimizer.state_dict()["state"].items():
            tensors |= {f"adam.{index}.{k}": torch.as_tensor(v).cpu().contiguous() for k, v in values.items()}
        tensors["generator"] = self.generator.get_state()
        header = {
            "schema": STATE_SCHEMA,
            "config": to_dict(self.config),
            "step": self.step_index,
            "seconds": self.seconds,
            "bad_steps": self.bad_steps,
            "lit": self.lit,
            "networks": networks_by_role(self.perceptual, self.consistency),
            "capture_sha256": sha256_of(self.capture.file),
            "motion": Path(self.capture.motion.source).name,
            "learned_from_sha256": self._learned_from_sha256,
        }
        write_tensors(folder / STATE_FILE, tensors, header)
        save_checkpoint(
            folder / "avatar.ckpt", self.model, self.light(), self.capture.body.skeleton, self.config, self.info()
        )
        if self.refinement is not None:
            save_motion(folder / REFINED_MOTION, self.motion())

    def resume(self, path: Path) -> None:
        """Continue from a saved state on the same curve.

        Raises:
            InputError: another configuration, capture or network, or no state. Settings of the third stage may
                differ before it has begun.
        """
        saved = read_state(path)
        saved.refuse_other(self.config, networks_by_role(self.perceptual, self.consistency))
        header, teacher = saved.header, saved.part("teacher")
        if header.get("learned_from_sha256") != self._learned_from_sha256:
            raise InputError("--resume", expected="the images and poses it was started with", got="others", file=path)
        try:
            self.model.load_state_dict(saved.part("model"))
            self.probe.load_state_dict(saved.part("probe"))
            if self.refinement is not None:
                self.refinement.load_state_dict(saved.part("poses"))
            if teacher:
                self.unseen = self._unseen()
                self.unseen.teacher.load_state_dict(teacher)
            moments: dict[int, dict[str, Tensor]] = {}
            for name, value in saved.part("adam").items():
                index, key = name.split(".")
                moments.setdefault(int(index), {})[key] = value
            self.optimizer.load_state_dict({**self.optimizer.state_dict(), "state": moments})
            self.generator.set_state(saved.tensors["generator"])
            self.step_index, self.seconds = int(header["step"]), float(header["seconds"])
            self.bad_steps = int(header["bad_steps"])
            self.lit = bool(header["lit"])
        except (KeyError, RuntimeError, ValueError, TypeError) as error:
            raise InputError("not a training state", got=str(error).splitlines()[0], file=path) from error

    @cached_property
    def _learned_from_sha256(self) -> str:
        light = training_light(self.capture) if self.config.light == "capture" else None
        return learned_sha256(self.views, self.capture, self.config.image_scale, light)

    def _lights(self) -> list[str]:
        """Names of the lights in the training images."""
        return sorted({view.frame.light for view in self.views if view.frame.light})

    def info(self) -> dict[str, Any]:
        """Provenance for the checkpoint."""
        return {
            "capture": self.capture.folder.resolve().name,
            "capture_sha256": sha256_of(self.capture.file),
            "motion": Path(self.capture.motion.source).name,
            "lights": {name: self.capture.light_sha256(name) for name in self._lights()},
            "body_license": self.capture.body.license,
            "step": self.step_index,
            "steps_planned": self.schedule.total,
            "lit": self.lit,
            "minutes": round(self.seconds / 60, 3),
            "threads": numba.get_num_threads(),
            "machine": machine(),
            "device": "cpu" if self.device.type == "cpu" else torch.cuda.get_device_name(self.device),
            "images": len(self.views),
            "spacing_m": float(self.model.spacing),
            "perceptual": None if self.perceptual is None else self.perceptual.backbone,
            "perceptual_sha256": networks_sha256(self.perceptual),
            "consistency": None if self.consistency is None else self.consistency.backbone,
            "consistency_sha256": networks_sha256(self.consistency),
        }
