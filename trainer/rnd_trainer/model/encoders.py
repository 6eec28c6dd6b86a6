"""The paper's networks: attribute encoders D_g and D_a, dynamic skinning D_W, offsets Δx and Δr, visibility.

All are evaluated at M nodes of the template. The exporter bakes their position branches.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

VELOCITY_SCALE = 0.1
"""scale of joint velocities (rad/s) in tanh: linear for human motion"""
SH_DC_OF_ONE = 2.0 * math.sqrt(math.pi)
"""SH coefficient of Y_00 of the constant 1"""


def positional_encoding(x: Tensor, frequencies: int) -> Tensor:
    """[..., 3] m → [..., 3 + 6·frequencies]: x, then sin and cos of 2^k π x (Mildenhall et al. 2020, eq. 4)."""
    bands = math.pi * 2.0 ** torch.arange(frequencies, device=x.device, dtype=x.dtype)
    angles = x[..., None, :] * bands[:, None]
    return torch.cat([x, angles.sin().flatten(-2), angles.cos().flatten(-2)], dim=-1)


def encoded_size(frequencies: int) -> int:
    """Columns of ``positional_encoding``."""
    return 3 + 6 * frequencies


class PositionEncoder(nn.Module):
    """f_x: encoded positions [M, E] → features [M, width]."""

    def __init__(self, inputs: int, width: int) -> None:
        super().__init__()
        self.hidden = nn.Linear(inputs, width)
        self.out = nn.Linear(width, width)

    def forward(self, encoded: Tensor) -> Tensor:
        return torch.relu(self.out(torch.relu(self.hidden(encoded))))


class AttributeEncoder(nn.Module):
    """D_g or D_a: encoded positions [M, E] → raw attributes [M, outputs]; initially zero."""

    def __init__(self, inputs: int, width: int, outputs: int) -> None:
        super().__init__()
        self.first, self.hidden = nn.Linear(inputs, width), nn.Linear(width, width)
        self.out = nn.Linear(width, outputs)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def forward(self, encoded: Tensor) -> Tensor:
        return self.out(torch.relu(self.hidden(torch.relu(self.first(encoded)))))


class JointAttention(nn.Module):
    """Self-attention over joint tokens, then cross-attention from positions to the joints.

    Args of ``forward``: tokens [J', inputs] of one window, queries f_x [M, width]. Returns [M, width].
    """

    def __init__(self, inputs: int, joints: int, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.embed = nn.Linear(inputs, width)
        self.joint = nn.Parameter(0.02 * torch.randn(joints, width))
        self.norm = nn.LayerNorm(width)
        self.self_qkv = nn.Linear(width, 3 * width)
        self.self_out = nn.Linear(width, width)
        self.query = nn.Linear(width, width)
        self.key_value = nn.Linear(width, 2 * width)
        self.out = nn.Linear(width, width)

    def forward(self, tokens: Tensor, features: Tensor) -> Tensor:
        tokens = self.embed(tokens) + self.joint
        query, key, value = self.self_qkv(self.norm(tokens)).chunk(3, dim=-1)
        tokens = tokens + self.self_out(self._attend(query, key, value))
        key, value = self.key_value(tokens).chunk(2, dim=-1)
        return self.out(self._attend(self.query(features), key, value))

    def _attend(self, query: Tensor, key: Tensor, value: Tensor) -> Tensor:
        """Scaled dot-product attention with heads side by side: [Q, width], [J', width] twice → [Q, width]."""
        q, k, v = (t.unflatten(-1, (self.heads, -1)).transpose(0, 1) for t in (query, key, value))
        scores = q @ k.transpose(1, 2) / math.sqrt(q.shape[-1])  # [heads, Q, J']
        return (scores.softmax(dim=-1) @ v).transpose(0, 1).flatten(1)


class DynamicSkinning(nn.Module):
    """D_W: offsets of the skinning weights' logits from a motion window; initially zero.

    ``forward(encoded [M, E], window [d, J−1, 6], velocity [J−1, 3] rad/s) → [M, J]``. Tokens of the temporal branch are
    each joint's d poses, of the spatial branch its velocity (paper, section 3.2). ``temporal=False`` is an ablation.
    """

    def __init__(self, inputs: int, joints: int, poses: int, width: int, heads: int, temporal: bool = True) -> None:
        super().__init__()
        self.position = PositionEncoder(inputs, width)
        self.temporal = JointAttention(6 * poses, joints - 1, width, heads) if temporal else None
        self.spatial = JointAttention(3, joints - 1, width, heads)
        self.merge = nn.Linear((3 if temporal else 2) * width, width)
        self.hidden = nn.Linear(width, width)
        self.logits = nn.Linear(width, joints)
        nn.init.zeros_(self.logits.weight)
        nn.init.zeros_(self.logits.bias)

    def forward(self, encoded: Tensor, window: Tensor, velocity: Tensor) -> Tensor:
        f_x = self.position(encoded)
        branches = [self.spatial(torch.tanh(VELOCITY_SCALE * velocity), f_x), f_x]
        if self.temporal is not None:
            branches.insert(0, self.temporal(window.transpose(0, 1).flatten(1), f_x))
        merged = torch.relu(self.merge(torch.cat(branches, dim=-1)))
        return self.logits(torch.relu(self.hidden(merged)))


class PoseConditioned(nn.Module):
    """MLP of position, current pose and extra input, for offsets and visibility; initially zero.

    ``forward(encoded [M, E], pose [6·(J−1)], extra [M, extras] | None) → [M, outputs]``. The first layer is a
    sum of a position part, a pose part and an extra part.
    """

    def __init__(self, inputs: int, joints: int, width: int, outputs: int, extras: int = 0) -> None:
        super().__init__()
        self.position = PositionEncoder(inputs, width)
        self.from_position = nn.Linear(width, width)
        self.code = nn.Linear(6 * (joints - 1), width)
        self.from_code = nn.Linear(width, width, bias=False)
        self.from_extra = nn.Linear(extras, width, bias=False) if extras else None
        self.hidden = nn.Linear(width, width)
        self.out = nn.Linear(width, outputs)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def forward(self, encoded: Tensor, pose: Tensor, extra: Tensor | None = None) -> Tensor:
        first = self.from_position(self.position(encoded)) + self.from_code(torch.relu(self.code(pose)))
        if self.from_extra is not None:
            first = first + self.from_extra(extra)
        return self.out(torch.relu(self.hidden(torch.relu(first))))


class Visibility(PoseConditioned):
    """v: 16 SH coefficients of visibility in the root's frame, from x_c, the posed normal and the pose.

    Initially 1 in all directions. The paper's network has no pose input.
    """

    def __init__(self, inputs: int, joints: int, width: int) -> None:
        super().__init__(inputs, joints, width, outputs=16, extras=3)
        with torch.no_grad():
            self.out.bias[0] = SH_DC_OF_ONE
