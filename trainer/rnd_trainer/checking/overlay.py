"""The overlay picture: what is the person's only, what is the template's only, frame by frame."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.camera import Camera
from rnd_runtime.core.images import write_image

from .check import Report
from .silhouette import draw
from .views import Sight

TILE, COLUMNS, MOST = 256, 4, 12
MARGIN = 0.05
"""of what is seen of mask and template, left around them"""
MASK_ONLY, TEMPLATE_ONLY = (255, 80, 60), (60, 140, 255)
CAPTION = 18


def save_overlay(path: str | Path, report: Report) -> None:
    """Write a sheet of up to 12 pictures: the four that fit worst, then evenly spaced ones.

    Each shows the surroundings of mask and template. Red: the mask's only. Blue: the template's only. White line: the
    template's outline.
    """
    worst = np.argsort([entry.iou for entry in report.overlaps])[:COLUMNS].tolist()
    evenly = np.linspace(0, len(report.overlaps) - 1, MOST - COLUMNS).round().astype(int).tolist()
    chosen = list(dict.fromkeys(worst + evenly)) if report.overlaps else []
    tiles = [_tile(report, k) for k in chosen]
    columns = min(COLUMNS, max(len(tiles), 1))
    tiles += [np.zeros((TILE + CAPTION, TILE, 3), np.uint8)] * (-len(tiles) % columns)
    rows = [np.concatenate(tiles[k : k + columns], axis=1) for k in range(0, len(tiles), columns)]
    write_image(path, np.concatenate(rows) if rows else np.zeros((TILE, TILE, 3), np.uint8))


def _tile(report: Report, index: int) -> NDArray[np.uint8]:
    entry, small = report.overlaps[index], report.sights[index]
    images = report.capture.load_frame(small.frame)
    camera, rows, columns = _close_up(small, report.capture.cameras[small.frame.camera])
    template = draw(small.vertices, small.faces, camera).mask
    height, width = template.shape
    mask = cv2.resize(images.mask[rows, columns], (width, height), interpolation=cv2.INTER_AREA) > 0.5
    picture = cv2.resize(images.image_srgb[rows, columns], (width, height), interpolation=cv2.INTER_AREA) * 255
    for where, colour in ((mask & ~template, MASK_ONLY), (template & ~mask, TEMPLATE_ONLY)):
        picture[where] = 0.35 * picture[where] + 0.65 * np.array(colour, np.float32)
    outline = template & ~cv2.erode(template.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    picture[outline] = 255
    tile = np.zeros((TILE + CAPTION, TILE, 3), np.uint8)
    tile[CAPTION : CAPTION + height, :width] = np.clip(picture, 0, 255).astype(np.uint8)
    text = f"{entry.camera} {entry.frame}  IoU {entry.iou:.2f}"
    cv2.putText(tile, text, (4, 13), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (255, 255, 255), 1, cv2.LINE_AA)
    return tile


def _close_up(small: Sight, camera: Camera) -> tuple[Camera, slice, slice]:
    """The part of ``camera``'s picture around mask and template that fills a tile, and its rows and columns."""
    either = small.mask | small.view().mask
    if not either.any():
        either[:] = True
    spans = []
    for axis, length in ((1, camera.height), (0, camera.width)):
        used = np.flatnonzero(either.any(axis)) * length / either.shape[1 - axis]
        margin = MARGIN * max(np.ptp(used), 1) + length / either.shape[1 - axis]
        spans.append(slice(max(int(used[0] - margin), 0), min(int(used[-1] + margin) + 1, length)))
    rows, columns = spans
    K = camera.K.copy()
    K[:2, 2] -= columns.start, rows.start
    width, height = columns.stop - columns.start, rows.stop - rows.start
    part = Camera(width, height, K, camera.world_to_camera)
    scale = TILE / max(width, height)
    return part.resized(max(1, round(width * scale)), max(1, round(height * scale))), rows, columns
