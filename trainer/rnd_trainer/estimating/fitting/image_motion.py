"""The body's surface moves between frames as the image does.

Rotations in depth move the side that faces the camera across it; landmarks on the bones' axes hardly show them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rnd_trainer.estimating.flow import Flow

from .kinematics import Posed
from .normal_equations import NormalEquations
from .state import Layout, State
from .surface import POINTS, Ints, Surface, spaced
from .terms import Lens, robust

Floats = NDArray[np.float64]

_DEVIATION_PX, _DEVIATION_M = 0.5, 0.0025  # of measured flow,
_SHARE = 0.05  # and as a share of the way


@dataclass(frozen=True, eq=False)
class FlowTerm:
    """Measured displacements of vertices from each of T frames to the one ``gap`` frames later.

    Shape and focal length count as known.

    Attributes:
        vertices: [T − gap, POINTS]; displacement: [T − gap, POINTS, 2] px; inverse: [T − gap, POINTS] one over the
            deviation, px⁻¹, 0 for none.
    """

    surface: Surface
    gap: int
    vertices: Ints
    displacement: Floats
    inverse: Floats
    weight: float = 1.0
    limit: float = 3.0

    @classmethod
    def of(
        cls, surface: Surface, visible: Sequence[tuple[Ints, Floats]], flow: Flow, scale: Floats, weight: float
    ) -> FlowTerm:
        """The term of the vertices and pixels ``visible`` in each frame; ``scale`` [T] pixels a metre."""
        pairs = len(flow.boxes)
        rng = np.random.default_rng(0)
        vertices = np.zeros((pairs, POINTS), np.int64)
        displacement, inverse = np.zeros((pairs, POINTS, 2)), np.zeros((pairs, POINTS))
        for k, (found, pixels) in enumerate(visible[:pairs]):
            moved = flow.at(k, pixels)
            chosen = spaced(pixels, np.flatnonzero(np.isfinite(moved).all(1)), scale[k], rng)
            count = len(chosen)
            vertices[k, :count], displacement[k, :count] = found[chosen], moved[chosen]
            way = np.linalg.norm(moved[chosen], axis=1)
            inverse[k, :count] = 1 / (np.hypot(_DEVIATION_PX, _DEVIATION_M * scale[k]) + _SHARE * way)
        return cls(surface, flow.gap, vertices, displacement, inverse, weight)

    def __call__(
        self, state: State, posed: Posed, layout: Layout, lens: Lens, equations: NormalEquations | None
    ) -> float:
        ends = [posed.part(slice(0, -self.gap)), posed.part(slice(self.gap, None))]
        first, last = (self.surface.seen(state, end, lens, self.vertices) for end in ends)
        residual = (last.pixels - first.pixels - self.displacement) * self.inverse[..., None]
        cost, kept = robust((residual**2).sum(-1), self.limit)
        if equations is not None:
            count = len(residual)
            parts = [
                (sign * self.inverse[..., None, None] * self.surface.by_pose(seen, end, layout)).reshape(
                    count, -1, layout.unknowns
                )
                for sign, seen, end in zip((-1, 1), (first, last), ends)
            ]
            weight = self.weight * np.repeat(kept, 2, axis=1)
            equations.add_chain(residual.reshape(count, -1), weight, parts, self.gap)
        return self.weight * cost
