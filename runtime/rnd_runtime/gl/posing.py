"""Posing by OpenGL: ``posing.skinning``'s formulas in a fragment per Gaussian.

Pose-independent data is uploaded once; node outputs and bones for each frame.
"""

from __future__ import annotations

import moderngl
import numpy as np

from rnd_runtime.core.arrays import Floats32
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.simd.vectors import WIDTH
from rnd_runtime.posing.rest import RestPose, Unposed
from rnd_runtime.posing.skinning import NEVER

from .passes import ROW_WIDE, GaussianTargets, GaussianTexture, Pass
from .surfaces import Surfaces

_REST_TEXELS = 6  # points 3, factors 9, normals 3, limbs 7, opacity, floor of the template
_SH_TEXELS = 4
_FIELD_TEXELS = 12  # of a node before its joints: four each for the floor's blend, offsets and SH


class GlPosing:
    """Poses one avatar at a time; the context must be current."""

    def __init__(self, context: moderngl.Context) -> None:
        self._context = context
        self._avatar: _OnDevice | None = None
        self._posed = GaussianTargets(context, (4, 4, 4, 2))
        self._visibility = GaussianTargets(context, (4,), texels=_SH_TEXELS)

    def pose(self, unposed: Unposed) -> Surfaces:
        """Pose all Gaussians of ``unposed``."""
        if self._avatar is None or self._avatar.rest is not unposed.rest:
            if self._avatar is not None:
                self._avatar.release()
                self._avatar = None
            self._avatar = _OnDevice(self._context, unposed)
        avatar, count = self._avatar, len(unposed.opacities)
        avatar.write(unposed)
        self._context.enable_only(moderngl.NOTHING)
        (points, normals, covariances, covariances_z), _ = self._posed.reserve(count)
        avatar.pose.fill()
        (visibility,), _ = self._visibility.reserve(count)
        avatar.interpolate.fill()
        return Surfaces(points, normals, covariances, covariances_z, visibility, avatar.materials, gaussians=count)

    def release(self) -> None:
        if self._avatar is not None:
            self._avatar.release()
            self._avatar = None
        self._posed.release()
        self._visibility.release()


class _OnDevice:
    """An avatar's constants, and programs for its numbers of Gaussians, joints and neighbours."""

    def __init__(self, context: moderngl.Context, unposed: Unposed) -> None:
        self.rest: RestPose = unposed.rest
        template = _padded_template(unposed.rest)
        count, columns = template.shape
        neighbours, quads = unposed.rest.neighbours.shape[1], columns // 4
        _check_limits(context, count, len(unposed.bones))
        macros = {
            "GAUSSIANS": count,
            "NEIGHBOURS": neighbours,
            "JOINT_TEXELS": quads,
            "BEFORE_JOINTS": _FIELD_TEXELS,
            "JOINT_QUADS": -(-len(unposed.bones) // 4),
            "FIELD_TEXELS": quads + _FIELD_TEXELS,
        }
        self.pose = Pass(context, ("fill.vert",), ("nodes.glsl", "pose.frag"), macros)
        self.interpolate = Pass(context, ("fill.vert",), ("nodes.glsl", "visibility.frag"), macros)
        self._fields = GaussianTexture(context, 4, texels=quads + _FIELD_TEXELS, row=ROW_WIDE)
        self._bones = context.texture((3, columns), 4, dtype="f4")
        self._mixing = GaussianTexture(context, 2, texels=neighbours, row=ROW_WIDE)
        self._template = GaussianTexture(context, 4, texels=quads, row=ROW_WIDE)
        self._rest = GaussianTexture(context, 4, texels=_REST_TEXELS, row=ROW_WIDE)
        self._materials = GaussianTexture(context, 4)
        self._constants = self._upload(unposed, template)
        self.materials = self._constants["materials"]

    def write(self, unposed: Unposed) -> None:
        """Upload a frame's data and bind it to both programs."""
        bones = np.zeros((self._bones.height, 12), np.float32)
        bones[: len(unposed.bones)] = unposed.bones.reshape(-1, 12)
        self._bones.write(bones)
        fields = self._fields.write(
            self.rest.node_fields(unposed.logits, unposed.offsets, unposed.visibility, unposed.bones)
        )
        textures = {**self._constants, "fields": fields, "bones": self._bones}
        self.interpolate.bind(textures)
        self.pose.bind(
            textures, max_offset=self.rest.max_offset, variance_floor=self.rest.floor, fallback=self.rest.fallback
        )

    def release(self) -> None:
        for part in (
            self.pose,
            self.interpolate,
            self._fields,
            self._bones,
            self._mixing,
            self._template,
            self._rest,
            self._materials,
        ):
            part.release()

    def _upload(self, unposed: Unposed, template: Floats32) -> dict[str, moderngl.Texture]:
        rest = self.rest
        mixing = np.stack([rest.neighbours.astype(np.float32), rest.neighbour_weights], axis=-1)
        rest_rows = np.zeros((len(rest.points), 4 * _REST_TEXELS), np.float32)
        ends = np.stack([unposed.opacities, rest.template.floors], axis=1)
        rest_rows[:] = np.concatenate([rest.points, rest.factors, rest.normals, rest.limbs, ends], axis=1)
        materials = np.concatenate([unposed.albedo, unposed.roughness[:, None]], axis=1)
        return {
            "mixing": self._mixing.write(np.ascontiguousarray(mixing, np.float32)),
            "log_template": self._template.write(template),
            "rest": self._rest.write(rest_rows),
            "materials": self._materials.write(np.ascontiguousarray(materials, np.float32)),
        }


def _padded_template(rest: RestPose) -> Floats32:
    """Log weights above the floor [N, C], both padded to multiples of sixteen."""
    count, joints = rest.log_template.shape
    padded = np.full((-(-count // WIDTH) * WIDTH, -(-joints // WIDTH) * WIDTH), NEVER, np.float32)
    padded[rest.template.gaussians, rest.template.joints] = rest.template.logs
    return padded


def _check_limits(context: moderngl.Context, count: int, joints: int) -> None:
    max_size = context.info["GL_MAX_TEXTURE_SIZE"]
    max_joints = (max_size // ROW_WIDE - _FIELD_TEXELS) * 4 // WIDTH * WIDTH
    if joints > max_joints:
        raise InputError("joints", expected=f"at most {max_joints} with this OpenGL", got=joints)
    if count > max_size * ROW_WIDE:
        raise InputError("Gaussians", expected=f"at most {max_size * ROW_WIDE} with this OpenGL", got=count)
