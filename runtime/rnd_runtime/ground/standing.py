"""The ground that a motion stands on."""

from __future__ import annotations

import numpy as np

from rnd_runtime.avatar.avatar import Avatar
from rnd_runtime.motion.motion import Motion

from .shadow import Plane

FRAMES = 24
"""evenly spaced, in which the body's lowest point is found"""
STANDING = 25
"""percentile of the lowest points: a body that jumps or climbs stands in at least a quarter of them"""
UP = np.array([0.0, 1.0, 0.0])


def ground_of(avatar: Avatar, motion: Motion) -> Plane:
    """The horizontal plane under the feet of ``avatar`` in ``motion``."""
    lowest = []
    for time in np.linspace(0, motion.duration, FRAMES):
        encoded = avatar.encode(motion, float(time))
        means = avatar.posed(encoded).means
        heights = means[np.isfinite(means).all(axis=1)] @ encoded.root[1, :3] + encoded.root[1, 3]
        lowest.append(np.percentile(heights, 0.05))  # a few Gaussians may stray
    return Plane(UP, float(np.percentile(lowest, STANDING)))
