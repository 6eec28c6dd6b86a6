"""What the landmark networks see of one person in a video: 33 points, hands and a mask of every frame."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, NamedTuple, overload

import cv2
import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.npz import Npz, save_npz

from .flow import CELLS, Flow

Image = NDArray[np.uint8]
Floats32 = NDArray[np.float32]

BLAZEPOSE = (
    *("nose", "left_eye_inner", "left_eye", "left_eye_outer", "right_eye_inner", "right_eye", "right_eye_outer"),
    *("left_ear", "right_ear", "mouth_left", "mouth_right", "left_shoulder", "right_shoulder", "left_elbow"),
    *("right_elbow", "left_wrist", "right_wrist", "left_pinky", "right_pinky", "left_index", "right_index"),
    *("left_thumb", "right_thumb", "left_hip", "right_hip", "left_knee", "right_knee", "left_ankle", "right_ankle"),
    *("left_heel", "right_heel", "left_foot_index", "right_foot_index"),
)
"""names of the 33 points in the network's order; left and right are the person's"""
LANDMARKS = len(BLAZEPOSE)
FACE = list(range(BLAZEPOSE.index("left_shoulder")))
FINGERS = list(range(BLAZEPOSE.index("left_pinky"), BLAZEPOSE.index("left_hip")))
FEET = list(range(BLAZEPOSE.index("left_heel"), LANDMARKS))
TRUNK = [BLAZEPOSE.index(side + joint) for joint in ("shoulder", "hip") for side in ("left_", "right_")]
"""points of the shoulders and hips; likewise of the face, hands, and heels with toes"""
HAND_POINTS = 21
"""points of a hand: the wrist, then four of each finger from the thumb on, base to tip"""
_SURE = 200  # of 255, a mask's value well inside of the person


class Encoded(NamedTuple):
    """What is not 0 of a grey image, as a PNG; its upper left pixel."""

    png: bytes
    left: int
    top: int


class GreyImages:
    """Images [T, H, W] uint8, such as masks (255 is the person); stored compressed, decoded when indexed.

    ``images[k]`` is [H, W], a slice or an index array gives [n, H, W]; ``numpy.asarray(images)`` decodes all of them.
    """

    def __init__(self, encoded: Iterable[Encoded], image_size: tuple[int, int]) -> None:
        self.encoded = list(encoded)
        self.image_size = image_size

    @classmethod
    def of(cls, images: Iterable[Image], image_size: tuple[int, int]) -> GreyImages:
        """Encode ``images`` [H, W] one by one."""
        return cls((_encode(image) for image in images), image_size)

    @property
    def shape(self) -> tuple[int, int, int]:
        width, height = self.image_size
        return len(self.encoded), height, width

    def __len__(self) -> int:
        return len(self.encoded)

    def __iter__(self) -> Iterator[Image]:
        return (self[k] for k in range(len(self)))

    @overload
    def __getitem__(self, index: int) -> Image: ...
    @overload
    def __getitem__(self, index: slice | NDArray[Any] | list[int]) -> Image: ...
    def __getitem__(self, index: int | slice | NDArray[Any] | list[int]) -> Image:
        if isinstance(index, int | np.integer):
            return self._decode(int(index))
        chosen = np.arange(len(self))[index]
        images = np.empty((len(chosen), *self.shape[1:]), np.uint8)
        for k, frame in enumerate(chosen):
            images[k] = self._decode(int(frame))
        return images

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        return self[:].astype(dtype or np.uint8, copy=False)

    def append(self, image: Image) -> None:
        """Encode one more image."""
        self.encoded.append(_encode(image))

    def select(self, frames: NDArray[Any] | list[int]) -> GreyImages:
        """The images of these frames, not decoded."""
        return GreyImages((self.encoded[int(k)] for k in np.arange(len(self))[frames]), self.image_size)

    def _decode(self, frame: int) -> Image:
        png, left, top = self.encoded[frame]
        pixels = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_GRAYSCALE)
        width, height = self.image_size
        image = np.zeros((height, width), np.uint8)
        if pixels is None or min(left, top) < 0 or left + pixels.shape[1] > width or top + len(pixels) > height:
            got = "damaged data" if pixels is None else f"{pixels.shape[1]} x {pixels.shape[0]} at {left}, {top}"
            raise InputError("grey image", expected=f"within {width} x {height}", got=got, frame=frame)
        image[top : top + len(pixels), left : left + pixels.shape[1]] = pixels
        return image


@dataclass(frozen=True, eq=False)
class Observations:
    """One person seen by one camera over T frames.

    Attributes:
        fps: frames per second of the video.
        image_size: width and height, pixels, of the image as displayed.
        frames: [T] numbers of the frames in the video, ascending.
        keypoints_px: [T, 33, 2] ``BLAZEPOSE`` in pixels; the centre of the first pixel is (0.5, 0.5).
        confidence: [T, 33] 0…1.
        spread_px: [T, 33] mean distance of the views of one frame from their median, pixels.
        keypoints_m: [T, 33, 3] the network's own 3D: metres from the middle of the hips, OpenCV camera axes.
        hands_px: [T, 2, 21, 2] left and right hand, pixels; NaN where not seen.
        hands_confidence: [T, 2] 0…1; 0 where not seen.
        masks: [T, H, W] coverage.
        flow: how the person's image moves between frames, where that was measured.
        person: grey levels [T, H, W] of the person, 0 elsewhere, where they were kept.
        hidden: [T, H, W], 255 where somebody else may hide the person; None where nobody was near.
    """

    fps: float
    image_size: tuple[int, int]
    frames: NDArray[np.int64]
    keypoints_px: Floats32
    confidence: Floats32
    spread_px: Floats32
    keypoints_m: Floats32
    hands_px: Floats32
    hands_confidence: Floats32
    masks: GreyImages
    flow: tuple[Flow, ...] = ()
    person: GreyImages | None = None
    hidden: GreyImages | None = None

    def __post_init__(self) -> None:
        count, points, hands = len(self.frames), len(BLAZEPOSE), HAND_POINTS
        shapes = {
            "frames": (count,),
            "keypoints_px": (count, points, 2),
            "confidence": (count, points),
            "spread_px": (count, points),
            "keypoints_m": (count, points, 3),
            "hands_px": (count, 2, hands, 2),
            "hands_confidence": (count, 2),
            "masks": (count, self.image_size[1], self.image_size[0]),
        }
        for name, shape in shapes.items():
            if (got := getattr(self, name).shape) != shape:
                raise InputError(name, expected=f"shape {shape}", got=f"{got}")

    def __len__(self) -> int:
        return len(self.frames)

    def select(self, frames: NDArray[Any] | list[int]) -> Observations:
        """The observations of some of the T frames, given as a mask or as ascending indices; without their flow."""
        arrays = {name: getattr(self, name)[frames] for name in _ARRAYS}
        images = {name: (kept := getattr(self, name)) and kept.select(frames) for name in _IMAGES}
        return Observations(self.fps, self.image_size, **images, **arrays)


_IMAGES = ("masks", "person", "hidden")
_ARRAYS = tuple(f.name for f in fields(Observations) if f.name not in ("fps", "image_size", "flow", *_IMAGES))


def only_person(image: Image, mask: Image) -> Image:
    """Grey levels 1…255 [H, W] of ``image`` [H, W, 3], RGB, where ``mask`` is sure of the person; 0 elsewhere."""
    grey = np.maximum(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), 1)
    return np.where(mask > _SURE, grey, 0).astype(np.uint8)


def save_observations(path: str | Path, observations: Observations) -> None:
    """Write ``observations`` as one .npz; its images are PNGs in a row."""
    arrays: dict[str, NDArray[Any]] = {name: getattr(observations, name) for name in _ARRAYS}
    arrays["hands_px"] = np.nan_to_num(observations.hands_px)  # readers refuse NaN; hands_confidence says where it is
    arrays["fps"] = np.array(observations.fps)
    arrays["image_size"] = np.array(observations.image_size)
    for name in _IMAGES:
        if images := getattr(observations, name):
            arrays[f"{name}_png"] = np.frombuffer(b"".join(one.png for one in images.encoded), np.uint8)
            arrays[f"{name}_ends"] = np.cumsum([len(one.png) for one in images.encoded], dtype=np.int64)
            arrays[f"{name}_corners"] = np.array([(one.left, one.top) for one in images.encoded])
    for flow in observations.flow:
        arrays[f"flow{flow.gap}_boxes"] = flow.boxes
        arrays[f"flow{flow.gap}_known"] = np.asarray(np.isfinite(flow.displacement).all(-1))
        arrays[f"flow{flow.gap}_px"] = np.nan_to_num(flow.displacement)
    save_npz(path, arrays)


def load_observations(path: str | Path) -> Observations:
    """Read what ``save_observations`` wrote; raises ``InputError`` for anything else."""
    with Npz(path, what="observations") as archive:
        width, height = (int(side) for side in archive.numbers("image_size", (2,)))
        frames = archive.numbers("frames", (None,)).astype(np.int64)
        count, points = len(frames), len(BLAZEPOSE)
        numbers = {
            "keypoints_px": archive.numbers("keypoints_px", (count, points, 2)),
            "confidence": archive.numbers("confidence", (count, points)),
            "spread_px": archive.numbers("spread_px", (count, points)),
            "keypoints_m": archive.numbers("keypoints_m", (count, points, 3)),
            "hands_confidence": archive.numbers("hands_confidence", (count, 2)),
        }
        gaps = sorted(int(name[4:-3]) for name in archive.names if re.fullmatch(r"flow[1-9]\d{0,3}_px", name))
        seen = numbers["hands_confidence"] > 0
        hands = archive.numbers("hands_px", (count, 2, HAND_POINTS, 2))
        hands[~seen] = np.nan
        return Observations(
            fps=float(archive.numbers("fps", ())),
            image_size=(width, height),
            frames=frames,
            hands_px=hands.astype(np.float32),
            masks=_images(archive, "masks", count, (width, height)),
            person=_images(archive, "person", count, (width, height)) if "person_png" in archive.names else None,
            hidden=_images(archive, "hidden", count, (width, height)) if "hidden_png" in archive.names else None,
            flow=tuple(_flow(archive, gap, count) for gap in gaps),
            **{name: array.astype(np.float32) for name, array in numbers.items()},
        )


def _images(archive: Npz, name: str, count: int, size: tuple[int, int]) -> GreyImages:
    pixels = archive.numbers(f"{name}_png", (None,)).astype(np.uint8)
    ends = archive.numbers(f"{name}_ends", (count,)).astype(np.int64)
    starts = np.concatenate([[0], ends[:-1]])
    if (ends <= starts).any() or (count and ends[-1] != len(pixels)):
        raise InputError(f"{name}_ends", expected=f"ascending positions in {name}_png", got="others", file=archive.path)
    encoded, corners = pixels.tobytes(), archive.numbers(f"{name}_corners", (count, 2)).astype(np.int64).tolist()
    return GreyImages((Encoded(encoded[a:b], *corner) for a, b, corner in zip(starts, ends, corners)), size)


def _flow(archive: Npz, gap: int, count: int) -> Flow:
    pairs = max(count - gap, 0)
    displacement = archive.numbers(f"flow{gap}_px", (pairs, CELLS, CELLS, 2)).astype(np.float16)
    displacement[archive.numbers(f"flow{gap}_known", (pairs, CELLS, CELLS)) == 0] = np.nan
    return Flow(gap, archive.numbers(f"flow{gap}_boxes", (pairs, 4)), displacement)


def _encode(image: Image) -> Encoded:
    left, top, width, height = cv2.boundingRect(image)
    part = image[top : top + max(height, 1), left : left + max(width, 1)]
    done, png = cv2.imencode(".png", part)
    assert done
    return Encoded(bytes(png), left, top)
