"""All that can be said about a capture without training on it."""

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
from rnd_trainer.training.data import MAX_BAD_MASKS, light_names, usable

from .hypotheses import explain, explain_timing
from .normals import judge, pixels
from .silhouette import overlap
from .views import Sight, mean_overlap, sight, spread

Floats = NDArray[np.float64]
Level = Literal["ok", "note", "wrong"]

FEW = 8
"""frames that hypotheses are tried on"""
GOOD_OVERLAP = 0.70
"""mean IoU below which something is wrong: a dressed person over the bare template reaches 0.82 to 0.90"""
BODY_SIZE = (0.4, 2.6)
DISTANCE = (0.3, 300.0)
"""metres: PHALP's lens puts a person of a third of the picture's height a hundred metres away"""
FIELD_OF_VIEW = (2.0, 150.0)  # degrees; PHALP's is 2.9
BACKGROUND = 0.02
"""mean sRGB value outside the mask from which on a picture is not on black"""
FASTEST_JOINT = 20.0
"""m/s: a boxer's fist reaches 12"""
DISTORTIONS = tuple(np.linspace(-0.4, 0.4, 9).round(1).tolist())
DISTORTION_GAIN = 0.015
"""IoU that a radial distortion must win over the best zoom, which clothes and hair can fake"""
LEAST_BEND = 0.5
"""pixels that a lens must move the mask's edge to be seen at all: less is lost in the masks' own steps"""
ZOOMS = (0.96, 1.0, 1.04, 1.08)


@dataclass(frozen=True)
class Finding:
    """One sentence about one subject."""

    level: Level
    subject: str
    sentence: str


@dataclass(frozen=True)
class FrameOverlap:
    """How well the template's silhouette covers the mask of one picture."""

    image: str
    camera: str
    frame: int
    split: str
    iou: float


@dataclass(frozen=True, eq=False)
class Report:
    """What ``check_capture`` found.

    Attributes:
        findings: in the order in which things depend on each other.
        overlaps: of every frame with a usable mask.
        sights: what was compared, for pictures.
    """

    capture: Capture
    findings: tuple[Finding, ...]
    overlaps: tuple[FrameOverlap, ...]
    sights: tuple[Sight, ...]

    @property
    def wrong(self) -> bool:
        return any(finding.level == "wrong" for finding in self.findings)

    @property
    def mean_iou(self) -> float:
        return float(np.mean([entry.iou for entry in self.overlaps])) if self.overlaps else 0.0


def check_capture(path: str | Path, *, on_frame: Callable[[int, int], None] = lambda done, total: None) -> Report:
    """Check a capture against itself.

    Files, sizes, channels and indices are checked by reading it; then what trains, lights, units, cameras, masks,
    backgrounds, the template's silhouette against every mask, normal axes, timing, frame rate and lens distortion.

    Args:
        on_frame: called with (frames done, frames in all).

    Raises:
        InputError: where the capture cannot be read at all.
    """
    capture = load_capture(path)
    findings = [Finding("ok", "files", f"{len(capture.frames)} pictures of {len(capture.cameras)} cameras")]
    findings += [*_training(capture), *_lights(capture)]
    findings += [*_units(capture), *_cameras(capture), *_speed(capture)]
    sights, overlaps, normal_pixels, bad_masks, bright = [], [], [], [], []
    for done, frame in enumerate(capture.frames):
        bare = msgspec.structs.replace(frame, normal=None, normal_gt=None)  # flipped normals are judged, not refused
        images = capture.load_frame(bare)
        if usable(images.mask):
            seen = sight(capture, bare, images.mask)
            view = seen.view()
            sights.append(seen)
            overlaps.append(_frame_overlap(frame, overlap(view.mask, seen.mask)))
            if frame.normal is not None:
                normals = decode_normals(read_unit_range(capture.folder / frame.normal))
                normal_pixels.append(pixels(normals, view))
        else:
            bad_masks.append((frame, images))
        outside = images.image_srgb[images.mask == 0]
        bright.append(bool(len(outside)) and float(outside.mean()) > BACKGROUND)
        on_frame(done + 1, len(capture.frames))
    findings += [*_masks(bad_masks, capture), *_background(capture, bright)]
    findings += _fit(capture, sights, overlaps)
    findings += _normals(capture, normal_pixels, sum(frame.normal is not None for frame in capture.frames))
    return Report(capture, tuple(findings), tuple(overlaps), tuple(sights))


def _frame_overlap(frame: Frame, iou: float) -> FrameOverlap:
    return FrameOverlap(frame.image, frame.camera, frame.frame, frame.split, iou)


def _training(capture: Capture) -> list[Finding]:
    frames = capture.split("train")
    if not frames:
        sentence = f'no picture trains: none of {len(capture.frames)} is of the split "train"'
        return [Finding("wrong", "training", sentence)]
    names = light_names(frames)
    if len(names) > 1:
        sentence = f"the training pictures have {len(names)} lights ({', '.join(names)}); one can be learned"
        return [Finding("wrong", "training", sentence)]
    return []


def _lights(capture: Capture) -> list[Finding]:
    findings = []
    for name in capture.lights:
        try:
            capture.load_light(name)
        except InputError as error:
            findings.append(Finding("wrong", "lights", f"{name}: {error}"))
    return findings


def _units(capture: Capture) -> list[Finding]:
    size = float(np.ptp(capture.body.vertices, axis=0).max())
    low, high = BODY_SIZE
    if low <= size <= high:
        return [Finding("ok", "units", f"the template is {size:.2f} m across")]
    for unit, factor in (("millimetres", 1e-3), ("centimetres", 1e-2), ("inches", 0.0254)):
        if low <= size * factor <= high:
            return [Finding("wrong", "units", f"the template is {size:.4g} m across: these look like {unit}")]
    return [Finding("wrong", "units", f"the template is {size:.4g} m across; a person is {low:g} to {high:g}")]


def _cameras(capture: Capture) -> list[Finding]:
    findings = []
    roots = capture.motion.translations + capture.body.skeleton.rest_joints[0]
    used: dict[str, list[int]] = {}
    for frame in capture.frames:
        used.setdefault(frame.camera, []).append(frame.frame)
    far, behind, narrow = [], [], []
    for name, frames in used.items():
        camera = capture.cameras[name]
        local = roots[frames] @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
        distance = float(np.median(np.linalg.norm(local, axis=1)))
        if not DISTANCE[0] <= distance <= DISTANCE[1]:
            far.append((name, distance))
        if float((local[:, 2] > 0).mean()) < 0.5:
            behind.append(name)
        view = 2 * np.degrees(np.arctan(0.5 * max(camera.width, camera.height) / camera.K[0, 0]))
        x, y = camera.K[0, 2] / camera.width, camera.K[1, 2] / camera.height
        if not FIELD_OF_VIEW[0] <= view <= FIELD_OF_VIEW[1] or not (-0.5 < x < 1.5 and -0.5 < y < 1.5):
            narrow.append(f"{name} sees {view:.3g}° around {x:.2g}, {y:.2g} of its picture")
    if far:
        name, distance = far[0]
        unit = (
            ": millimetres for metres?"
            if distance > 300
            else ": metres taken for millimetres?"
            if distance < 0.02
            else ""
        )
        findings.append(Finding("wrong", "cameras", f"{name} is {distance:.4g} m from the person{unit}"))
    if behind:
        sentence = f"the person is behind {len(behind)} of {len(used)} cameras ({behind[0]}): inverted or OpenGL axes?"
        findings.append(Finding("wrong", "cameras", sentence))
    if narrow:
        findings.append(Finding("wrong", "cameras", f"{narrow[0]}: K does not belong to these pictures"))
    turned = capture.motion.rotations[:, 0, :, 1].mean(0)  # where the pelvis's own up points, on average
    if abs(turned[1]) < 0.5 < np.abs(turned).max():
        axis = "xyz"[int(np.abs(turned).argmax())]
        findings.append(Finding("wrong", "world", f"the person stands along {axis}, not along Y"))
    elif turned[1] < -0.5:
        findings.append(Finding("wrong", "world", "the person stands on the head: Y points down"))
    return findings or [Finding("ok", "cameras", f"{len(used)} in use, the person before them, Y up")]


def _speed(capture: Capture) -> list[Finding]:
    motion, skeleton = capture.motion, capture.body.skeleton
    if motion.frame_count < 3:
        return []
    joints = skeleton.joint_transforms(motion.rotations, motion.translations)[..., :3, 3]
    speed = np.linalg.norm(np.diff(joints, axis=0), axis=-1).max(1) * motion.fps
    fast = float(np.percentile(speed, 95))
    if fast > FASTEST_JOINT:
        sentence = f"joints move at {fast:.0f} m/s: frame rate {motion.fps:g} is too high, or the poses jump"
        return [Finding("wrong", "frame rate", sentence)]
    return [Finding("ok", "frame rate", f"{motion.fps:g} per second; the fastest joint moves at {fast:.1f} m/s")]


def _masks(bad: list[tuple[Frame, FrameImages]], capture: Capture) -> list[Finding]:
    count, learned = len(capture.frames), len(capture.split("train"))
    if not bad:
        return [Finding("ok", "masks", f"all {count} usable")]
    frame, images = bad[0]
    dim = 0 < float(images.mask.max()) < 0.1
    why = ": they look like 0 and 1 of 255" if dim else ""
    not_learned = sum(frame.split == "train" for frame, _ in bad)
    too_many = not_learned > MAX_BAD_MASKS * learned  # rnd-train's own rule
    level: Level = "wrong" if too_many or dim else "note"
    return [Finding(level, "masks", f"{len(bad)} of {count} empty or full, the first {frame.mask}{why}")]


def _background(capture: Capture, bright: list[bool]) -> list[Finding]:
    if not any(bright):
        return []
    first = capture.frames[bright.index(True)].image
    sentence = f"{sum(bright)} pictures are not on black outside their masks, the first {first}"
    return [Finding("wrong" if sum(bright) > len(bright) / 5 else "note", "background", sentence)]


def _fit(capture: Capture, sights: list[Sight], overlaps: list[FrameOverlap]) -> list[Finding]:
    if not sights:
        return [Finding("wrong", "silhouette", "no usable mask to compare with")]
    scores = [entry.iou for entry in overlaps]
    mean, worst = float(np.mean(scores)), overlaps[int(np.argmin(scores))]
    numbers = f"mean IoU {mean:.2f}, lowest {worst.iou:.2f} in {worst.image}"
    few = spread(sights, FEW)
    turn = _matrix(_imported(capture).get("turn"))
    verdict = explain(capture.body.skeleton.rest_joints[0], np.eye(3) if turn is None else turn, few)
    if verdict is not None:
        sentence = f"mean IoU {mean:.2f}: {verdict.sentence} (mean IoU {verdict.overlap:.2f} then)"
        return [Finding("wrong", "silhouette", sentence)]
    timing = explain_timing(capture, spread(sights, 2 * FEW))
    if timing is not None:
        sentence = f"{numbers}: {timing.sentence} (mean IoU {timing.overlap:.2f} then)"
        return [Finding("wrong", "timing", sentence)]
    if mean < GOOD_OVERLAP:
        sentence = f"{numbers}: the template misses the masks, and no usual mistake explains it; look at the overlay"
        return [Finding("wrong", "silhouette", sentence)]
    return [Finding("ok", "silhouette", numbers), *_distortion(capture, few)]


def _distortion(capture: Capture, few: list[Sight]) -> list[Finding]:
    """Would the silhouettes fit better through a lens that bends? Compared at each one's best zoom."""
    zoomed = [[seen.zoomed(zoom) for seen in few] for zoom in ZOOMS]
    scores = {k1: max(mean_overlap(sights, distortion=k1) for sights in zoomed) for k1 in DISTORTIONS}
    k1 = max(scores, key=lambda k: scores[k])
    if scores[k1] < scores[0.0] + DISTORTION_GAIN or _bend(few, k1) < LEAST_BEND:
        return []
    told = _told_distortion(capture)
    sentence = f"the pictures look bent, k1 near {k1:+.1f} (mean IoU {scores[0.0]:.2f} to {scores[k1]:.2f}): "
    if told:
        done = "the distortion was never undone" if told * k1 > 0 else "the distortion was undone twice"
        return [Finding("wrong", "lens", sentence + done)]
    return [Finding("note", "lens", sentence + "the distortion was not undone, or undone twice")]


def _bend(few: list[Sight], k1: float) -> float:
    """Pixels by which ``k1`` moves the mask's point farthest from the principal point."""
    farthest = 0.0
    for seen in few:
        rows, columns = np.nonzero(seen.mask)
        K = seen.camera.K
        radius = np.hypot((columns + 0.5 - K[0, 2]) / K[0, 0], (rows + 0.5 - K[1, 2]) / K[1, 1]).max()
        farthest = max(farthest, abs(k1) * float(radius) ** 3 * K[0, 0])
    return farthest


def _imported(capture: Capture) -> dict[str, Any]:
    """What ``rnd-data import`` noted in capture.json; nothing where it was not at work."""
    content = msgspec.json.decode(capture.file.read_bytes())
    imported = content.get("import")
    return imported if isinstance(imported, dict) else {}


def _told_distortion(capture: Capture) -> float:
    """k1 of the first lens that an import undid; 0 where there was none."""
    told = _imported(capture).get("distortion")
    first = next(iter(told.values()), None) if isinstance(told, dict) else None
    k1 = first[0] if isinstance(first, list) and first else 0.0
    return float(k1) if isinstance(k1, int | float) else 0.0


def _matrix(told: object) -> Floats | None:
    """What an import noted as [3, 3]; None where there is no such thing: anybody may write into capture.json."""
    try:
        matrix = np.array(told, np.float64)
    except (TypeError, ValueError, OverflowError):
        return None
    return matrix if matrix.shape == (3, 3) and np.isfinite(matrix).all() else None


def _normals(capture: Capture, pairs: list[tuple[Floats, Floats]], count: int) -> list[Finding]:
    pairs = [pair for pair in pairs if len(pair[0])]
    if not pairs:
        return [Finding("note", "normals", "none" if not count else "none where the template is")]
    axes = judge(pairs, _matrix(_imported(capture).get("normal_axes")))
    degrees = np.degrees(np.arccos(np.clip(axes.cosine, -1, 1)))
    if axes.wrong:
        return [
            Finding(
                "wrong",
                "normals",
                f"mean cosine {axes.cosine:.2f} to the template; with --normal-axes="
                f"{axes.best_axes} it would be {axes.best_cosine:.2f}",
            )
        ]
    if axes.facing < 0.9:
        sentence = f"{1 - axes.facing:.0%} point away from the camera: z should be negative"
        return [Finding("wrong", "normals", sentence)]
    return [
        Finding(
            "ok", "normals", f"in {count} frames, {degrees:.0f}° from the template, {axes.facing:.0%} face the camera"
        )
    ]
