"""The pictures a check looks at, made small, and the template drawn into them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from rnd_runtime.capture.body import posed_vertices
from rnd_runtime.capture.capture import Capture, Frame
from rnd_runtime.core.camera import Camera

from .silhouette import DrawnMesh, draw, overlap, silhouette

Floats = NDArray[np.float64]

SIZE = 192
"""pixels, the longer side of what is compared: IoU changes by less than 0.005 above it, time quadruples"""


@dataclass(frozen=True, eq=False)
class Sight:
    """One frame as a check sees it.

    Attributes:
        frame, camera: the frame, and its camera scaled to ``mask``.
        mask: [h, w] True for the person.
        faces: [F, 3] of the template.
        vertices: [V, 3] m, world: the template in the pose that the capture gives it.
        turn, joint: [3, 3] and [3] m: rotation and place of its root.
    """

    frame: Frame
    camera: Camera
    mask: NDArray[np.bool_]
    faces: NDArray[np.int32]
    vertices: Floats
    turn: Floats
    joint: Floats

    def view(self) -> DrawnMesh:
        """The template as the camera sees it."""
        return draw(self.vertices, self.faces, self.camera)

    def moved(self, turn: Floats, joint: Floats) -> Sight:
        """The same pose with another root rotation [3, 3] and place [3] m."""
        vertices = (self.vertices - self.joint) @ (turn @ self.turn.T).T + joint
        return replace(self, vertices=vertices, turn=turn, joint=joint)

    def seen_by(self, K: Floats | None = None, world_to_camera: Floats | None = None) -> Sight:
        """The same person before another camera."""
        pose = self.camera.world_to_camera if world_to_camera is None else world_to_camera
        K = self.camera.K if K is None else K
        return replace(self, camera=Camera(self.camera.width, self.camera.height, K, pose))

    def zoomed(self, factor: float) -> Sight:
        """The same sight with its focal lengths times ``factor``."""
        K = self.camera.K.copy()
        K[:2, :2] *= factor
        return self.seen_by(K=K)


def sight(
    capture: Capture, frame: Frame, mask: NDArray[np.float32], *, size: int = SIZE, index: int | None = None
) -> Sight:
    """``frame`` with its ``mask`` [H, W], shrunk to at most ``size`` pixels a side.

    ``index`` is another motion frame to pose the template by.
    """
    camera = capture.cameras[frame.camera]
    factor = min(1.0, size / max(camera.width, camera.height))
    small = camera.resized(max(1, round(camera.width * factor)), max(1, round(camera.height * factor)))
    shrunk = cv2.resize(mask, (small.width, small.height), interpolation=cv2.INTER_AREA) > 0.5
    return posed(capture, Sight(frame, small, shrunk, capture.body.faces, *_NO_POSE), index)


_NO_POSE = (np.zeros((1, 3)), np.eye(3), np.zeros(3))


def posed(capture: Capture, seen: Sight, index: int | None = None) -> Sight:
    """``seen`` with the template in the pose of motion frame ``index``, its own when None."""
    k = seen.frame.frame if index is None else index
    rotations, translation = capture.motion.rotations[k], capture.motion.translations[k]
    vertices = posed_vertices(capture.body, rotations, translation)
    joint = capture.body.skeleton.rest_joints[0] + translation
    return replace(seen, vertices=vertices, turn=rotations[0], joint=joint)


def mean_overlap(sights: list[Sight], *, distortion: float = 0.0) -> float:
    """Mean IoU of the template's silhouette with the masks of ``sights``, through a lens of ``distortion``."""
    drawn = [silhouette(seen.vertices, seen.faces, seen.camera, distortion) for seen in sights]
    return float(np.mean([overlap(template, seen.mask) for template, seen in zip(drawn, sights)]))


def spread(sights: list[Sight], count: int) -> list[Sight]:
    """At most ``count`` of ``sights``, evenly spaced."""
    if len(sights) <= count:
        return sights
    return [sights[round(k)] for k in np.linspace(0, len(sights) - 1, count)]
