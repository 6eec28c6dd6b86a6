"""Overlay image of masks and template."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.camera import Camera
from rnd_runtime.core.images import write_image

from .check import CheckReport
from .silhouette import render_mesh
from .views import MaskView

TILE, COLUMNS, MAX_TILES = 256, 4, 12
MARGIN = 0.05
"""margin around mask and template, relative to their extent"""
MASK_ONLY, TEMPLATE_ONLY = (255, 80, 60), (60, 140, 255)
CAPTION = 18


def save_overlay(path: str | Path, report: CheckReport) -> None:
    """Write a sheet of up to 12 crops: the four worst frames, then evenly spaced ones.

    Red: mask only. Blue: template only. White line: the template's outline.
    """
    worst = np.argsort([entry.iou for entry in report.ious])[:COLUMNS].tolist()
    evenly = np.linspace(0, len(report.ious) - 1, MAX_TILES - COLUMNS).round().astype(int).tolist()
    chosen = list(dict.fromkeys(worst + evenly)) if report.ious else []
    tiles = [_tile(report, k) for k in chosen]
    columns = min(COLUMNS, max(len(tiles), 1))
    tiles += [np.zeros((TILE + CAPTION, TILE, 3), np.uint8)] * (-len(tiles) % columns)
    rows = [np.concatenate(tiles[k : k + columns], axis=1) for k in range(0, len(tiles), columns)]
    write_image(path, np.concatenate(rows) if rows else np.zeros((TILE, TILE, 3), np.uint8))


def _tile(report: CheckReport, index: int) -> NDArray[np.uint8]:
    entry, view = report.ious[index], report.views[index]
    loaded = report.capture.load_frame(view.frame)
    camera, rows, columns = _close_up(view, report.capture.cameras[view.frame.camera])
    template = render_mesh(view.vertices, view.faces, camera).mask
    height, width = template.shape
    mask = cv2.resize(loaded.mask[rows, columns], (width, height), interpolation=cv2.INTER_AREA) > 0.5
    image = cv2.resize(loaded.image_srgb[rows, columns], (width, height), interpolation=cv2.INTER_AREA) * 255
    for where, colour in ((mask & ~template, MASK_ONLY), (template & ~mask, TEMPLATE_ONLY)):
        image[where] = 0.35 * image[where] + 0.65 * np.array(colour, np.float32)
    outline = template & ~cv2.erode(template.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    image[outline] = 255
    tile = np.zeros((TILE + CAPTION, TILE, 3), np.uint8)
    tile[CAPTION : CAPTION + height, :width] = np.clip(image, 0, 255).astype(np.uint8)
    text = f"{entry.camera} {entry.frame}  IoU {entry.iou:.2f}"
    cv2.putText(tile, text, (4, 13), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (255, 255, 255), 1, cv2.LINE_AA)
    return tile


def _close_up(view: MaskView, camera: Camera) -> tuple[Camera, slice, slice]:
    """``camera`` cropped to mask and template and scaled to a tile, and the rows and columns of the crop."""
    either = view.mask | view.template().mask
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
