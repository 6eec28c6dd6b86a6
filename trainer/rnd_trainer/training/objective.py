"""Objective of a training step: the weighted loss terms of one image."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from rnd_runtime.core.camera import Camera
from rnd_runtime.core.images import srgb_to_linear
from rnd_trainer.config import TrainConfig
from rnd_trainer.losses.consistency import POINTS, consistency_loss, covisible, project, virtual_camera
from rnd_trainer.losses.losses import (
    albedo_loss,
    chroma_prior,
    geometry_prior,
    image_loss,
    linear_to_srgb,
    skinning_divergence,
    sky_prior,
)
from rnd_trainer.losses.perceptual import Perceptual
from rnd_trainer.losses.repulsion import repulsion
from rnd_trainer.model.model import AvatarModel, PosedGaussians, PoseInput
from rnd_trainer.render.probe import Texels, all_texels, sample_texels
from rnd_trainer.render.render import Splat, shade_visible, splat
from rnd_trainer.render.shading import BACK_FACING, sh_basis, traced_visibility

from .data import TrainingView
from .lighting.lights import TrainingLights

MIN_MATCHES = 16
"""points that two views must share for the consistency term"""


class Objective:
    """The loss of one image in the first and second stage.

    Args:
        config: weights and schedule.
        lights: of the training images.
        perceptual: network of the LPIPS term; None: multi-scale DSSIM instead.
        consistency: network whose features L_gc compares; None leaves the term out.
        generator: of all random numbers.
    """

    def __init__(
        self,
        config: TrainConfig,
        lights: TrainingLights,
        perceptual: Perceptual | None,
        consistency: Perceptual | None,
        generator: torch.Generator,
    ) -> None:
        self.config, self.lights = config, lights
        self.perceptual, self.consistency, self.generator = perceptual, consistency, generator

    def __call__(
        self, model: AvatarModel, view: TrainingView, pose: PoseInput, step: int, stage: int
    ) -> dict[str, Tensor]:
        """Weighted loss terms of one image by name; their sum is minimised."""
        config = self.config
        posed = model(pose)
        weight_skinning = config.weight_skinning * 0.1 ** (step / config.steps)
        terms = {
            "skinning": weight_skinning * skinning_divergence(posed.weights, model.log_weights),
            "geometry": geometry_prior(posed, config.weight_offset, config.weight_residual),
        }
        if _due(step, config.weight_repulsion, config.repulsion_every):
            terms["repulsion"] = config.repulsion_every * config.weight_repulsion * self._repulsion(model, posed)
        if config.model.visibility == "pose" and config.light != "none":
            terms["visibility"] = config.weight_visibility * self._visibility_loss(model, posed, pose)
        texels = None
        if stage == 2:
            index, probes = self.lights.index(view.frame), self.lights.probes
            light = self.lights.radiance()[index]
            texels = self._texels(light, step)
            if self.lights.learned:
                chroma = chroma_prior(light, probes.start[index], probes.solid_angles)
                terms["chroma"] = config.weight_light_chroma * chroma
                terms["sky"] = config.weight_light_sky * sky_prior(light, probes.directions, probes.solid_angles)
        cull = self._cull(step)
        guess = view.estimated_albedo() if texels is not None and config.weight_albedo_estimate > 0 else None
        rendered = self._render(model, posed, pose, texels, view.camera, cull, albedo=guess is not None)
        device = posed.means.device
        background = self._background()
        target, mask = (x.to(device) for x in view.target(background))
        background = background.to(device)
        image_srgb, target_srgb = _over(rendered, background), linear_to_srgb(target)
        terms |= self._image_terms(image_srgb, target_srgb, step)
        terms["mask"] = config.weight_mask * (rendered.alpha - mask).abs().mean()
        estimate = view.normals()
        if estimate is not None:
            normals, known = (x.to(device) for x in estimate)
            terms["normal"] = config.weight_normal * ((rendered.normals - normals).abs() * known).mean()
        else:
            terms["tilt"] = config.weight_tilt * (posed.attributes.normals - model.rest_normals).square().mean()
        if guess is not None and rendered.albedo is not None:
            guessed, known = (x.to(device) for x in guess)
            albedo, inside = rendered.albedo / rendered.alpha.clamp(min=0.5)[..., None], rendered.alpha > 0.5
            terms["albedo"] = config.weight_albedo_estimate * albedo_loss(albedo, guessed, known & inside)
        due = _due(step, config.weight_consistency, config.consistency_every)
        network = _if_large(self.consistency, target)
        if due and texels is not None and network is not None:
            seen = (view.camera, cull, image_srgb, background)
            agreement = self._agreement(network, model, posed, pose, texels, *seen)
            if agreement is not None:
                terms["consistency"] = config.consistency_every * config.weight_consistency * agreement
        return terms

    def _cull(self, step: int) -> float:
        """Cosine n·v below which Gaussians are left out: random in the first half of the steps, then −1.

        The near side must cover the far one: back faces are unlit, and black clothes would turn transparent to show
        them. To the end it costs 10 % of LPIPS.
        """
        sample = float(torch.rand((), generator=self.generator))
        return -1 + (1 + BACK_FACING) * sample if step < self.config.steps / 2 else -1.0

    def _background(self) -> Tensor:
        """Linear background [3]: black, as in evaluation, or uniform in sRGB."""
        sample = torch.rand(4, generator=self.generator)
        if sample[3] < self.config.black_backgrounds:
            return torch.zeros(3)
        return torch.from_numpy(srgb_to_linear(sample[:3].numpy()))

    def _render(
        self,
        model: AvatarModel,
        posed: PosedGaussians,
        pose: PoseInput,
        texels: Texels | None,
        camera: Camera,
        cull: float,
        *,
        albedo: bool = False,
    ) -> Splat:
        """Posed avatar seen by ``camera``, shaded under ``texels`` or in plain colours."""
        if texels is None:
            return splat(posed, posed.attributes.colour, camera, cull=cull)
        traced = self.config.traced_texels
        radiance = shade_visible(posed, pose, texels, camera, model, traced)
        return splat(posed, radiance, camera, albedo=albedo, cull=cull)

    def _image_terms(self, image_srgb: Tensor, target_srgb: Tensor, step: int) -> dict[str, Tensor]:
        """L1 and DSSIM; LPIPS if there is a network and the image is large enough for it."""
        config = self.config
        network = _if_large(self.perceptual, target_srgb)
        scales = 1 if network is not None else config.dssim_scales
        terms = {"image": image_loss(image_srgb, target_srgb, config.weight_dssim, scales)}
        if network is not None and _due(step, config.weight_lpips, config.lpips_every):
            distance = network(image_srgb.clamp(max=1), target_srgb)
            terms["lpips"] = config.lpips_every * config.weight_lpips * distance
        return terms

    def _texels(self, light: Tensor, step: int) -> Texels:
        config = self.config
        maps = (light, self.lights.probes.directions, self.lights.probes.solid_angles)
        if step >= config.steps * (1 - config.full_light_fraction):
            return all_texels(*maps)
        return sample_texels(*maps, config.light_texels, self.generator)

    def _agreement(
        self,
        network: Perceptual,
        model: AvatarModel,
        posed: PosedGaussians,
        pose: PoseInput,
        texels: Texels,
        camera: Camera,
        cull: float,
        image_srgb: Tensor,
        background: Tensor,
    ) -> Tensor | None:
        """L_gc between this image and one of a nearby virtual camera; None below ``MIN_MATCHES`` shared points."""
        nodes = self.config.model.nodes
        centre = posed.means[:nodes].detach().mean(dim=0)
        virtual = virtual_camera(camera, centre, self.generator)
        shared = covisible(posed, camera, virtual, nodes)
        if len(shared) < MIN_MATCHES:
            return None
        sampled = shared[torch.randperm(len(shared), generator=self.generator)[:POINTS].to(shared.device)]
        second = _over(self._render(model, posed, pose, texels, virtual, cull), background)
        points = posed.means[sampled].detach()
        pixels = project(points, camera), project(points, virtual)
        return consistency_loss(image_srgb.clamp(max=1), second.clamp(max=1), *pixels, network)

    def _repulsion(self, model: AvatarModel, posed: PosedGaussians) -> Tensor:
        """Repulsion with gradient by the residual offsets alone; through the network it costs 0.1 to 0.2 dB."""
        residual_offset = model.residual_offset()
        points = posed.attributes.points.detach() + residual_offset - residual_offset.detach()
        return repulsion(points, self.config.least_distance * float(model.spacing))

    def _visibility_loss(self, model: AvatarModel, posed: PosedGaussians, pose: PoseInput) -> Tensor:
        """Square error of the SH visibility at the nodes against shadow maps, in random directions."""
        nodes = self.config.model.nodes
        directions = torch.randn(self.config.visibility_directions, 3, generator=self.generator)
        directions = torch.nn.functional.normalize(directions, dim=-1).to(posed.means.device)
        spacing = float(model.spacing) * math.sqrt(self.config.model.gaussians / nodes)
        means, normals = posed.means[:nodes], posed.normals[:nodes]
        truth = traced_visibility(means, normals, directions, spacing)
        above = (normals.detach() @ directions.T).clamp(min=0)  # below the horizon visibility is unused
        predicted = posed.visibility[:nodes] @ sh_basis(directions @ pose.bones[0, :, :3].detach()).T
        return (above * (predicted - truth).square()).mean()


def _if_large(network: Perceptual | None, image: Tensor) -> Perceptual | None:
    """``network`` if ``image`` [h, w, 3] is large enough for it, else None."""
    large = network is not None and min(image.shape[:2]) >= network.smallest
    return network if large else None


def _due(step: int, weight: float, every: int) -> bool:
    """Whether a term with an interval of ``every`` steps is due; its weight is then multiplied by ``every``."""
    return weight > 0 and step % every == 0


def _over(splat: Splat, background: Tensor) -> Tensor:
    """sRGB image [H, W, 3] over a linear background [3]."""
    return linear_to_srgb(splat.image + (1 - splat.alpha[..., None]) * background)
