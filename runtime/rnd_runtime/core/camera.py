"""Pinhole cameras in OpenCV's axes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .arrays import shallow_copy
from .errors import InputError

Floats = NDArray[np.float64]

_NO_SKEW = 1e-6  # of the focal length: rounding


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera: +X right, +Y down, +Z forward, pixel centres at +0.5.

    Attributes:
        width, height: image size, pixels.
        K: intrinsics [3, 3] in pixels, (fx 0 cx; 0 fy cy; 0 0 1).
        world_to_camera: [4, 4] rigid transform, metres.

    Raises:
        InputError: for any other matrix.
    """

    width: int
    height: int
    K: Floats
    world_to_camera: Floats

    def __post_init__(self) -> None:
        object.__setattr__(self, "K", np.asarray(self.K, np.float64))
        object.__setattr__(self, "world_to_camera", np.asarray(self.world_to_camera, np.float64))
        if self.width < 1 or self.height < 1:
            raise InputError("camera size", expected="at least 1 x 1", got=f"{self.width} x {self.height}")
        if self.K.shape != (3, 3) or not np.isfinite(self.K).all() or min(self.K[0, 0], self.K[1, 1]) <= 0:
            raise InputError("camera K", expected="finite 3 x 3 with positive focal lengths", got=self.K.tolist())
        focal = max(self.K[0, 0], self.K[1, 1])
        if max(abs(self.K[0, 1]), abs(self.K[1, 0])) > _NO_SKEW * focal or not _ends(self.K, [0, 0, 1]):
            raise InputError("camera K", expected="fx 0 cx, 0 fy cy, 0 0 1", got=self.K.tolist())
        if not _rigid(self.world_to_camera):
            raise InputError(
                "camera world_to_camera", expected="a 4 x 4 rigid transform", got=self.world_to_camera.tolist()
            )

    @property
    def position(self) -> Floats:
        """Camera centre [3] in world metres."""
        return -self.world_to_camera[:3, :3].T @ self.world_to_camera[:3, 3]

    @property
    def rays(self) -> Floats:
        """[3, 3]; (column, row, 1) @ rays is the world direction, of depth 1, that an image point sees."""
        return np.linalg.inv(self.K).T @ self.world_to_camera[:3, :3]

    def project(self, points: NDArray[np.floating[Any]]) -> tuple[Floats, Floats]:
        """Pixels [N, 2], column and row, and depths [N] m of ``points`` [N, 3] m; pixels say nothing at depths ≤ 0."""
        seen = points @ self.world_to_camera[:3, :3].T + self.world_to_camera[:3, 3]
        depths = seen[:, 2]
        scaled = seen[:, :2] / np.where(depths > 0, depths, 1)[:, None]
        return scaled * self.K[[0, 1], [0, 1]] + self.K[:2, 2], depths

    def box(self, pixels: Floats) -> tuple[int, int, int, int]:
        """The part of the image that ``pixels`` [N, 2] span: first column and row, and those after the last."""
        size = np.array([self.width, self.height])
        low, high = (np.clip(edge, 0, size) for edge in (np.floor(pixels.min(axis=0)), np.ceil(pixels.max(axis=0))))
        return int(low[0]), int(low[1]), int(high[0]), int(high[1])

    def resized(self, width: int, height: int) -> Camera:
        """The same view at another resolution; intrinsics scale with the image."""
        scale = np.diag([width / self.width, height / self.height, 1.0])
        return Camera(width, height, scale @ self.K, self.world_to_camera)

    def cropped(self, rows: slice, columns: slice) -> Camera:
        """The part of the view in these rows and columns of the image."""
        shift: Floats = np.array([[1, 0, -columns.start], [0, 1, -rows.start], [0, 0, 1.0]])
        return Camera(columns.stop - columns.start, rows.stop - rows.start, shift @ self.K, self.world_to_camera)

    def in_frame(self, frame_to_world: Floats) -> Camera:
        """The same view for points in another frame; ``frame_to_world`` [4, 4] is rigid, in m."""
        return shallow_copy(self, world_to_camera=self.world_to_camera @ frame_to_world)

    @classmethod
    def look_at(
        cls,
        eye: Floats | list[float],
        target: Floats | list[float],
        *,
        width: int,
        height: int,
        fov_y: float,
        up: tuple[float, float, float] = (0.0, 1.0, 0.0),
    ) -> Camera:
        """A camera at ``eye`` [3] m looking at ``target`` [3] m, vertical field of view ``fov_y`` rad."""
        eye, target = np.asarray(eye, np.float64), np.asarray(target, np.float64)
        forward = target - eye
        if np.linalg.norm(forward) < 1e-9:
            raise InputError("look_at", expected="eye and target apart", got=eye.tolist())
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, np.asarray(up, np.float64))
        if np.linalg.norm(right) < 1e-6:  # looking along `up`: any other axis, +Z first
            right = np.cross(forward, np.eye(3)[2 if abs(forward[2]) < 0.9 else 1])
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        world_to_camera = np.eye(4)
        world_to_camera[:3, :3], world_to_camera[:3, 3] = rotation, -rotation @ eye
        focal = 0.5 * height / np.tan(0.5 * fov_y)
        K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
        return cls(width, height, K, world_to_camera)


def _rigid(matrix: Floats) -> bool:
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all() or not _ends(matrix, [0, 0, 0, 1]):
        return False
    rotation = matrix[:3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        orthogonal = np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4)
    return orthogonal and bool(np.linalg.det(rotation) > 0)


def _ends(matrix: Floats, row: list[int]) -> bool:
    """Whether the last row of ``matrix`` is ``row``, up to rounding."""
    return np.allclose(matrix[-1], row, rtol=0, atol=1e-6)
