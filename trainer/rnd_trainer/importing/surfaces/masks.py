"""Rough masks for images without masks, best with a static camera.

The posed template or a segmentation network seeds GrabCut; a guided filter refines the outline. The background of a
static camera is the median over the frames in which the template does not cover it.

Source: Rother et al. 2004, GrabCut; He et al. 2013, Guided image filtering.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.errors import InputError

from .networks import ImageNetwork

Image = NDArray[np.uint8]
Mask = NDArray[np.bool_]
Floats32 = NDArray[np.float32]

# Shares of the silhouette's height; centimetres for a person of 1.7 m
_SURE_INSIDE = 0.015  # 2.5 cm: farther inside the template is person
_CLEARANCE = 0.04  # 7 cm: farther outside is background, when that is learned
_REACH = 0.08  # 14 cm: extent of clothes, hair and pose errors, with a known background
_BLIND_REACH = 0.05  # 8.5 cm: the same with an unknown one
_WORK_SIDE = 320  # pixels: GrabCut's time grows with the area; the guided filter restores the edge
_GRABCUT_ROUNDS = 2  # more rounds lose the template
_BACKGROUND_FRAMES = 40
_STRIP = 64  # rows at a time: forty frames of a large video are gigabytes as floats
_BINS = 4  # of a histogram, for each 8-bit step
_MIN_NOISE = 5.0  # 8-bit steps: a lossy codec's noise on a still wall
_STATIC_NOISE = 12.0  # median difference above which the camera moved


def make_masks(
    images: Sequence[Image], silhouettes: Sequence[Mask] | None = None, *, net: Path | None = None
) -> Iterator[Image]:
    """Yield rough masks [H, W] uint8 (coverage, 255 is the person).

    Both sequences are read by index, one image at a time, some twice.

    Args:
        images: [H, W, 3] uint8 sRGB, of one size; more than one without silhouettes and network.
        silhouettes: [H, W] masks of the posed template.
        net: segmentation network in ONNX (``networks.ImageNetwork``), used instead.

    Raises:
        InputError: neither silhouettes nor network, and no motion.
    """
    if len(images) == 0:
        return
    network = None if net is None else ImageNetwork(net, outputs=(1, 2))
    background = _learn_background(images, silhouettes)
    if network is None and silhouettes is None and background is None:
        raise InputError(
            "masks", expected="body poses, a static camera with somebody moving, or --mask-net", got="none of them"
        )
    for frame in range(len(images)):
        image = images[frame]
        silhouette = None if silhouettes is None else silhouettes[frame]
        if network is not None:
            person = _network_mask(network, image, silhouette)
        elif silhouette is not None:
            person = silhouette
        else:
            assert background is not None
            person = _moving_mask(image, background)
        blind = network is None and background is None
        yield _refine(image, _seeds(person, silhouette, image, background, _BLIND_REACH if blind else _REACH))


class _Background:
    """Background of a static camera.

    Attributes:
        colour: [H, W, 3] median over the frames that show it.
        seen: [H, W] whether enough frames show it.
        noise: 8-bit steps within which a pixel counts as background.
    """

    def __init__(self, colour: NDArray[np.float32], seen: Mask, noise: float) -> None:
        self.colour, self.seen, self.noise = colour, seen, noise

    def differs(self, image: Image) -> Mask:
        """[H, W] where ``image`` differs from the background by more than a shadow."""
        difference = np.abs(image - self.colour).max(-1)
        ratio = (image + 1.0) / (self.colour + 1.0)
        shadow = (ratio.max(-1) < 1.05) & (ratio.min(-1) > 0.45) & (np.ptp(ratio, axis=-1) < 0.12)
        differs: Mask = (difference > self.noise) & ~shadow
        return differs


def _learn_background(images: Sequence[Image], silhouettes: Sequence[Mask] | None) -> _Background | None:
    """The background, or None for a moving camera or a hidden background."""
    count = len(images)
    chosen = np.unique(np.linspace(0, count - 1, min(count, _BACKGROUND_FRAMES)).astype(int))
    if len(chosen) < 3:
        return None
    stack = np.stack([images[frame] for frame in chosen])
    hidden = np.zeros(stack.shape[:3], bool)
    if silhouettes is not None:
        hidden = np.stack([dilated(silhouettes[frame], _CLEARANCE) for frame in chosen])
    seen = (~hidden).sum(0) >= min(3, len(chosen))
    colour = np.zeros(stack.shape[1:], np.float32)
    differences = np.zeros(255 * _BINS + 1, np.int64)  # how often each difference occurs
    for top in range(0, len(seen), _STRIP):
        rows = slice(top, top + _STRIP)
        shown = np.where(hidden[:, rows, :, None], np.float32(np.nan), stack[:, rows])[:, seen[rows]]
        if shown.size:
            colour[rows][seen[rows]] = np.nanmedian(shown, axis=0)
            apart = np.abs(shown - colour[rows][seen[rows]]).max(-1)
            steps = (apart[np.isfinite(apart)] * _BINS).astype(np.int64)
            differences += np.bincount(steps, minlength=len(differences))
    if not differences.any():
        return None
    below = np.cumsum(differences) / differences.sum()
    median = float(np.searchsorted(below, 0.5)) / _BINS
    noise = max(_MIN_NOISE, 4 * median)
    moves = 1 - below[min(int(noise * _BINS), 255 * _BINS)]
    if median > _STATIC_NOISE or (silhouettes is None and moves < 1e-3):
        return None
    return _Background(colour, seen, noise)


def _seeds(person: Mask, silhouette: Mask | None, image: Image, background: _Background | None, reach: float) -> Image:
    """GrabCut's labels [H, W]: definite well inside person and template and by the background, else probable."""
    seeds = np.full(person.shape, cv2.GC_BGD, np.uint8)
    template = person if silhouette is None else silhouette
    if not template.any():
        return seeds
    near = dilated(template, reach)
    seeds[near] = cv2.GC_PR_BGD
    seeds[near & person] = cv2.GC_PR_FGD
    if background is not None:
        differs = background.differs(image)
        seeds[near & background.seen & differs] = cv2.GC_FGD
        seeds[near & background.seen & ~differs] = cv2.GC_PR_BGD
        seeds[near & ~template & background.seen & ~differs] = cv2.GC_BGD
    inside = cv2.distanceTransform((template & person).astype(np.uint8), cv2.DIST_L2, 3)
    seeds[inside > _SURE_INSIDE * mask_height(template)] = cv2.GC_FGD
    return seeds


def _moving_mask(image: Image, background: _Background) -> Mask:
    """Where ``image`` differs from the background, without specks and with small gaps closed."""
    differs = (background.differs(image) & background.seen).astype(np.uint8)
    side = max(3, 2 * (min(differs.shape) // 120) + 1)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    opened = cv2.morphologyEx(differs, cv2.MORPH_OPEN, kernel)
    return large_parts(cv2.morphologyEx(opened, cv2.MORPH_CLOSE, kernel, iterations=2))


def _network_mask(network: ImageNetwork, image: Image, silhouette: Mask | None) -> Mask:
    """The person by a network, in a crop around the template if given."""
    height, width = image.shape[:2]
    rows, columns = slice(0, height), slice(0, width)
    if silhouette is not None and silhouette.any():
        rows, columns = bounding_box(silhouette, 1.5 * _REACH)
    output = network(image[rows, columns])
    if output.shape[2] == 2:  # scores of background and person
        likely = output[..., 1] > output[..., 0]
    else:
        logits = output.min() < -1e-3 or output.max() > 1 + 1e-3
        likely = output[..., 0] > (0 if logits else 0.5)
    person = np.zeros((height, width), bool)
    person[rows, columns] = likely
    return large_parts(person)


def _refine(image: Image, seeds: Image) -> Image:
    """Coverage [H, W]: GrabCut from ``seeds`` at working size, refined at full size."""
    coverage = np.zeros(seeds.shape, np.uint8)
    possible = seeds != cv2.GC_BGD
    if not possible.any():
        return coverage
    rows, columns = bounding_box(possible, 0.05)
    crop, labels = np.ascontiguousarray(image[rows, columns]), seeds[rows, columns]
    scale = min(1.0, _WORK_SIDE / max(labels.shape))
    small = cv2.resize(crop, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    small_labels = cv2.resize(labels, small.shape[1::-1], interpolation=cv2.INTER_NEAREST)
    rough = cv2.resize(
        _grabcut(small, small_labels).astype(np.float32), crop.shape[1::-1], interpolation=cv2.INTER_LINEAR
    )
    radius = max(2, round(1.5 / scale))
    soft = cv2.ximgproc.guidedFilter(crop.astype(np.float32) / 255, rough, radius, 1e-4)
    soft = np.clip((soft - 0.15) / 0.7, 0, 1)  # the filter blurs both sides of the edge
    coverage[rows, columns] = np.round(255 * soft)
    return coverage


def _grabcut(image: Image, labels: Image) -> Mask:
    """Foreground after GrabCut, or of ``labels`` if they have one class only."""
    person = np.isin(labels, (cv2.GC_FGD, cv2.GC_PR_FGD))
    if not person.any() or person.all():
        return large_parts(person)
    cv2.setRNGSeed(0)  # random initial clusters: equal images give equal masks
    models = np.zeros((1, 65)), np.zeros((1, 65))
    refined, *_ = cv2.grabCut(image, labels.copy(), None, *models, _GRABCUT_ROUNDS, cv2.GC_INIT_WITH_MASK)
    return large_parts(np.isin(refined, (cv2.GC_FGD, cv2.GC_PR_FGD)))


def colour_around(pixels: Floats32, where: Mask, reach: float) -> tuple[Floats32, Floats32]:
    """Mean colour [H, W, 3] of the pixels ``where`` within about four times ``reach``, and its weight [H, W]."""
    counted = where.astype(np.float32)
    weight = cv2.GaussianBlur(counted, (0, 0), reach)
    total = cv2.GaussianBlur(pixels * counted[..., None], (0, 0), reach)
    return np.asarray(total / np.maximum(weight, 1e-12)[..., None], np.float32), np.asarray(weight, np.float32)


def share_of_person(pixels: Floats32, person: Floats32, behind: Floats32) -> Floats32:
    """Share [...] of the colour ``person`` in mixtures with ``behind`` [..., 3], unbounded; 1 where both are one."""
    across = person - behind
    share = (np.vecdot(pixels - behind, across) + 1e-6) / (np.vecdot(across, across) + 1e-6)
    return np.asarray(share, np.float32)


def large_parts(mask: NDArray[np.generic]) -> Mask:
    """``mask`` without components below a twentieth of the largest one."""
    count, labels, statistics, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    areas = statistics[1:, cv2.CC_STAT_AREA]
    large: Mask = np.isin(labels, 1 + np.flatnonzero(areas > 0.05 * areas.max())) if count > 1 else labels > 0
    return large


def mask_height(mask: Mask) -> int:
    rows = np.flatnonzero(mask.any(1))
    return int(rows[-1] - rows[0] + 1)


def dilated(mask: Mask, share: float) -> Mask:
    """``mask`` dilated by ``share`` of its height."""
    if not mask.any():
        return mask
    grown, window = np.zeros_like(mask), bounding_box(mask, 1.05 * share)  # a step along an axis counts as 0.955
    outside = cv2.distanceTransform((~mask[window]).astype(np.uint8), cv2.DIST_L2, 3)
    grown[window] = outside <= share * mask_height(mask)
    return grown


def bounding_box(mask: Mask, share: float) -> tuple[slice, slice]:
    """Bounding box of ``mask``, grown by ``share`` of its height."""
    margin = int(np.ceil(share * mask_height(mask))) + 2
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    return (
        slice(max(int(rows[0]) - margin, 0), int(rows[-1]) + 1 + margin),
        slice(max(int(columns[0]) - margin, 0), int(columns[-1]) + 1 + margin),
    )
