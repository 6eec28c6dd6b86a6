"""Downscaled masks of a capture's frames, with the template in the same camera."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from rnd_runtime.capture.body import posed_vertices
from rnd_runtime.capture.capture import Capture, Frame
from rnd_runtime.core.camera import Camera

from .silhouette import RenderedMesh, mask_iou, render_mesh, silhouette

Floats = NDArray[np.float64]

SIZE = 192
"""longer side of a view, pixels; IoU changes by less than 0.005 above it"""


@dataclass(frozen=True, eq=False)
class MaskView:
    """One frame's mask and template."""

    frame: Frame
    camera: Camera  # the frame's, scaled to ``mask``
    mask: NDArray[np.bool_]  # [h, w] True for the person
    faces: NDArray[np.int32]  # [F, 3] of the template
    vertices: Floats  # [V, 3] m, world: the posed template
    root_rotation: Floats  # [3, 3] world
    root_position: Floats  # [3] m, world

    def template(self) -> RenderedMesh:
        """The template as the camera sees it."""
        return render_mesh(self.vertices, self.faces, self.camera)

    def with_root(self, rotation: Floats, position: Floats) -> MaskView:
        """The same pose with another root rotation [3, 3] and position [3] m."""
        vertices = (self.vertices - self.root_position) @ (rotation @ self.root_rotation.T).T + position
        return replace(self, vertices=vertices, root_rotation=rotation, root_position=position)

    def with_camera(self, K: Floats | None = None, world_to_camera: Floats | None = None) -> MaskView:
        """The same person in front of another camera."""
        pose = self.camera.world_to_camera if world_to_camera is None else world_to_camera
        K = self.camera.K if K is None else K
        return replace(self, camera=Camera(self.camera.width, self.camera.height, K, pose))

    def zoomed(self, factor: float) -> MaskView:
        """The same view with its focal lengths times ``factor``."""
        K = self.camera.K.copy()
        K[:2, :2] *= factor
        return self.with_camera(K=K)


def mask_view(capture: Capture, frame: Frame, mask: NDArray[np.float32]) -> MaskView:
    """``frame`` with its ``mask`` [H, W], shrunk to at most ``SIZE`` pixels a side."""
    small = shrunk_camera(capture.cameras[frame.camera], SIZE)
    shrunk = cv2.resize(mask, (small.width, small.height), interpolation=cv2.INTER_AREA) > 0.5
    no_pose = (np.zeros((1, 3)), np.eye(3), np.zeros(3))
    return with_pose(capture, MaskView(frame, small, shrunk, capture.body.faces, *no_pose), frame.frame)


def with_pose(capture: Capture, view: MaskView, k: int) -> MaskView:
    """``view`` with the template in the pose of motion frame ``k``."""
    rotations, translation = capture.motion.rotations[k], capture.motion.translations[k]
    vertices = posed_vertices(capture.body, rotations, translation)
    position = capture.body.skeleton.rest_joints[0] + translation
    return replace(view, vertices=vertices, root_rotation=rotations[0], root_position=position)


def shrunk_camera(camera: Camera, side: int) -> Camera:
    """``camera`` with at most ``side`` pixels along its longer side."""
    factor = min(1.0, side / max(camera.width, camera.height))
    return camera.resized(max(1, round(camera.width * factor)), max(1, round(camera.height * factor)))


def mean_iou(views: list[MaskView], k1: float = 0.0) -> float:
    """Mean IoU of the template's silhouettes with the masks, through a lens of radial distortion ``k1``."""
    return float(np.mean([mask_iou(silhouette(v.vertices, v.faces, v.camera, k1), v.mask) for v in views]))


def evenly_spaced(views: list[MaskView], count: int) -> list[MaskView]:
    """At most ``count`` of ``views``, evenly spaced."""
    if len(views) <= count:
        return views
    return [views[round(k)] for k in np.linspace(0, len(views) - 1, count)]
