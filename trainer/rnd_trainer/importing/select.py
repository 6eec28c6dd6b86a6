"""Which frames of a long video to learn from: the sharpest of each pose, and no pose twice."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.errors import InputError
from rnd_runtime.motion.motion import Motion
from rnd_runtime.motion.skeleton import Skeleton


def sharpness(picture: NDArray[np.uint8], mask: NDArray[np.uint8] | None = None) -> float:
    """How sharp ``picture`` [H, W, 3] is on ``mask`` [H, W] (all of it without one): larger is sharper.

    The Laplacian's mean square over the grey picture's variance (Pertuz et al. 2013), so that neither a bright
    frame nor a person nearer to the camera wins by that alone.
    """
    grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY).astype(np.float32)
    inside = np.ones(grey.shape, bool) if mask is None else cv2.erode(mask, np.ones((5, 5), np.uint8)) > 127
    if not inside.any():
        return 0.0
    return float((cv2.Laplacian(grey, cv2.CV_32F)[inside] ** 2).mean() / (grey[inside].var() + 1))


def select_frames(
    motion: Motion, skeleton: Skeleton, sharpnesses: NDArray[np.float64], count: int
) -> NDArray[np.int64]:
    """Indices of at most ``count`` frames, ascending: poses that differ most, each by its sharpest frame.

    Poses are compared by where the joints are about the root, so turning before the camera counts, walking past it
    does not. Bins are the Voronoi cells of the farthest-point sample (Gonzalez 1985) that starts at the first frame.

    Args:
        motion: F poses of ``skeleton``.
        sharpnesses: [F], larger is sharper; −inf where a frame must not be taken.
        count: at least 1.
    """
    frames = motion.frame_count
    if sharpnesses.shape != (frames,) or count < 1:
        raise InputError(
            "frames to select from",
            expected=f"{frames} sharpnesses, at least 1 of them",
            got=f"{sharpnesses.shape}, {count}",
        )
    usable = np.flatnonzero(sharpnesses > -np.inf)
    if len(usable) <= count:
        return usable
    joints = skeleton.joint_transforms(motion.rotations[usable], np.zeros(3))[..., :3, 3]
    features = (joints - joints[:, :1]).reshape(len(usable), -1)
    distances = np.full(len(usable), np.inf)
    bins, newest = np.zeros(len(usable), np.int64), 0
    for number in range(count):
        to_newest = np.linalg.norm(features - features[newest], axis=1)
        nearer = to_newest < distances
        distances[nearer], bins[nearer] = to_newest[nearer], number
        newest = int(distances.argmax())
    chosen = [
        members[sharpnesses[usable[members]].argmax()]
        for members in (np.flatnonzero(bins == number) for number in range(count))
        if len(members)
    ]
    return np.sort(usable[chosen])
