"""What a camera sees of Gaussians: those in front, and the normals of the surface at their pixels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from rnd_trainer.render.in_sight import in_sight
from support.ball import RADIUS, front_camera, splat_ball

DEPTH = 0.02  # m below the surface
WITHIN = 5.0  # degrees, in the mean: splats are 3° apart and blended


def test_a_gaussian_below_the_surface_is_seen_with_the_normal_of_what_covers_it() -> None:
    outer, inner = splat_ball(), splat_ball(1000, RADIUS - DEPTH)
    clear = replace(inner.attributes, opacity=torch.zeros(1000))
    both = replace(
        outer,
        means=torch.cat([inner.means, outer.means]),
        covariances=torch.cat([inner.covariances, outer.covariances]),
        normals=torch.cat([inner.normals, outer.normals]),
        attributes=replace(outer.attributes, opacity=torch.cat([clear.opacity, outer.attributes.opacity])),
    )
    view = front_camera()
    sight = in_sight(both, view, 1000, facing=0.3, occlusion=0.1)
    eye, means, normals = view.position, inner.means.numpy(), inner.normals.numpy()
    ray = means - eye
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    along = ray @ eye
    hit = eye - ray * (along + np.sqrt(np.maximum(along**2 - eye @ eye + RADIUS**2, 0)))[:, None]
    seen = sight.visible
    assert seen.sum() > 250

    def degrees(guess: np.ndarray) -> np.ndarray:
        return np.degrees(np.arccos(np.clip((guess * hit / RADIUS).sum(1)[seen], -1, 1)))

    oblique = (-(normals * ray).sum(1))[seen] < 0.5
    assert degrees(normals)[oblique].mean() > 2 * WITHIN  # their own face away from the camera
    assert degrees(sight.normals)[oblique].mean() < WITHIN


def test_what_is_behind_is_not_in_sight() -> None:
    sight = in_sight(splat_ball(), front_camera(), 4000, facing=0.3, occlusion=0.02)
    assert (splat_ball().means[sight.visible, 2] > 0).all()
    assert sight.visible.any()
