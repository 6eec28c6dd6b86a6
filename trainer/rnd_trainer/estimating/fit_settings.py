"""How the fit weighs what it knows, and its stages."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Weights:
    """Factors of the terms, without a unit, and the standard deviations that the terms assume."""

    mark_m: float = 0.022  # deviation of a sure landmark at the person's distance, m
    spread: float = 1.0  # share of the distance between one frame's views that counts as deviation
    points: float = 2.0  # factor of the landmarks
    bones: float = 0.2  # factor of the lifter's directions
    limbs: float = 0.105  # deviation of its limbs and rolls from the body's, beside its own, rad
    trunk: float = 0.21  # likewise of its trunk; rigs differ, rad
    prior: float = 0.03  # factor of the prior of poses
    smooth: float = 0.1  # factor of smoothness
    acceleration: float = 4.0  # deviation of the trunk's along each axis, m/s²; limbs two to three times that
    spin: float = 20.0  # deviation of the joints' angular acceleration, rad/s²; factors by joint as above
    still: float = 1.0  # factor of joints that keep still
    outline: float = 0.5  # factor of the mask's outline against the body's
    inner: float = 0.15  # factor of body points that lie outside of the mask
    outline_m: float = 0.012  # deviation of outlines at the person's distance, m
    flow: float = 0.5  # factor of the surface's motion in the image
    appearance: float = 1.0  # factor of the surface's places by what it looks like in other frames
    ground: float = 1.0  # factor of feet on the ground
    balance: float = 4.0  # factor of the centre of mass above the feet
    slide: float = 0.03  # factor of standing feet that move
    shared: float = 0.1  # share of the frames that count as independent, in the weight of shape and focal length


WEIGHTS = Weights()
"""chosen on development videos, see docs/own-video.md"""


@dataclass(frozen=True)
class Stage:
    """Steps of the fit with some terms."""

    steps: int
    surface: bool = False  # the terms of outlines and flow
    appearance: bool = False  # what the stage's first pose looks like in other frames
    points: float = 1.0
    limit: float = 3.0

    @property
    def length(self) -> int:
        """Steps in all, as far as time goes."""
        return self.steps + COMPARISON * self.appearance


COMPARISON = 6
"""steps that take as long as comparing all frames with each other"""
CONVERGED = 1e-3
"""relative fall of the cost below which a stage ends"""
STAGES = (
    Stage(8, points=0.3, limit=8.0),
    Stage(10, limit=5.0),
    Stage(14, surface=True),
    Stage(5, surface=True, appearance=True),
    Stage(5, surface=True, appearance=True),
)
