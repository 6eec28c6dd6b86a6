"""Posing by OpenGL: ``posing.py``'s formulas in a fragment for each Gaussian.

Only what the networks say at the nodes and the bones go up for a frame; what does not depend on the pose lies on the
device since the first one.
"""

from __future__ import annotations

import moderngl
import numpy as np

from .gl_passes import ROW_WIDE, GaussianTargets, GaussianTexture, Pass
from .posing import TWIST_STEPS, RestPose, Unposed
from .shading import CASTING_OPACITY, DISC_SIGMAS
from .surfaces_gl import Surfaces

_REST_TEXELS = 6  # points 3, factors 9, normals 3, limbs 7, opacity, –
_HARMONIC_TEXELS = 4


class GlPosing:
    """Poses one avatar after the other; the context must be current."""

    def __init__(self, context: moderngl.Context) -> None:
        self._context = context
        self._avatar: _OnDevice | None = None

    def pose(self, unposed: Unposed) -> Surfaces:
        """All Gaussians of ``unposed``, posed."""
        if self._avatar is None or self._avatar.rest is not unposed.rest:
            self.release()
            self._avatar = _OnDevice(self._context, unposed)
        return self._avatar.pose(unposed)

    def release(self) -> None:
        if self._avatar is not None:
            self._avatar.release()
            self._avatar = None


class _OnDevice:
    """An avatar's constants, and the programs for its numbers of joints and neighbours."""

    def __init__(self, context: moderngl.Context, unposed: Unposed) -> None:
        self.rest: RestPose = unposed.rest
        self._context = context
        self._count, columns = unposed.rest.arrays.log_template.shape
        neighbours = unposed.rest.neighbours.shape[1]
        quads = columns // 4
        macros = {
            "GAUSSIANS": self._count,
            "NEIGHBOURS": neighbours,
            "JOINT_TEXELS": quads,
            "FIELD_TEXELS": quads + 8,
            "TWIST_STEPS": TWIST_STEPS,
            "CASTING_OPACITY": float(CASTING_OPACITY),
            "DISC_SIGMAS": float(DISC_SIGMAS),
        }
        self._pose = Pass(context, ("fill.vert",), ("nodes.glsl", "pose.frag"), macros)
        self._interpolate = Pass(context, ("fill.vert",), ("nodes.glsl", "visibility.frag"), macros)
        self._posed = GaussianTargets(context, (4, 4, 4, 2))
        self._harmonics = GaussianTargets(context, (4,), texels=_HARMONIC_TEXELS)
        self._fields = GaussianTexture(context, 4, texels=quads + 8, row=ROW_WIDE)
        self._bones = context.texture((3, columns), 4, dtype="f4")
        self._mixing = GaussianTexture(context, 2, texels=neighbours, row=ROW_WIDE)
        self._template = GaussianTexture(context, 4, texels=quads, row=ROW_WIDE)
        self._rest = GaussianTexture(context, 4, texels=_REST_TEXELS, row=ROW_WIDE)
        self._materials = GaussianTexture(context, 4)
        self._constants = self._upload(unposed)

    def pose(self, unposed: Unposed) -> Surfaces:
        fields = self.rest.fields(unposed.logits, unposed.offsets, unposed.visibility)
        bones = np.zeros((self._bones.height, 12), np.float32)
        bones[: len(unposed.bones)] = unposed.bones.reshape(-1, 12)
        self._bones.write(bones)
        textures = {**self._constants, "fields": self._fields.write(fields), "bones": self._bones}
        self._context.enable_only(moderngl.NOTHING)
        self._pose.bind(
            textures,
            max_offset=self.rest.max_offset,
            variance_floor=self.rest.floor,
            fallback=self.rest.fallback,
        )
        (points, normals, covariances, covariances_z), _ = self._posed.reserve(self._count)
        self._pose.fill()
        (visibility,), _ = self._harmonics.reserve(self._count)
        self._interpolate.bind(textures)
        self._interpolate.fill()
        materials = self._constants["materials"]
        return Surfaces(
            points, normals, covariances, covariances_z, visibility, materials, gaussians=self._count
        )

    def release(self) -> None:
        for part in (
            self._pose, self._interpolate, self._posed, self._harmonics, self._fields, self._bones, self._mixing,
            self._template, self._rest, self._materials,
        ):  # fmt: skip
            part.release()

    def _upload(self, unposed: Unposed) -> dict[str, moderngl.Texture]:
        rest = self.rest
        mixing = np.stack([rest.neighbours.astype(np.float32), rest.neighbour_weights], axis=-1)
        own = np.zeros((self._count, 4 * _REST_TEXELS), np.float32)
        parts = (rest.points, rest.factors, rest.normals, rest.limbs, unposed.opacities[:, None])
        own[:, :-1] = np.concatenate(parts, axis=1)
        materials = np.concatenate([unposed.albedo, unposed.roughness[:, None]], axis=1)
        return {
            "mixing": self._mixing.write(np.ascontiguousarray(mixing, np.float32)),
            "log_template": self._template.write(rest.arrays.log_template),
            "rest": self._rest.write(own),
            "materials": self._materials.write(np.ascontiguousarray(materials, np.float32)),
        }
