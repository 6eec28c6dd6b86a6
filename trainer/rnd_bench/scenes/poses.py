"""Poses that benchmarks and the stability suite share, as joint angles."""

from __future__ import annotations

Angles = dict[str, tuple[float, float, float]]

FPS = 30.0
APART: Angles = {"left_hip": (0, 0, 0.35), "right_hip": (0, 0, -0.35)}
"""the rest pose with the legs apart: neighbours in it are neighbours on the skin"""
ARMS_DOWN: Angles = {"left_shoulder": (0, 0, -1.0), "right_shoulder": (0, 0, 1.0)}
EXTREMES: dict[str, Angles] = {
    "T-pose": {},
    "squat": {
        **{"left_hip": (-1.9, 0, 0.2), "right_hip": (-1.9, 0, -0.2)},
        **{"left_knee": (2.2, 0, 0), "right_knee": (2.2, 0, 0), "spine1": (0.5, 0, 0)},
        **ARMS_DOWN,
    },
    "arms up": {"left_shoulder": (0, 0, 1.2), "right_shoulder": (0, 0, -1.2)},
    "splits": {"left_hip": (0, 0, 1.2), "right_hip": (0, 0, -1.2)},
}
"""poses that an A-pose spin does not show (axis-angle, radians)"""

CROSSED: Angles = {
    "left_shoulder": (0.0, -0.9, -0.8),
    "right_shoulder": (0.0, 0.9, 0.8),
    "left_elbow": (0.0, -1.7, 0.0),
    "right_elbow": (0.0, 1.7, 0.0),
}
