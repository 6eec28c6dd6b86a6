"""The avatar as a torch module: from a pose to posed Gaussians with their material."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from rnd_runtime.shading.brdf import ROUGHNESS_RANGE
from rnd_trainer.config import ModelConfig

from .encoders import AttributeEncoder, DynamicSkinning, PoseConditioned, Visibility, encoded_size, positional_encoding
from .interpolate import NodeInterpolation
from .posing import pose_gaussians
from .skinning import blend_transforms, tangent_frames, transform_normals
from .template import WEIGHT_FLOOR, Template
from .twist import TwistFrames

ALBEDO_RANGE = (0.001, 0.80)
"""of diffuse materials, with black cloth as phones' tone curves show it; bounds the albedo–light ambiguity"""
TANGENT_SCALE = (0.25, 2.0)
"""range of the standard deviations along the surface, in units of the spacing"""
NORMAL_SCALE = (0.05, 0.5)
"""range of the standard deviation across the surface, in units of the spacing"""
INITIAL_RAW_OPACITY = 2.2
"""initial raw opacity; its sigmoid is 0.90"""

GEOMETRY_COLUMNS = {"opacity": 1, "rotation": 3, "scale": 3, "normal": 3, "offset": 3}
LIMB_BUFFERS = ("limb_axes", "limb_levers", "limb_shares")
APPEARANCE_COLUMNS = {"colour": 3, "albedo": 3, "roughness": 1}
MIN_ROUGHNESS_RESIDUAL = -0.6
"""lower bound, in evaluation mode, of the raw roughness residual"""


@dataclass
class PoseInput:
    """Network input: motion window, joint velocities and bone transforms."""

    window: Tensor  # [d, J−1, 6]
    velocity: Tensor  # [J−1, 3] rad/s
    bones: Tensor  # [J, 3, 4]

    def to(self, device: torch.device) -> PoseInput:
        """The same on ``device``."""
        return PoseInput(self.window.to(device), self.velocity.to(device), self.bones.to(device))


@dataclass
class Attributes:
    """Activated attributes in the rest pose."""

    opacity: Tensor  # [N]
    rotation: Tensor  # [N, 3] rotation vectors in the tangent frame
    scales: Tensor  # [N, 3] m
    normals: Tensor  # [N, 3] unit
    points: Tensor  # [N, 3] m, with the static offset
    colour: Tensor  # [N, 3] linear
    albedo: Tensor  # [N, 3] linear
    roughness: Tensor  # [N]
    raw_geometry_residual: Tensor  # [N, 13]


@dataclass
class PoseFields:
    """Output of the networks for a pose, at the Gaussians."""

    attributes: Attributes
    weights: Tensor  # [N, J] skinning weights
    offset: Tensor  # [N, 3] pose-dependent offset in units of its bound
    rotation: Tensor  # [N, 3] pose-dependent rotation vectors
    visibility: Tensor  # [N, 16] SH coefficients in the root's frame


@dataclass
class PosedGaussians:
    """Posed Gaussians in the world frame."""

    means: Tensor  # [N, 3] m
    covariances: Tensor  # [N, 6] m²
    normals: Tensor  # [N, 3] unit
    visibility: Tensor  # [N, 16] SH coefficients in the root's frame
    weights: Tensor  # [N, J] skinning weights
    offset: Tensor  # [N, 3] pose-dependent offset in units of its bound
    attributes: Attributes


class AvatarModel(nn.Module):
    """N Gaussians on a template, driven by networks at M nodes.

    A Gaussian's raw attribute is the interpolated value of the nodes plus a residual of its own, initially zero.
    """

    points: Tensor
    rest_normals: Tensor
    codes: Tensor
    log_weights: Tensor
    spacing: Tensor
    tangents: Tensor
    limb_axes: Tensor
    limb_levers: Tensor
    limb_shares: Tensor

    def __init__(self, config: ModelConfig, template: Template) -> None:
        super().__init__()
        self.config = config
        joints = template.weights.shape[1]
        weights = torch.as_tensor(template.weights, dtype=torch.float64).clamp(min=WEIGHT_FLOOR)
        buffers = {
            "points": template.points,
            "rest_normals": template.normals,
            "codes": template.codes,
            "log_weights": torch.log(weights / weights.sum(dim=-1, keepdim=True)),
            "tangents": tangent_frames(torch.as_tensor(template.normals)),
            "spacing": template.spacing,
        }
        for name, value in buffers.items():
            self.register_buffer(name, torch.as_tensor(value, dtype=torch.float32))
        for name, value in zip(LIMB_BUFFERS, template.limbs):  # derived from the saved buffers
            self.register_buffer(name, torch.as_tensor(value, dtype=torch.float32), persistent=False)
        self.interpolate = NodeInterpolation(
            torch.as_tensor(template.neighbours),
            torch.as_tensor(template.neighbour_weights, dtype=torch.float32),
            config.nodes,
        )

        inputs = encoded_size(config.frequencies)
        geometry, appearance = sum(GEOMETRY_COLUMNS.values()), sum(APPEARANCE_COLUMNS.values())
        self.geometry = AttributeEncoder(inputs, config.attribute_width, geometry)
        self.appearance = AttributeEncoder(inputs, config.attribute_width, appearance)
        self.geometry_residual = nn.Parameter(torch.zeros(len(template.points), geometry))
        self.appearance_residual = nn.Parameter(torch.zeros(len(template.points), appearance))
        temporal = config.motion_encoder == "full"
        self.skinning = DynamicSkinning(inputs, joints, config.window_poses, config.width, config.heads, temporal)
        self.offsets = PoseConditioned(inputs, joints, config.width, outputs=6)
        self.visibility = Visibility(inputs, joints, config.width)

    def encoded_nodes(self) -> Tensor:
        """Positional encoding [M, E] of the nodes in the spread pose."""
        return positional_encoding(self.codes[: self.config.nodes], self.config.frequencies)

    def attributes(self, encoded: Tensor) -> Attributes:
        """D_g and D_a with residuals, activated.

        ``max_static_offset`` bounds the surface's offset from the template, one spacing a Gaussian's from the surface.
        In evaluation mode ``MIN_ROUGHNESS_RESIDUAL`` bounds the residual of roughness, the last column.
        """
        columns = {**GEOMETRY_COLUMNS, **APPEARANCE_COLUMNS}
        smooth = self.interpolate(torch.cat([self.geometry(encoded), self.appearance(encoded)], dim=-1))
        residual = torch.cat([self.geometry_residual, self.appearance_residual], dim=-1)
        if not self.training:
            residual = torch.cat([residual[:, :-1], residual[:, -1:].clamp(min=MIN_ROUGHNESS_RESIDUAL)], dim=-1)
        part = _by_name(smooth + residual, columns)
        surface_offset = _by_name(smooth, columns)["offset"]
        tilt = 0.8 * torch.tanh(part["normal"]) if self.config.learned_normals else 0.0
        normals = nn.functional.normalize(self.rest_normals + tilt, dim=-1)
        tangents, across = part["scale"].split([2, 1], dim=-1)
        scales = torch.cat([_log_uniform(tangents, TANGENT_SCALE), _log_uniform(across, NORMAL_SCALE)], dim=-1)
        offset = self.config.max_static_offset * torch.tanh(surface_offset) + self.residual_offset()
        low, high = ALBEDO_RANGE
        glossy, rough = ROUGHNESS_RANGE
        return Attributes(
            opacity=torch.sigmoid(part["opacity"][:, 0] + INITIAL_RAW_OPACITY),
            rotation=torch.tanh(part["rotation"]),
            scales=self.spacing * scales,
            normals=normals,
            points=self.points + offset,
            colour=torch.sigmoid(part["colour"]),
            albedo=low + (high - low) * torch.sigmoid(part["albedo"] - 1.0),  # initially 0.22
            roughness=glossy + (rough - glossy) * torch.sigmoid(part["roughness"][:, 0] + 0.5),
            raw_geometry_residual=self.geometry_residual,
        )

    def residual_offset(self) -> Tensor:
        """Offset [N, 3] m of each Gaussian from the surface, by its residual."""
        return self.spacing * torch.tanh(_by_name(self.geometry_residual, GEOMETRY_COLUMNS)["offset"])

    def forward(self, pose: PoseInput) -> PosedGaussians:
        """Pose the avatar."""
        return self.placed(self.fields(pose), pose.bones)

    def fields(self, pose: PoseInput) -> PoseFields:
        """What the networks say of a pose."""
        encoded = self.encoded_nodes()
        nodes = len(encoded)
        static = self.attributes(encoded)
        current = pose.window[-1].flatten()
        logits = (
            self.skinning(encoded, pose.window, pose.velocity)
            if self.config.dynamic_skinning
            else torch.zeros_like(self.log_weights[:nodes])
        )
        node_normals = self._node_normals(static.normals[:nodes].detach(), pose.bones.detach())
        visibility_pose = current if self.config.visibility == "pose" else torch.zeros_like(current)
        fields = torch.cat(
            [logits, self.offsets(encoded, current), self.visibility(encoded, visibility_pose, node_normals)], dim=-1
        )
        logits, offset, rotation, visibility = self.interpolate(fields).split([logits.shape[1], 3, 3, 16], dim=-1)
        weights = torch.softmax(self.log_weights + logits, dim=-1)
        return PoseFields(static, weights, torch.tanh(offset), torch.tanh(rotation), visibility)

    def placed(self, fields: PoseFields, bones: Tensor) -> PosedGaussians:
        """Gaussians of ``fields`` moved by ``bones`` [J, 3, 4], which may differ a little from their pose's."""
        static = fields.attributes
        means, upper, normals = pose_gaussians(
            fields.weights,
            bones,
            static.points + self.config.max_offset * fields.offset,
            fields.rotation,
            self.tangents,
            static.rotation,
            static.scales,
            static.normals,
            TwistFrames(self.limb_axes, self.limb_levers, self.limb_shares),
        )
        return PosedGaussians(
            means=means,
            covariances=upper,
            normals=normals,
            visibility=fields.visibility,
            weights=fields.weights,
            offset=fields.offset,
            attributes=static,
        )

    def _node_normals(self, normals: Tensor, bones: Tensor) -> Tensor:
        """Posed normals of the nodes [M, 3] in the root's frame, by the template's skinning."""
        weights = torch.softmax(self.log_weights[: len(normals)], dim=-1)
        return transform_normals(blend_transforms(weights, bones), normals) @ bones[0, :, :3]


def _by_name(values: Tensor, columns: dict[str, int]) -> dict[str, Tensor]:
    """[N, C] split into named columns."""
    return dict(zip(columns, values.split(list(columns.values()), dim=-1)))


def _log_uniform(raw: Tensor, bounds: tuple[float, float]) -> Tensor:
    """Log-uniform within ``bounds``; the geometric mean at raw = 0."""
    low, high = bounds
    return low * (high / low) ** torch.sigmoid(raw)
