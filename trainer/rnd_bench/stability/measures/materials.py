"""Rows L11–L13: albedo–light scale, light baked into albedo, visibility with crossed arms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from rnd_bench.scenes.poses import CROSSED
from rnd_bench.scenes.psnr import Floats, decibels, srgb
from rnd_bench.scenes.subject import Subject
from rnd_bench.stability.figures import Figure, Result, at_most, below, not_measured, reported, result
from rnd_runtime.core.camera import Camera
from rnd_runtime.core.gaussians import Gaussians
from rnd_runtime.core.images import srgb_to_linear, to_bytes
from rnd_runtime.raster.cpu import rasterize
from rnd_runtime.shading.directional import DirectionalLight, extract_directional
from rnd_runtime.shading.light import Light, texel_directions, texel_solid_angles
from rnd_runtime.shading.sh import sh_basis
from rnd_runtime.shading.shader import Shader
from rnd_runtime.shading.shadow import directional_visibility
from rnd_trainer.evaluation.evaluate import Evaluator, albedo_scale, evaluate
from rnd_trainer.losses.metrics import mask_box
from rnd_trainer.model.checkpoint import load_checkpoint

TEXELS = (16, 32)  # of the sky under which visibility is compared: every texel's shadow is traced


def relit_scale(subject: Subject) -> Result:
    """L11: relit images, raw and with the albedo scaled per channel."""
    evaluator = Evaluator(load_checkpoint(subject.checkpoint), subject.capture)
    relit = bool(subject.capture.split("relight"))
    scale = albedo_scale(evaluator) if relit else None
    raw = evaluate(evaluator, "relight").scores if relit else None
    scaled = evaluate(evaluator, "relight", albedo_scale=scale).scores if scale is not None else None
    figures = (
        ("PSNR under other lights, raw", raw, "psnr"),
        ("PSNR under other lights, one albedo scale per channel", scaled, "psnr"),
        ("the same inside the mask's box, raw", raw, "psnr_box"),
        ("the same inside the mask's box, scaled", scaled, "psnr_box"),
    )
    return result(*(not_measured(what) if s is None else reported(what, s[name], "dB") for what, s, name in figures))


def baked_light(subject: Subject) -> Result:
    """L12: correlation of the albedo's error with irradiance, over training images."""
    what = "|correlation| of albedo error and irradiance"
    capture, errors, lights, colours = subject.capture, [], [], []
    frames = [frame for frame in capture.split("train") if frame.albedo and frame.light]
    if not frames:
        return result(not_measured(what))
    shader = Shader(capture.load_light(frames[0].light or ""), "table+sun")
    for truth, camera, time in subject.observed(frames, subject.few(6, 25)):
        assert truth.albedo_srgb is not None
        posed = subject.avatar.pose(capture.motion, time)
        once, twice = (np.full_like(posed.albedo, level) for level in (1, 2))  # the specular part cancels
        irradiance = shader.shade(replace(posed, albedo=twice), camera.position)
        irradiance -= shader.shade(replace(posed, albedo=once), camera.position)
        features = np.concatenate([posed.albedo, irradiance], axis=1).astype(np.float32)
        raster = rasterize(posed.means, posed.covariances, posed.opacities, features, camera, depth=False)
        inside = (truth.mask > 0.99) & (raster.alpha > 0.99)
        errors.append(np.stack([raster.image[inside][:, :3], srgb_to_linear(truth.albedo_srgb)[inside]]))
        lights.append(raster.image[inside][:, 3:].mean(1))
        colours.append(srgb_to_linear(truth.image_srgb)[inside])
    ours, true = np.concatenate(errors, axis=1).astype(np.float64)
    light, colour = np.concatenate(lights).astype(np.float64), np.concatenate(colours).astype(np.float64)

    def correlation(estimate: Floats) -> float:
        scale = (estimate * true).sum(0) / np.maximum((estimate**2).sum(0), 1e-12)
        return abs(float(np.corrcoef((scale * estimate - true).mean(1), light)[0, 1]))

    return result(below(what, correlation(ours), 0.2, baseline=("the image's colour as albedo", correlation(colour))))


def crossed_arms(subject: Subject) -> Result:
    """L13: visibility by the network and visibility traced to every texel.

    On held-out poses under the capture's light both are compared with its images; with crossed arms under an overcast
    sky, with each other.
    """
    posed = subject.avatar.pose(subject.motion(CROSSED), 0.0)
    lit = _Overcast(subject, posed, Light(np.minimum(subject.light.radiance, 1.0)), ())
    camera = subject.camera(0.2)

    def image(visibility: Floats) -> Floats:
        return srgb(_splat(posed, lit.radiance(visibility), camera))

    truth, ours = image(lit.traced), image(lit.ours)
    psnr, blind, clamped = (
        decibels(x, truth) for x in (ours, image(subject.rest.visibility @ lit.basis.T), image(np.clip(lit.ours, 0, 1)))
    )
    what = "arms crossed, overcast: PSNR to exact visibility"
    return result(
        lost_to_exact(subject),
        reported(what, psnr, "dB", baseline=("visibility of the rest pose", blind)),
        reported("the same, and with v clamped to 0…1", psnr, "dB", baseline=("clamped", clamped)),
        images=(to_bytes(ours), to_bytes(truth)),
    )


def lost_to_exact(subject: Subject) -> Figure:
    what, capture = "PSNR lost to exact visibility on held-out poses", subject.capture
    ours: list[float] = []
    exact: list[float] = []
    frames = [frame for frame in capture.split("novel_pose") if frame.light is not None]
    if not frames:
        return not_measured(what)
    sky, suns = extract_directional(capture.load_light(frames[0].light or ""))
    for truth, camera, time in subject.observed(frames, subject.few(4, 8)):
        box = mask_box(torch.from_numpy(truth.mask))
        posed = subject.avatar.pose(capture.motion, time)
        lit = _Overcast(subject, posed, sky, suns)
        for found, visibility in ((ours, lit.ours), (exact, lit.traced)):
            found.append(decibels(srgb(_splat(posed, lit.radiance(visibility), camera))[box], truth.image_srgb[box]))
    return at_most(what, float(np.mean(exact) - np.mean(ours)), 3, "dB") if ours else not_measured(what)


class _Overcast:
    """Diffuse light on posed Gaussians: a sky, texel by texel, and directional lights with hard shadows."""

    def __init__(self, subject: Subject, posed: Gaussians, sky: Light, suns: tuple[DirectionalLight, ...]) -> None:
        self.albedo = posed.albedo
        small = sky.resized(*TEXELS)
        directions = texel_directions(*TEXELS).reshape(-1, 3) @ small.rotation.T
        flux = small.radiance.reshape(-1, 3) * texel_solid_angles(*TEXELS).reshape(-1, 1)
        self.basis = sh_basis(directions @ posed.root_rotation)
        self.ours = posed.visibility @ self.basis.T
        radii = 1.25 * subject.avatar.spacing
        self.traced = directional_visibility(posed.means, posed.normals, directions, radii=radii).astype(np.float64)
        cosine = np.maximum(posed.normals @ directions.T, 0)
        self._sum = cosine, flux
        self._suns = np.zeros_like(posed.albedo)
        for sun in suns:
            way = sky.rotation @ sun.direction
            reached = directional_visibility(posed.means, posed.normals, way[None], radii=radii)
            self._suns += reached * np.maximum(posed.normals @ way, 0)[:, None] * sun.irradiance

    def radiance(self, visibility: Floats) -> Floats:
        """Radiance [N, 3] for visibility [N, K] of the texels."""
        cosine, flux = self._sum
        return self.albedo / np.pi * (np.maximum((visibility * cosine) @ flux, 0) + self._suns)


def _splat(posed: Gaussians, radiance: Floats, camera: Camera) -> Floats:
    arrays = posed.means, posed.covariances, posed.opacities, np.asarray(radiance, np.float32)
    return rasterize(*arrays, camera, depth=False).image.astype(np.float64)
