"""check/overlay.mp4: landmarks by confidence, the outline of the fitted body, and the mask, on the video."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rnd_runtime.capture.body import Body, posed_vertices
from rnd_runtime.core.camera import Camera
from rnd_runtime.core.files import atomic_path
from rnd_runtime.motion.motion import Motion
from rnd_trainer.checking.silhouette import silhouette
from rnd_trainer.checking.views import shrunk_camera

from .observations import BLAZEPOSE, Observations

Image = NDArray[np.uint8]

SIDE = 720
"""longer side of the video, pixels"""
_LINES = [
    *(("shoulder", "elbow"), ("elbow", "wrist"), ("wrist", "index"), ("hip", "knee"), ("knee", "ankle")),
    *(("ankle", "foot_index"), ("shoulder", "hip")),
]
_BODY, _MASK, _TEXT = (255, 140, 0), (255, 255, 255), (255, 255, 0)  # RGB


def bones() -> list[tuple[int, int]]:
    """Pairs of ``BLAZEPOSE`` points that are joined by a line."""
    pairs = [(f"{side}_{a}", f"{side}_{b}") for side in ("left", "right") for a, b in _LINES]
    pairs += [("left_shoulder", "right_shoulder"), ("left_hip", "right_hip")]
    return [(BLAZEPOSE.index(a), BLAZEPOSE.index(b)) for a, b in pairs]


def write_overlay(
    path: Path,
    seen: Observations,
    frame: Callable[[int], Image],
    body: Body,
    motion: Motion,
    camera: Camera,
    left_out: dict[int, str],
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> None:
    """Write the video ``path``.

    Args:
        frame: the image of a frame's number.
        motion: one pose for each observed frame.
        left_out: reasons by frame number, written on the frame.
    """
    import av

    small = shrunk_camera(camera, SIDE)
    width, height = small.width // 2 * 2, small.height // 2 * 2
    with atomic_path(path) as temporary, av.open(str(temporary), "w", format="mp4") as container:
        rate = Fraction(seen.fps).limit_denominator(1001)
        stream = container.add_stream("libx264", rate=rate, options={"crf": "23", "preset": "veryfast"})
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        for k, number in enumerate(seen.frames):
            vertices = posed_vertices(body, motion.rotations[k], motion.translations[k])
            outline = silhouette(vertices, body.faces, small)
            image = drawn(seen, k, frame(int(number)), outline, left_out.get(int(number)))
            shown = av.VideoFrame.from_ndarray(np.ascontiguousarray(image[:height, :width]), "rgb24")
            shown.pts, shown.time_base = k, 1 / rate
            container.mux(stream.encode(shown))
            on_progress(k + 1, len(seen))
        container.mux(stream.encode())


def drawn(seen: Observations, k: int, image: Image, outline: NDArray[np.bool_], reason: str | None = None) -> Image:
    """Frame ``k`` in the size of ``outline`` [h, w], with what was seen and fitted on it."""
    height, width = outline.shape
    canvas: Any = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    mask = cv2.resize(seen.masks[k], (width, height), interpolation=cv2.INTER_AREA)
    for region, colour in ((mask > 127, _MASK), (outline, _BODY)):
        contours, _ = cv2.findContours(region.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(canvas, contours, -1, colour, 1, cv2.LINE_AA)
    points = seen.keypoints_px[k] * (width / seen.image_size[0])
    for a, b in bones():
        sure = float(min(seen.confidence[k, a], seen.confidence[k, b]))
        cv2.line(canvas, _pixel(points[a]), _pixel(points[b]), colour_of(sure), 2, cv2.LINE_AA)
    hands = seen.hands_px[k].reshape(-1, 2) * (width / seen.image_size[0])
    for point in [*points, *hands[np.isfinite(hands).all(1)]]:
        cv2.circle(canvas, _pixel(point), 2, (255, 255, 255), -1, cv2.LINE_AA)
    label = f"{int(seen.frames[k])}" + (f": left out, {reason}" if reason else "")
    cv2.putText(canvas, label, (6, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.5, _TEXT, 1, cv2.LINE_AA)
    return np.asarray(canvas, np.uint8)


def colour_of(confidence: float) -> tuple[int, int, int]:
    """RGB from red (0) to green (1)."""
    share = float(np.clip(confidence, 0, 1))
    return round(255 * min(1, 2 - 2 * share)), round(255 * min(1, 2 * share)), 0


def _pixel(point: NDArray[Any]) -> tuple[int, int]:
    x, y = np.clip(np.nan_to_num(point), -10_000, 10_000)
    return int(x), int(y)
