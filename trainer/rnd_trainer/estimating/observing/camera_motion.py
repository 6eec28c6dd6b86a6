"""The camera's motion by its background: cuts and walks are refused, hand-held sway is taken out.

Sway is a rotation about the lens: the background moves by a homography that depends on three angles.

Source: Shi and Tomasi 1994, Good features to track; Bouguet 2001, pyramidal Lucas-Kanade; Hartley and Zisserman 2004,
Multiple view geometry (rotation homographies).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_trainer.estimating.flow import tracked

from .regions import Floats, Image, Region

_SIDE = 640  # pixels of the longer side in which the background is followed
_FOCAL = 1.15  # focal length over the longer side: of small rotations any usual one gives the same images
_FEATURES, _MIN_FEATURES = 400, 12  # fewer say nothing: a plain wall counts as still
_BODY_WIDTH = 0.7  # of a person's region, of its height: arms
_RETURN = 0.7  # pixels between a feature and where it comes back to
_STILL = 0.6  # pixels of the full image: p95 of the motion of a camera on a tripod
_FAR = 0.15  # of the longer side: motion beyond that of a hand
_PARALLAX = 2.0  # pixels of the small image: deviation of the background from a rotation
_ZOOM = 0.06  # change of size beyond that of a hand
_OFTEN = 0.2  # share of the frames
_THUMB = (32, 18)
_MIN_LIKENESS, _MIN_CONTRAST = 0.5, 6.0  # correlation of consecutive frames, 8-bit steps for it to mean anything
_TUKEY = 3.0  # pixels


@dataclass(frozen=True, eq=False)
class Steady:
    """A video whose frames are warped to one direction of the camera; of a still camera, the video as it is.

    Attributes:
        homographies: [3, 3] by frame number, from a frame's pixels to the steady ones; empty when nothing is warped.
        moved_px: p95 of the motion taken out, pixels.
    """

    video: Any
    homographies: dict[int, Floats]
    moved_px: float

    def __getattr__(self, name: str) -> Any:
        return getattr(object.__getattribute__(self, "video"), name)

    def frame(self, number: int) -> Image:
        image: Image = self.video.frame(number)
        if number not in self.homographies:
            return image
        shift = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1.0]])  # from indices to positions
        matrix = np.linalg.inv(shift) @ self.homographies[number] @ shift
        size = image.shape[1], image.shape[0]
        return cv2.warpPerspective(image, matrix, size, borderMode=cv2.BORDER_REPLICATE)


def steady(
    video: Any,
    numbers: Sequence[int],
    people: Sequence[Region] = (),
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> Steady:
    """``video`` with hand-held sway taken out.

    Args:
        people: in the first frame; the background is followed beside them.

    Raises:
        InputError: a cut in the clip, or a camera that walks, pans or zooms.
    """
    scale = min(1.0, _SIDE / max(video.width, video.height))
    first = _grey(video.frame(numbers[0]), scale)
    features = cv2.goodFeaturesToTrack(first, _FEATURES, 0.01, 8, mask=_beside(people, first.shape, scale))
    rotations, parallax, zoom, before = [np.zeros(3)], [0.0], [1.0], first
    lens = _lens(first.shape[1], first.shape[0])
    for done, number in enumerate(numbers[1:]):
        grey = _grey(video.frame(number), scale)
        if _is_cut(before, grey):
            hint = "one shot is needed: --start and --stop choose it"
            raise InputError("cut in the video", file=getattr(video, "path", None), frame=number, hint=hint)
        before = grey
        found = None
        if features is not None and len(features) >= _MIN_FEATURES:
            found = _rotation(first, grey, features, lens, rotations[-1])
        turned, error, size = found or (rotations[-1], 0.0, 1.0)
        rotations.append(turned)
        parallax.append(error)
        zoom.append(size)
        on_progress(done + 2, len(numbers))
    return _checked(video, numbers, np.array(rotations), np.array(parallax), np.array(zoom), lens, scale)


def _beside(people: Sequence[Region], shape: tuple[int, ...], scale: float) -> Image:
    """255 where no one is: outside of an upright ellipse in each region."""
    free = np.full(shape, 255, np.uint8)
    for region in people:
        centre = round(region.x * scale), round(region.y * scale)
        axes = round(_BODY_WIDTH * region.size * scale / 2), round(region.size * scale / 2)
        cv2.ellipse(free, centre, axes, float(np.degrees(region.rotation)), 0, 360, 0, -1)
    return free


def _checked(
    video: Any, numbers: Sequence[int], rotations: Floats, parallax: Floats, zoom: Floats, lens: Floats, scale: float
) -> Steady:
    corners = np.array([[0, 0], [lens[0, 2] * 2, 0], [0, lens[1, 2] * 2], [lens[0, 2] * 2, lens[1, 2] * 2]])
    middle = axis_angle_to_matrix(np.median(rotations, axis=0))
    small = [lens @ middle @ axis_angle_to_matrix(one).T @ np.linalg.inv(lens) for one in rotations]
    moved = np.array([np.linalg.norm(_by(matrix, corners) - corners, axis=1).max() for matrix in small])
    far = moved.max() / (2 * lens[:2, 2].max())
    reason = None
    if np.mean(np.abs(zoom - 1) > _ZOOM) > _OFTEN:
        reason = f"one that walks or zooms: the background's size changes by {np.abs(zoom - 1).max():.0%}"
    elif np.mean(parallax > _PARALLAX) > _OFTEN:
        reason = f"one that walks: {np.median(parallax) / scale:.0f} pixels of parallax"
    elif far > _FAR:
        reason = f"one that pans: the background moves by {moved.max() / scale:.0f} pixels"
    if reason is not None:
        expected = "one that stands, or is held on the spot"
        raise InputError("camera", expected=expected, got=reason, file=getattr(video, "path", None))
    moved_px = float(np.percentile(moved, 95)) / scale
    if moved_px < _STILL:
        return Steady(video, {}, 0.0)
    grow = np.diag([1 / scale, 1 / scale, 1.0])
    full = {n: grow @ matrix @ np.linalg.inv(grow) for n, matrix in zip(numbers, small)}
    return Steady(video, full, moved_px)


def _rotation(
    first: Image, grey: Image, features: NDArray[Any], lens: Floats, guess: Floats
) -> tuple[Floats, float, float] | None:
    """Rotation [3] from the first frame to ``grey``, the background's deviation from it, and its change of size."""
    ahead = _by(_homography(lens, guess), features[:, 0].astype(np.float64)).astype(np.float32)
    there, gap = tracked(first, grey, features[:, 0], ahead)
    good = gap < _RETURN
    source, target = features[good, 0].astype(np.float64), there[good].astype(np.float64)
    if len(source) < _MIN_FEATURES:
        return None
    similar, inliers = cv2.estimateAffinePartial2D(source, target, ransacReprojThreshold=2.0)
    if similar is None:
        return None
    rotation, error = _fitted(source, target, lens, guess, inliers.ravel() > 0)
    return rotation, error, float(np.hypot(similar[0, 0], similar[1, 0]))


def _fitted(
    source: Floats, target: Floats, lens: Floats, rotation: Floats, inliers: NDArray[np.bool_]
) -> tuple[Floats, float]:
    """Robust rotation [3] from ``source`` to ``target``, and the median distance left among two thirds of them."""
    weights = inliers.astype(np.float64)
    for _ in range(8):
        residual = target - _by(_homography(lens, rotation), source)
        columns = []
        for axis in range(3):
            small = np.zeros(3)
            small[axis] = 1e-4
            columns.append((_by(_homography(lens, rotation + small), source) - target + residual) / 1e-4)
        jacobian = np.stack(columns, -1)
        normal = np.einsum("n,nik,nil->kl", weights, jacobian, jacobian) + 1e-9 * np.eye(3)
        rotation = rotation + np.linalg.solve(normal, np.einsum("n,nik,ni->k", weights, jacobian, residual))
        apart = np.linalg.norm(target - _by(_homography(lens, rotation), source), axis=1)
        weights = np.square(np.clip(1 - np.square(apart / _TUKEY), 0, None)) + 1e-6
    return rotation, float(np.percentile(apart, 50))


def _homography(lens: Floats, rotation: Floats) -> Floats:
    matrix: Floats = lens @ axis_angle_to_matrix(rotation) @ np.linalg.inv(lens)
    return matrix


def _lens(width: int, height: int) -> Floats:
    focal = _FOCAL * max(width, height)
    return np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])


def _by(matrix: Floats, points: Floats) -> Floats:
    moved = points @ matrix[:, :2].T + matrix[:, 2]
    return moved[:, :2] / moved[:, 2:]


def _grey(image: Image, scale: float) -> Image:
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    if scale == 1:
        return grey
    return cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)


def _is_cut(before: Image, after: Image) -> bool:
    """Whether two consecutive frames show different scenes: their thumbnails do not correlate."""
    thumbs = [cv2.resize(grey, _THUMB, interpolation=cv2.INTER_AREA).astype(np.float64) for grey in (before, after)]
    a, b = (thumb - thumb.mean() for thumb in thumbs)
    if min(a.std(), b.std()) < _MIN_CONTRAST:
        return abs(thumbs[0].mean() - thumbs[1].mean()) > 6 * _MIN_CONTRAST
    return float((a * b).mean() / (a.std() * b.std())) < _MIN_LIKENESS
