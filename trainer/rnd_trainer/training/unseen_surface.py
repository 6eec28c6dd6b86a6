"""Albedo and roughness of surface that the images hardly show, filled in from what resembles it.

The evidence e of a Gaussian is its weight in the pixels of all images, in pixels that its share of the surface covers
when seen from the front. Raw attributes a of those below ``SEEN`` minimise Σ_i e_i (a_i − ã_i)² + λ Σ_ij (a_i − a_j)²,
ã as learned, over pairs of neighbours on the surface and of Gaussians that mirror each other; all others stay (screened
Poisson equation).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import coo_array, diags_array
from scipy.sparse.linalg import spsolve
from scipy.spatial import cKDTree

from rnd_runtime.core.arrays import spaced_indices
from rnd_trainer.model.model import APPEARANCE_COLUMNS, AvatarModel, PoseInput
from rnd_trainer.render.raster import rasterize
from rnd_trainer.render.shading import visible_towards

from .data import TrainingView

Floats = NDArray[np.float64]

SEEN = 8.0
"""images, seen from the front, that determine a Gaussian's albedo"""
SMOOTHNESS = 0.2
"""λ, in images a neighbour"""
NEIGHBOURS = 6
"""on the surface"""
IMAGES = 40
"""evenly spaced, among which Gaussians are looked for"""


def evidence(model: AvatarModel, views: Sequence[TrainingView], poses: Sequence[PoseInput]) -> Floats:
    """Evidence [N] of every Gaussian, scaled to all of ``views``."""
    total = np.zeros(len(model.points))
    chosen = spaced_indices(len(views), IMAGES)
    for index in chosen:
        camera = views[index].camera
        with torch.no_grad():
            posed = model(poses[index])
        lit = visible_towards(posed.normals, posed.means, camera)[0].cpu().numpy()
        shown = torch.zeros_like(posed.means[:, :1]).requires_grad_()
        image, _, _ = rasterize(posed.means, posed.covariances, posed.attributes.opacity, shown, camera)
        (weight,) = torch.autograd.grad(image.sum(), shown)
        _, depth = camera.project(posed.means.cpu().numpy())
        patch = (camera.K[0, 0] * float(model.spacing) / depth) ** 2
        total[lit] += (weight[:, 0].cpu().numpy() / patch)[lit]
    return total * len(views) / len(chosen)


@torch.no_grad()
def fill_in(model: AvatarModel, seen: Floats) -> int:
    """Fill in albedo and roughness of the Gaussians whose evidence ``seen`` [N] is below ``SEEN``; their number."""
    unknown = np.nonzero(seen < SEEN)[0]
    if len(unknown) == 0 or len(unknown) == len(seen):
        return 0
    first = APPEARANCE_COLUMNS["colour"]
    network = model.interpolate(model.appearance(model.encoded_nodes()))[:, first:].cpu().numpy().astype(np.float64)
    residual = model.appearance_residual[:, first:].cpu().numpy()
    raw = network + residual
    pairs = _pairs(model.points.cpu().numpy(), model.rest_normals.cpu().numpy())
    weights = coo_array((np.full(len(pairs), SMOOTHNESS), pairs.T), shape=(len(seen),) * 2).tocsr()
    weights = weights + weights.T
    laplacian = diags_array(weights.sum(1)) - weights
    of_unknown = laplacian[unknown]
    known = np.setdiff1d(np.arange(len(seen)), unknown)
    system = of_unknown[:, unknown] + diags_array(seen[unknown] + 1e-6)
    target = seen[unknown, None] * raw[unknown] - of_unknown[:, known] @ raw[known]
    filled = spsolve(system.tocsc(), target)
    changed = torch.as_tensor(filled - network[unknown]).to(model.appearance_residual)
    model.appearance_residual[torch.as_tensor(unknown), first:] = changed
    return len(unknown)


def _pairs(points: Floats, normals: Floats) -> NDArray[np.int64]:
    """Pairs [E, 2] of neighbours on the surface, and of mirrored points: x → −x in the rest pose."""
    tree = cKDTree(points)
    _, near = tree.query(points, NEIGHBOURS + 1)
    neighbours = np.stack([near[:, :1].repeat(NEIGHBOURS, 1), near[:, 1:]], axis=-1).reshape(-1, 2)
    facing = (normals[neighbours[:, 0]] * normals[neighbours[:, 1]]).sum(1) > 0
    mirror = np.array([-1, 1, 1])
    distance, twin = tree.query(points * mirror)
    alike = ((normals * mirror) * normals[twin]).sum(1) > 0.5
    spacing = np.median(np.linalg.norm(points[near[:, 1]] - points, axis=1))
    mirrored = np.stack([np.arange(len(points)), twin], axis=1)[alike & (distance < 2 * spacing)]
    return np.concatenate([neighbours[facing], mirrored])
