"""A person with the figure's body who turns round before a plain wall: frames, and what ideal networks would see."""

from __future__ import annotations

import cv2
import numpy as np

from rnd_runtime.capture.body import posed_vertices
from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_trainer.estimating.fitting.figure import default_figure
from rnd_trainer.estimating.fitting.kinematics import attached, pose
from rnd_trainer.estimating.fitting.marks import marks_of
from rnd_trainer.estimating.fitting.state import TO_CAMERA
from rnd_trainer.estimating.observations import GreyImages, Observations

SIZE, FOCAL, FPS = 160, 190.0, 15.0
COLOUR, WALL = (170, 90, 60), (90, 110, 130)


def filmed_person(count: int, turn_deg: float = 360.0) -> tuple[list[np.ndarray], Observations]:
    """``count`` frames [160, 160, 3] of a person who turns by ``turn_deg`` about the vertical, and observations."""
    figure = default_figure()
    body = figure.shaped(np.zeros(len(figure.names)))
    names = body.skeleton.names
    phase = np.linspace(0, 1, count)
    vectors = np.zeros((count, len(names), 3))
    vectors[:, 0, 1] = np.radians(turn_deg) * phase
    for side, sign in (("left", 1), ("right", -1)):
        vectors[:, names.index(f"{side}_shoulder"), 2] = sign * (-0.9 + 0.3 * np.sin(5 * phase))
    rotations = axis_angle_to_matrix(vectors)
    translations = np.tile([0.0, -1.0, -3.4], (count, 1))
    posed = pose(body.skeleton, rotations, translations, body.skeleton.rest_joints)
    marks = marks_of(figure)
    points = attached(posed, marks.joints, marks.places)[:, :33] @ TO_CAMERA
    pixels = FOCAL * points[..., :2] / points[..., 2:] + SIZE / 2
    masks, frames = [], []
    for k in range(count):
        vertices = posed_vertices(body, rotations[k], translations[k]) @ TO_CAMERA
        flat = FOCAL * vertices[:, :2] / vertices[:, 2:] + SIZE / 2
        mask = np.zeros((SIZE, SIZE), np.uint8)
        for triangle in (flat[body.faces] * 16).astype(np.int32):
            cv2.fillConvexPoly(mask, triangle, 255, shift=4)
        masks.append(mask)
        frames.append(np.where(mask[..., None] > 127, np.array(COLOUR), np.array(WALL)).astype(np.uint8))
    observations = Observations(
        fps=FPS,
        image_size=(SIZE, SIZE),
        frames=np.arange(count),
        keypoints_px=pixels.astype(np.float32),
        confidence=np.full((count, 33), 0.95, np.float32),
        spread_px=np.full((count, 33), 0.3, np.float32),
        keypoints_m=(points - points[:, 23:25].mean(1, keepdims=True)).astype(np.float32),
        hands_px=np.full((count, 2, 21, 2), np.nan, np.float32),
        hands_confidence=np.zeros((count, 2), np.float32),
        masks=GreyImages.of(masks, (SIZE, SIZE)),
    )
    return frames, observations
