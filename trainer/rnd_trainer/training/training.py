"""Training: geometry, then albedo and light, one image per step; then unseen poses without images."""

from __future__ import annotations

import dataclasses
import gc
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.utils import get_total_norm

from rnd_runtime.capture.capture import Capture
from rnd_runtime.core.errors import InputError
from rnd_runtime.motion.motion import Motion
from rnd_runtime.shading.light import Light
from rnd_trainer.config import TrainConfig
from rnd_trainer.losses.perceptual import Perceptual
from rnd_trainer.model.model import APPEARANCE_COLUMNS, AvatarModel, PoseInput
from rnd_trainer.model.template import sample_template

from .data import TrainingView, load_views, pose_input
from .lighting import light_search
from .lighting.grey_card import card_gain
from .lighting.lights import KnownLight, TrainingLights, capture_lights, light_names
from .lighting.place import placed_light
from .lighting.skin import TONES, skin_points
from .objective import Objective
from .poses.jitter import without_jitter
from .poses.refinement import PoseRefinement
from .poses.render_and_compare import SCALE, Compared, Search, fit_pose, frozen, unless_raised
from .poses.uncertainty import load_uncertainty
from .sampled_poses import VELOCITY_NOISE_RATE, jittered_pose, perturbed_pose
from .schedule import Schedule
from .soap import Soap
from .state import learned_sha256
from .unseen import UnseenPoses
from .unseen_surface import evidence, fill_in

BETAS = (0.9, 0.99)
"""decay of the running means of gradients and of their squares"""
MAX_BAD_STEPS = 10
"""consecutive non-finite steps after which training stops"""
PERTURBED_SHARE = 0.5
"""share of the distillation steps in a perturbed training pose; the rest use the training pose"""

LIGHT_SEARCH, POSE_FIT = "searching the light", "fitting poses to the avatar"
"""names of what takes longer than a step"""
SEARCH = Search(steps=20, rate=1e-2, cools=True, root_moves=False)
"""of every pose at each of the schedule's fits; a root that moves drifts away with the avatar"""


@dataclass
class StepResult:
    """Loss terms of one step by name, its stage, and whether it was skipped as not finite."""

    index: int
    stage: int
    terms: dict[str, float]
    skipped: bool


class Training:
    """The state of a training, with its step; saved and resumed by ``training.saving``.

    Args:
        capture: images, poses and body to learn from.
        config: schedule and weights.
        perceptual: network of the LPIPS loss; None leaves it out.
        consistency: network of the consistency loss, by default ``perceptual``.
        known: what the user knows of a light that is learned.
        device: of the tensors; random numbers come from the CPU on every device.

    Attributes:
        on_search: called with a phase's name, done and total during the light search and fits of poses.
    """

    def __init__(
        self,
        capture: Capture,
        config: TrainConfig,
        perceptual: Perceptual | None = None,
        device: torch.device | str = "cpu",
        *,
        consistency: Perceptual | None = None,
        known: KnownLight | None = None,
    ) -> None:
        capture = capture.holding_out() if config.hold_out else capture
        if config.refine_poses:
            capture = dataclasses.replace(capture, motion=without_jitter(capture.motion))
        self.capture, self.config, self.schedule = capture, config, Schedule(config)
        torch.manual_seed(config.seed)
        self.generator = torch.Generator().manual_seed(config.seed)
        self.device = torch.device(device)
        self.perceptual = None if perceptual is None else self._placed(perceptual)
        self.consistency = self.perceptual if consistency is None else self._placed(consistency)

        # data
        self.views, self.bad_masks = load_views(capture, "train", config.image_scale, config.normals == "true")
        self.poses = [self.pose(view) for view in self.views]

        # model, lights, pose corrections
        template = sample_template(capture.body, config.model.gaussians, config.model.nodes, config.seed)
        self._skin = skin_points(template, capture.body.skeleton)
        self.model = AvatarModel(config.model, template).to(self.device)
        names = light_names(view.frame for view in self.views)
        self.lights, self.known = TrainingLights(names, config.probe_channels), known or KnownLight()
        self.given_lights: dict[str, Light] = {}
        if config.light == "capture":
            self.given_lights = capture_lights(capture)
            self.lights.fix(self.given_lights)
        if self.known.place is not None:
            self.known.check(names)
            self.given_lights = {"--hdr": self.known.place}
            self.lights.fix()
        if self.known.card is not None:
            view = self.known.card.view(self.views)
            self._card_pixel = self.known.card.pixel(view, capture.cameras[view.frame.camera])
        self.lights.to(self.device)
        self.refinement: PoseRefinement | None = None
        self.fits_poses = False  # between steps, as those of a video, instead of in every step
        if config.refine_poses:
            frames = [view.frame.frame for view in self.views]
            motion, skeleton = capture.motion, capture.body.skeleton
            unsure = load_uncertainty(capture.folder, motion.frame_count, len(skeleton))
            self.refinement = PoseRefinement(motion, skeleton, frames, unsure).to(self.device)
            self.fits_poses = unsure is not None

        # objectives: of an image, and from the third stage on of unseen poses
        self.objective = Objective(config, self.lights, self.perceptual, self.consistency, self.generator)
        self.unseen: UnseenPoses | None = None

        # optimizers
        residuals = [self.model.geometry_residual, self.model.appearance_residual]
        networks = [p for p in self.model.parameters() if all(p is not r for r in residuals)]
        matrices = [p for p in networks if p.ndim == 2]
        rates: list[tuple[Sequence[Tensor], float]] = [
            ([p for p in networks if p.ndim != 2], config.rate_networks),
            (residuals, config.rate_residuals),
            ([self.lights.probes.raw], config.rate_light),
        ]
        if self.refinement is not None and not self.fits_poses:
            rates.append((list(self.refinement.raw), config.rate_poses))
        self.optimizers = {
            "adam": torch.optim.Adam(_with_rates(rates), config.rate_networks, BETAS, eps=1e-15),
            "soap": Soap(_with_rates([(matrices, config.rate_matrices)]), config.rate_matrices, BETAS),
        }

        # progress
        self.step_index = 0
        self.bad_steps = 0
        self.lit = False  # whether the second stage has begun
        self.light_found: bool | None = None  # result of the light search, once done
        self.seconds = 0.0
        self.on_search: Callable[[str, int, int], None] = lambda name, done, total: None

    def _placed(self, network: Perceptual) -> Perceptual:
        return network.in_bfloat16() if self.device.type == "cpu" else network.to(device=self.device)

    # -- one step ------------------------------------------------------------------------------------------

    def warm_up(self) -> None:
        """Compile kernels and allocate memory by the most expensive kind of step, without effect."""
        started = time.perf_counter()
        random_state = self.generator.get_state()
        config = self.config
        period = math.lcm(config.lpips_every, config.consistency_every, config.repulsion_every)
        step = (config.steps - 1) // period * period  # all its terms are due
        stage = 1 if config.light == "none" else 2
        terms = self.objective(self.model, self.views[0], self.poses[0], step, stage)
        torch.stack(list(terms.values())).sum().backward()
        self._zero_grad()
        self.generator.set_state(random_state)
        if self._searches_light:
            light_search.warm_up()
        gc.collect()
        self.seconds += time.perf_counter() - started

    def step(self) -> StepResult:
        """Optimise on the next view. Raises ``InputError`` after ``MAX_BAD_STEPS`` non-finite steps in a row."""
        started = time.perf_counter()
        self._start_second_stage()
        if self.fits_poses and self.schedule.fits_poses(self.step_index):
            self._fit_poses()
        stage = self.stage
        for group in self._groups:
            group["lr"] = group["start_rate"] * self.schedule.decay(self.step_index)

        # next view, each once per epoch
        epoch, position = divmod(self.step_index, len(self.views))
        index = int(np.random.default_rng((self.config.seed, epoch)).permutation(len(self.views))[position])
        noise = self.config.pose_noise
        view = self.views[index]
        pose = jittered_pose(self.poses[index], self.generator, noise, VELOCITY_NOISE_RATE * noise)

        # loss
        terms = self._image_terms(view, pose, stage) if stage < 3 else self._unseen_terms(view, pose)
        values = torch.stack(list(terms.values()))
        total = values.sum()

        # gradient and update
        self._zero_grad()
        finite = bool(torch.isfinite(total))
        if finite:
            total.backward()
            parameters = [p for group in self._groups for p in group["params"]]
            norm = get_total_norm([p.grad for p in parameters if p.grad is not None])
            finite = bool(torch.isfinite(norm))  # one test of all gradients: each synchronises a GPU
        if finite:
            for optimizer in self.optimizers.values():
                optimizer.step()

        self.bad_steps = 0 if finite else self.bad_steps + 1
        if self.bad_steps >= MAX_BAD_STEPS:
            raise InputError(f"training: {MAX_BAD_STEPS} steps in a row were not finite", frame=view.frame.frame)
        done = StepResult(self.step_index, stage, dict(zip(terms, values.tolist())), not finite)
        self.step_index += 1
        self._start_second_stage()  # before a state or preview at the end of the first stage
        if self.step_index == self.config.steps and self.lit:
            motion = self.motion()
            poses = [self.pose(view, motion) for view in self.views]
            fill_in(self.model, evidence(self.model, self.views, poses))
        self.seconds += time.perf_counter() - started
        return done

    @property
    def _groups(self) -> list[dict[str, Any]]:
        return [group for optimizer in self.optimizers.values() for group in optimizer.param_groups]

    def _zero_grad(self) -> None:
        for optimizer in self.optimizers.values():
            optimizer.zero_grad(set_to_none=True)

    def _image_terms(self, view: TrainingView, pose: PoseInput, stage: int) -> dict[str, Tensor]:
        """Loss terms of the first and second stage."""
        frame = view.frame.frame
        corrected = self.refinement if self.fits_poses or self.schedule.refines(self.step_index) else None
        if corrected is not None:
            bones = corrected.bones(frame)
            pose = dataclasses.replace(pose, bones=bones.detach() if self.fits_poses else bones)
        terms = self.objective(self.model, view, pose, self.step_index, stage)
        if corrected is not None and not self.fits_poses:
            terms["poses"] = self.config.weight_poses * corrected.prior(frame)
        return terms

    def _unseen_terms(self, view: TrainingView, pose: PoseInput) -> dict[str, Tensor]:
        """Loss terms of the third stage."""
        if self.unseen is None:
            self.unseen = UnseenPoses(self.model, self.capture.body.skeleton, self.config)
        if self.refinement is not None:
            pose = dataclasses.replace(pose, bones=self.refinement.bones(view.frame.frame).detach())
        rng = np.random.default_rng((self.config.seed, self.step_index, 1))
        if rng.random() < PERTURBED_SHARE:
            motion, skeleton = self.capture.motion, self.capture.body.skeleton
            time_s = view.frame.frame / motion.fps
            pose = perturbed_pose(motion, skeleton, time_s, self.config.model, rng).to(self.device)
        return self.unseen(self.model, pose, self.step_index)

    # -- fits of poses -------------------------------------------------------------------------------------

    def _fit_poses(self) -> None:
        """Correct the poses of all images until the avatar as it is looks like them; it learns from these.

        What ``on_search`` raises leaves the poses as they were.
        """
        assert self.refinement is not None
        radiance, probes = self.lights.radiance().detach(), self.lights.probes
        generator = torch.Generator().manual_seed(self.config.seed + self.step_index)
        with frozen(self.model), unless_raised(self.refinement):
            for done, (frame, views) in enumerate(self._small_views.items()):
                self.on_search(POSE_FIT, done, len(self._small_views))
                lights = [radiance[self.lights.index(view.frame)] for view in views]
                maps = [
                    (light, probes.directions, probes.solid_angles) if self.stage == 2 else None for light in lights
                ]
                images = [Compared(view, light) for view, light in zip(views, maps)]
                pose = next(pose for view, pose in zip(self.views, self.poses) if view.frame.frame == frame)
                fit_pose(self.model, self.config, self.refinement, pose, images, SEARCH, generator)

    @cached_property
    def _small_views(self) -> dict[int, list[TrainingView]]:
        """The training images by frame, at the scale of render-and-compare."""
        views: dict[int, list[TrainingView]] = {}
        for view in load_views(self.capture, "train", SCALE * self.config.image_scale)[0]:
            views.setdefault(view.frame.frame, []).append(view)
        return views

    # -- the second stage ----------------------------------------------------------------------------------

    def _start_second_stage(self) -> None:
        """Initialise albedo and light at the first step of the second stage."""
        if self.stage != 2 or self.lit:
            return
        self._copy_colour_to_albedo()
        if self._searches_light:
            self._find_lights()
        self.lit = True

    def _find_lights(self) -> None:
        motion = self.motion()
        poses = [self.pose(view, motion) for view in self.views]
        images = self.model, self.views, poses
        hints = self._skin, None if self.config.skin is None else TONES[self.config.skin - 1]
        place, card, probes = self.known.place, self.known.card, self.lights.probes
        on_step = partial(self.on_search, LIGHT_SEARCH)
        if place is not None:
            radiance = placed_light(*images, place, on_step, *hints)
            self.light_found = radiance is not None
            probes.raw.requires_grad_(radiance is None)  # where it was not found, it is learned from white
            if radiance is not None:
                probes.start_from(torch.from_numpy(radiance)[None], probes.exposure)
        else:
            lights = [self.lights.index(view.frame) for view in self.views]
            found = light_search.initial_light(*images, lights, on_step, *hints)
            self.light_found = found is not None
            if found is not None:
                probes.start_from(torch.from_numpy(found.radiance), torch.from_numpy(found.exposure))
        if card is not None:
            view = card.view(self.views)
            radiance_there = self.lights.radiance()[self.lights.index(view.frame)]
            pose = self.pose(view, motion)
            self.lights.scale(card_gain(self.model, view, pose, self._card_pixel, radiance_there))

    def _copy_colour_to_albedo(self) -> None:
        """Start the albedo, network and residual, from the first stage's colour."""
        columns = list(APPEARANCE_COLUMNS)
        sizes = list(APPEARANCE_COLUMNS.values())
        start = [sum(sizes[:k]) for k in range(len(sizes))]
        colour, albedo = (slice(start[k], start[k] + 3) for k in map(columns.index, ("colour", "albedo")))
        last = self.model.appearance.out
        with torch.no_grad():
            last.weight[albedo] = last.weight[colour]
            last.bias[albedo] = last.bias[colour] + 1.0  # cancels the −1 in the albedo's activation
            self.model.appearance_residual[:, albedo] = self.model.appearance_residual[:, colour]

    @property
    def _searches_light(self) -> bool:
        return self.config.light == "learn" and self.config.light_search

    # -- current values ------------------------------------------------------------------------------------

    @property
    def stage(self) -> int:
        """Stage of the next step; see ``Schedule``."""
        return self.schedule.stage(self.step_index)

    def motion(self) -> Motion:
        """The capture's motion; with ``refine_poses`` without jitter, and its training frames are corrected."""
        return self.capture.motion if self.refinement is None else self.refinement.apply_to(self.capture.motion)

    def pose(self, view: TrainingView, motion: Motion | None = None) -> PoseInput:
        """Network input for ``view``, in ``motion`` or by default the capture's."""
        motion = self.capture.motion if motion is None else motion
        time_s = view.frame.frame / motion.fps
        return pose_input(motion, self.capture.body.skeleton, time_s, self.config.model).to(self.device)

    @cached_property
    def learned_from_sha256(self) -> str:
        """Digest of the training data, of which a training can only be resumed with the same."""
        digest = learned_sha256(self.views, self.capture, self.config.image_scale, self.given_lights)
        return digest if self.known.card is None else f"{digest} {self.known.card}"


def _with_rates(rates: Sequence[tuple[Sequence[Tensor], float]]) -> list[dict[str, Any]]:
    return [{"params": params, "lr": rate, "start_rate": rate} for params, rate in rates]
