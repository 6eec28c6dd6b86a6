"""Row T: time and accuracy in the worst cases."""

from __future__ import annotations

from time import perf_counter

import numpy as np

from rnd_bench.scenes.lights import sun_and_sky
from rnd_bench.scenes.poses import EXTREMES
from rnd_bench.scenes.psnr import decibels, srgb
from rnd_bench.scenes.subject import Subject
from rnd_bench.speed.reference import posed_reference
from rnd_bench.stability.figures import Result, reported, result
from rnd_runtime.core.camera import Camera
from rnd_runtime.raster import oracle as raster_oracle
from rnd_runtime.raster.cpu import rasterize
from rnd_runtime.shading.reference import shade_reference
from rnd_runtime.shading.shader import Shader


def worst_cases(subject: Subject) -> Result:
    """T: an ordinary frame, a camera inside the body, a squat, a light of 1e6.

    Frame times exclude the tone map. The reference has everything after the networks in float64, the sum over all
    2 048 texels and the oracle rasteriser.
    """
    heights = subject.rest.means[:, 1]
    low, high = float(heights.min()), float(heights.max())
    neck, feet = [0.0, low + 0.85 * (high - low), 0.0], [0.0, low + 0.15 * (high - low), 0.1]
    inside = Camera.look_at(neck, feet, width=subject.size, height=subject.size, fov_y=0.6)
    fierce = Shader(sun_and_sky(128, radiance=1e6), "table+sun")
    still = subject.motion({})
    cases = {
        "an ordinary frame": (still, subject.camera(), subject.shader),
        "camera inside the body": (still, inside, subject.shader),
        "squat": (subject.motion(EXTREMES["squat"]), subject.camera(), subject.shader),
        "light of 1e6": (still, subject.camera(), fierce),
    }
    figures = []
    for name, (motion, camera, shader) in cases.items():
        times = []
        for _ in range(subject.few(3, 60)):
            started = perf_counter()
            posed = subject.avatar.pose(motion, 0.0)
            radiance = shader.shade(posed, camera.position)
            ours = rasterize(posed.means, posed.covariances, posed.opacities, radiance, camera, depth=False)
            times.append(1e3 * (perf_counter() - started))
        exact = posed_reference(subject.avatar, motion, 0.0)
        lit = shade_reference(exact, shader.light, camera.position).astype(np.float32)
        truth = raster_oracle.rasterize(exact.means, exact.covariances, exact.opacities, lit, camera).image
        figures += [
            reported(f"{name}: frame time, median", float(np.median(times)), "ms"),
            reported(f"{name}: frame time, p95", float(np.percentile(times, 95)), "ms"),
            reported(f"{name}: PSNR to the full reference", decibels(srgb(ours.image), srgb(truth)), "dB"),
        ]
    return result(*figures)
