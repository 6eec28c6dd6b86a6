"""Consistency checks of a capture before training."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from rnd_runtime.capture.capture import Capture, Frame, FrameImages, load_capture
from rnd_runtime.capture.format import decode_normals, read_unit_range
from rnd_runtime.core.errors import InputError
from rnd_trainer.training.data import MAX_BAD_MASKS, usable
from rnd_trainer.training.lighting.lights import light_names

from .geometry import Finding, check_geometry, wrong
from .hypotheses import explain, explain_timing
from .normals import compare_axes, paired_normals
from .silhouette import mask_iou
from .views import MaskView, evenly_spaced, mask_view, mean_iou

Floats = NDArray[np.float64]

HYPOTHESIS_FRAMES = 8
MIN_IOU = 0.70
"""mean IoU below which something is wrong; a dressed person reaches 0.82 to 0.90"""
MAX_BACKGROUND = 0.02
"""mean sRGB value outside the mask above which an image is not on black"""
DISTORTIONS = tuple(np.linspace(-0.4, 0.4, 9).round(1).tolist())
DISTORTION_GAIN = 0.015
"""IoU that a radial distortion must gain over the best zoom"""
MIN_SHIFT = 0.5
"""displacement of the mask's edge below which a distortion is ignored, pixels"""
ZOOMS = (0.96, 1.0, 1.04, 1.08)


@dataclass(frozen=True)
class FrameIoU:
    """IoU of the template's silhouette with the mask of one image."""

    image: str
    camera: str
    frame: int
    split: str
    iou: float


@dataclass(frozen=True, eq=False)
class CheckReport:
    """Findings of ``check_capture``, and IoU and view of every usable frame."""

    capture: Capture
    findings: tuple[Finding, ...]
    ious: tuple[FrameIoU, ...]
    views: tuple[MaskView, ...]

    @property
    def wrong(self) -> bool:
        return any(finding.level == "wrong" for finding in self.findings)

    @property
    def mean_iou(self) -> float:
        return float(np.mean([entry.iou for entry in self.ious])) if self.ious else 0.0


def check_capture(path: str | Path, *, on_frame: Callable[[int, int], None] = lambda done, total: None) -> CheckReport:
    """Check files, splits, lights, units, cameras, frame rate, masks, silhouettes, timing, lens and normals.

    Args:
        on_frame: called with done and total.

    Raises:
        InputError: the capture cannot be read.
    """
    capture = load_capture(path)
    frames, cameras = len(capture.frames), len(capture.cameras)
    counts = f"{frames} image{'s' * (frames != 1)} of {cameras} camera{'s' * (cameras != 1)}"
    findings = [Finding("ok", "files", counts)]
    findings += [*_training(capture), *_lights(capture), *check_geometry(capture)]
    views, ious, normal_pairs, bad_masks, bright = [], [], [], [], []
    for done, frame in enumerate(capture.frames):
        bare = msgspec.structs.replace(frame, normal=None, normal_gt=None)  # load_frame refuses flipped normals
        images = capture.load_frame(bare)
        if usable(images.mask):
            view = mask_view(capture, bare, images.mask)
            template = view.template()
            views.append(view)
            iou = mask_iou(template.mask, view.mask)
            ious.append(FrameIoU(frame.image, frame.camera, frame.frame, frame.split, iou))
            if frame.normal is not None:
                normals = decode_normals(read_unit_range(capture.folder / frame.normal))
                normal_pairs.append(paired_normals(normals, template))
        else:
            bad_masks.append((frame, images))
        outside = images.image_srgb[images.mask == 0]
        bright.append(bool(len(outside)) and float(outside.mean()) > MAX_BACKGROUND)
        on_frame(done + 1, len(capture.frames))
    findings += [*_masks(bad_masks, capture), *_background(capture, bright), *_fit(capture, views, ious)]
    findings += _normals(capture, normal_pairs, sum(frame.normal is not None for frame in capture.frames))
    return CheckReport(capture, tuple(findings), tuple(ious), tuple(views))


def _training(capture: Capture) -> list[Finding]:
    frames = capture.split("train")
    if not frames:
        return wrong("training", f'none of {len(capture.frames)} images is of the split "train"')
    names = light_names(frames)
    if len(names) > 1:
        return [Finding("ok", "training", f"{len(names)} lights ({', '.join(names)}): a probe for each is learned")]
    return []


def _lights(capture: Capture) -> list[Finding]:
    findings = []
    for name in filter(capture.has_map, capture.lights):
        try:
            capture.load_light(name)
        except InputError as error:
            findings += wrong("lights", f"{name}: {error}")
    return findings


def _masks(bad: list[tuple[Frame, FrameImages]], capture: Capture) -> list[Finding]:
    count = len(capture.frames)
    if not bad:
        return [Finding("ok", "masks", f"all {count} usable")]
    frame, images = bad[0]
    dim = 0 < float(images.mask.max()) < 0.1
    why = ": they look like 0 and 1 of 255" if dim else ""
    bad_training = sum(frame.split == "train" for frame, _ in bad)
    too_many = bad_training > MAX_BAD_MASKS * len(capture.split("train"))  # as rnd-train counts
    level: Literal["wrong", "note"] = "wrong" if too_many or dim else "note"
    return [Finding(level, "masks", f"{len(bad)} of {count} empty or full, the first {frame.mask}{why}")]


def _background(capture: Capture, bright: list[bool]) -> list[Finding]:
    if not any(bright):
        return []
    first = capture.frames[bright.index(True)].image
    sentence = f"{sum(bright)} images are not on black outside their masks, the first {first}"
    return [Finding("wrong" if sum(bright) > len(bright) / 5 else "note", "background", sentence)]


def _fit(capture: Capture, views: list[MaskView], ious: list[FrameIoU]) -> list[Finding]:
    if not views:
        return wrong("silhouette", "no usable mask to compare with")
    scores = [entry.iou for entry in ious]
    mean, worst = float(np.mean(scores)), ious[int(np.argmin(scores))]
    numbers = f"mean IoU {mean:.2f}, lowest {worst.iou:.2f} in {worst.image}"
    few = evenly_spaced(views, HYPOTHESIS_FRAMES)
    rotation = _matrix(_import_notes(capture).get("turn"))
    cause = explain(capture.body.skeleton.rest_joints[0], np.eye(3) if rotation is None else rotation, few)
    if cause is not None:
        return wrong("silhouette", f"mean IoU {mean:.2f}: {cause.sentence} (mean IoU {cause.iou:.2f} then)")
    timing = explain_timing(capture, evenly_spaced(views, 2 * HYPOTHESIS_FRAMES))
    if timing is not None:
        return wrong("timing", f"{numbers}: {timing.sentence} (mean IoU {timing.iou:.2f} then)")
    if mean < MIN_IOU:
        return wrong("silhouette", f"{numbers}: the template misses the masks for no usual reason; see the overlay")
    return [Finding("ok", "silhouette", numbers), *_distortion(capture, few)]


def _distortion(capture: Capture, few: list[MaskView]) -> list[Finding]:
    """Finding if silhouettes fit better with radial distortion, each at its best zoom."""
    zoomed = [[view.zoomed(zoom) for view in few] for zoom in ZOOMS]
    scores = {k1: max(mean_iou(views, k1) for views in zoomed) for k1 in DISTORTIONS}
    k1 = max(scores, key=lambda k: scores[k])
    if scores[k1] < scores[0.0] + DISTORTION_GAIN or _edge_shift(few, k1) < MIN_SHIFT:
        return []
    undone = _undone_k1(capture)
    sentence = f"the images look distorted, k1 near {k1:+.1f} (mean IoU {scores[0.0]:.2f} to {scores[k1]:.2f}): "
    if undone:
        cause = "the distortion was never undone" if undone * k1 > 0 else "the distortion was undone twice"
        return wrong("lens", sentence + cause)
    return [Finding("note", "lens", sentence + "the distortion was not undone, or undone twice")]


def _edge_shift(few: list[MaskView], k1: float) -> float:
    """Largest displacement in pixels of a mask's point by ``k1``."""
    farthest = 0.0
    for view in few:
        rows, columns = np.nonzero(view.mask)
        K = view.camera.K
        radius = np.hypot((columns + 0.5 - K[0, 2]) / K[0, 0], (rows + 0.5 - K[1, 2]) / K[1, 1]).max()
        farthest = max(farthest, abs(k1) * float(radius) ** 3 * K[0, 0])
    return farthest


def _import_notes(capture: Capture) -> dict[str, Any]:
    """Notes of ``rnd-data import`` in capture.json; empty for other captures."""
    notes = msgspec.json.decode(capture.file.read_bytes()).get("import")
    return notes if isinstance(notes, dict) else {}


def _undone_k1(capture: Capture) -> float:
    """k1 of the first lens that the import undistorted, or 0."""
    noted = _import_notes(capture).get("distortion")
    first = next(iter(noted.values()), None) if isinstance(noted, dict) else None
    k1 = first[0] if isinstance(first, list) and first else 0.0
    return float(k1) if isinstance(k1, int | float) else 0.0


def _matrix(noted: object) -> Floats | None:
    """A noted [3, 3] matrix, or None: notes in capture.json are free text."""
    try:
        matrix = np.array(noted, np.float64)
    except (TypeError, ValueError, OverflowError):
        return None
    return matrix if matrix.shape == (3, 3) and np.isfinite(matrix).all() else None


def _normals(capture: Capture, pairs: list[tuple[Floats, Floats]], count: int) -> list[Finding]:
    pairs = [pair for pair in pairs if len(pair[0])]
    if not pairs:
        return [Finding("note", "normals", "none" if not count else "none where the template is")]
    axes = compare_axes(pairs, _matrix(_import_notes(capture).get("normal_axes")))
    if axes.wrong:
        better = f"with --normal-axes={axes.best_axes} it would be {axes.best_cosine:.2f}"
        return wrong("normals", f"mean cosine {axes.cosine:.2f} to the template; {better}")
    if axes.facing < 0.9:
        return wrong("normals", f"{1 - axes.facing:.0%} point away from the camera: z should be negative")
    degrees = np.degrees(np.arccos(np.clip(axes.cosine, -1, 1)))
    sentence = f"in {count} frames, {degrees:.0f}° from the template, {axes.facing:.0%} face the camera"
    return [Finding("ok", "normals", sentence)]
