"""Every number that a training depends on, with its reason, in one frozen dataclass."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, Literal

from rnd_runtime.errors import InputError


@dataclass(frozen=True)
class ModelConfig:
    """What the avatar is made of; stored in the checkpoint, since it says how to rebuild the networks."""

    gaussians: int = 30_000
    """Gaussians on the template's surface; fixed, nothing is densified or pruned"""
    nodes: int = 7_500
    """points at which the networks are evaluated; the Gaussians interpolate between them (smooth quantities)"""
    window_poses: int = 10
    """d: poses in the motion window (the paper's ablation: 20 gains little over 10)"""
    window_seconds: float = 0.3
    """time that the window spans, so that a 120 fps file and its 30 fps copy give the same pose"""
    width: int = 64
    """width of the attention and of the hidden layers; the query side is baked, so it costs little at playback"""
    heads: int = 4
    """attention heads"""
    frequencies: int = 7
    """bands of the positional encoding; the 8th lies past the Nyquist limit of 8 mm spacing"""
    attribute_width: int = 96
    """hidden width of the attribute encoders D_g and D_a"""
    max_offset: float = 0.06
    """bound of the pose-dependent offset Δx, metres"""
    max_static_offset: float = 0.12
    """bound of a Gaussian's offset from the unclothed template (hair, loose cloth), metres"""
    dynamic_skinning: bool = True
    """False: the template's weights, the paper's static baseline"""


@dataclass(frozen=True)
class TrainConfig:
    """Schedule, losses and rates. `preset()` gives the three that are offered."""

    model: ModelConfig = dataclasses.field(default_factory=ModelConfig)
    steps: int = 4_500
    """optimisation steps, one picture each"""
    stage1_fraction: float = 0.25
    """share of the steps spent on geometry with a plain colour before the light is learned"""
    image_scale: float = 1.0
    """training pictures are shrunk by this factor"""
    seed: int = 0
    """of every random draw"""
    light: Literal["learn", "capture"] = "learn"
    """'capture' trains under the capture's own light map: an oracle that tells what the learned light costs"""

    rate_networks: float = 2e-3
    """Adam's step for the networks; decays to a tenth"""
    rate_residuals: float = 1.5e-2
    """Adam's step for the per-Gaussian residuals; decays to a tenth"""
    rate_light: float = 3e-2
    """Adam's step for the probe's texels (before softplus)"""

    weight_dssim: float = 0.2
    """of 1 − SSIM beside L1, in image terms"""
    weight_mask: float = 0.5
    """of L1 between alpha and the mask"""
    weight_normal: float = 0.1
    """λ_n, of L1 between splatted and estimated normals: estimates err by about 10 degrees, so it must not rule"""
    weight_skinning: float = 1e-2
    """of KL(W ‖ W_template); decays to a tenth over the run"""
    weight_offset: float = 2.0
    """of the mean square of Δx in units of its bound"""
    weight_residual: float = 0.02
    """of the mean square of the geometric residuals: an unseen Gaussian follows its neighbours"""
    weight_visibility: float = 0.2
    """of the traced visibility's square error"""
    weight_light_grey: float = 0.01
    """of the probe's chroma: a white light unless the pictures say otherwise"""

    light_texels: int = 128
    """texels of the probe drawn for a step, by luminance × solid angle"""
    traced_texels: int = 4
    """brightest drawn texels whose shadows are traced instead of read from the spherical harmonics"""
    full_light_fraction: float = 0.05
    """share of the last steps that sum over all texels"""
    visibility_directions: int = 12
    """directions a step in which visibility is traced to supervise its network"""
    pose_noise: float = 0.05
    """radians of noise on the encoders' input poses: they must not memorise the frames"""

    preview_every: int = 500
    """steps between preview pictures"""
    save_every: int = 500
    """steps between saved states"""


def preset(name: str) -> TrainConfig:
    """The offered schedules: `quick` for a look, `standard` for use, `full` when time does not matter."""
    standard = TrainConfig()
    if name == "standard":
        return standard
    if name == "full":
        return dataclasses.replace(standard, steps=5 * standard.steps)
    if name == "quick":
        small = dataclasses.replace(standard.model, gaussians=12_000, nodes=3_000)
        return dataclasses.replace(standard, model=small, steps=2_500, preview_every=250, save_every=250)
    raise InputError("preset", expected="quick, standard or full", got=name)


def to_dict(config: TrainConfig) -> dict[str, Any]:
    """The configuration as plain JSON values."""
    return dataclasses.asdict(config)


def from_dict(values: dict[str, Any]) -> TrainConfig:
    """Rebuild a configuration; an unknown or missing field is an error, never a default."""
    return _build(TrainConfig, {**values, "model": _build(ModelConfig, values.get("model", {}))})


def _build(kind: Any, values: dict[str, Any]) -> Any:
    known = {field.name for field in dataclasses.fields(kind)}
    if set(values) != known:
        wrong = sorted(set(values) ^ known)
        raise InputError(
            "configuration", expected=f"the fields of {kind.__name__}", got=f"{wrong} unknown or missing"
        )
    return kind(**values)
