"""Configuration of a training: model, schedule, rates and loss weights."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, Literal

from rnd_runtime.core.errors import InputError, check_option

MAX_NODES = 1_875
"""spacing 3 cm on a body; twice as many gain less than 0.1 dB held out, 0.14 dB relit, and double the networks' time"""
NODE_SHARE = 8
"""Gaussians per node, below ``MAX_NODES``"""


@dataclass(frozen=True)
class ModelConfig:
    """Size and variant of the avatar; stored in the checkpoint to rebuild the networks."""

    gaussians: int = 30_000
    """Gaussians on the template's surface; no densification or pruning"""
    nodes: int = MAX_NODES
    """points at which the networks are evaluated; Gaussians interpolate between them"""
    window_poses: int = 10
    """d, poses in the motion window; 20 gain little over 10 (the paper's ablation)"""
    window_seconds: float = 0.3
    """time span of the window, independent of the motion's frame rate"""
    width: int = 64
    """width of the attention and of the hidden layers"""
    heads: int = 2
    """attention heads; four give the same scores"""
    frequencies: int = 7
    """bands of the positional encoding; the 8th exceeds the Nyquist limit of 8 mm spacing"""
    attribute_width: int = 96
    """hidden width of the attribute encoders D_g and D_a"""
    max_offset: float = 0.06
    """bound of the pose-dependent offset Δx, m"""
    max_static_offset: float = 0.12
    """bound of the static offset from the unclothed template (hair, loose cloth), m"""
    dynamic_skinning: bool = True
    """False: the template's weights (the paper's static baseline)"""
    motion_encoder: Literal["full", "spatial"] = "full"
    """'spatial': no temporal attention (the paper's ablation)"""
    visibility: Literal["pose", "paper", "none"] = "pose"
    """'paper': from x_c and the normal, towards the camera; 'none': no shadows. Ablations, not exported"""
    learned_normals: bool = True
    """False: the template's normals (ablation)"""


@dataclass(frozen=True)
class TrainConfig:
    """Schedule, losses and rates; see ``preset``."""

    model: ModelConfig = dataclasses.field(default_factory=ModelConfig)
    steps: int = 2_400
    """optimisation steps of one image each"""
    stage1_fraction: float = 0.15
    """share of the steps with a plain colour per Gaussian, before albedo and light"""
    unseen_fraction: float = 0.75
    """additional steps in unseen poses, as a share of ``steps``; a third more cost 0.06 dB under other lights"""
    image_scale: float = 1.0
    """scale of the training images"""
    seed: int = 0
    """seed of all random numbers"""
    light: Literal["learn", "capture", "none"] = "learn"
    """'capture': the capture's light map (oracle); 'none': plain colours to the end, an avatar that cannot be relit"""
    normals: Literal["estimated", "true"] = "estimated"
    """'true': the capture's exact normals (oracle)"""
    probe_channels: Literal[1, 3] = 3
    """1: a grey light, as in the paper"""
    skin: int | None = None
    """Fitzpatrick type 1 to 6 of the skin, which fixes the level of albedo and light; None: by likelihood"""
    light_search: bool = True
    """initialise the probe with a least-squares sky and directional lights; False: white"""
    rate_networks: float = 2e-3
    """initial learning rate of the networks' biases and norms, by Adam"""
    rate_matrices: float = 4e-3
    """of their matrices, by SOAP"""
    rate_residuals: float = 3e-2
    """of the per-Gaussian residuals; half of it raises LPIPS, four times as much loses 0.2 dB"""
    rate_light: float = 1e-2
    """of the probe's log radiance"""
    rate_final: float = 0.5
    """factor on all rates at the last image, reached exponentially; 0.1 loses 0.5 dB at a quarter of the steps"""
    rate_cooled: float = 0.15
    """further factor, reached over the last ``cooling_fraction`` of the steps"""
    cooling_fraction: float = 0.15
    """share of the steps over which ``rate_cooled`` applies"""

    weight_dssim: float = 0.2
    """1 − SSIM, beside L1 on the image"""
    dssim_scales: int = 3
    """scales over which 1 − SSIM is averaged where there is no perceptual network"""
    weight_lpips: float = 0.05
    """LPIPS; four times as much lowers held-out LPIPS by 1 % and costs 0.1 to 0.3 dB"""
    lpips_every: int = 2
    """steps between evaluations of LPIPS, which cost as much as the rest of a step"""
    weight_consistency: float = 0.002
    """L_gc"""
    consistency_every: int = 8
    """steps between evaluations of L_gc, which render a second image"""
    weight_mask: float = 0.5
    """L1 between alpha and the mask"""
    weight_normal: float = 0.1
    """λ_n, L1 between splatted and estimated normals; estimates err by about 10°"""
    weight_tilt: float = 0.1
    """mean square of the normals' tilt from the template's, where an image has no estimated normals"""
    weight_albedo_estimate: float = 0.008
    """L1 of the log ratio of splatted and estimated albedo; of estimates that keep a fifth of the shading it gains
    0.14 dB of albedo, four times as much loses 0.25 dB"""
    weight_skinning: float = 1e-2
    """KL(W ‖ W_template); decays to a tenth over the run"""
    weight_edges: float = 400.0
    """edge stretch in unseen poses, beside the distillation in mm²; a quarter of it stretches a squat more and
    leaves held-out scores as they are"""
    weight_smooth: float = 3e4
    """smoothness of skinning weights over jittered unseen poses; without it some avatars flicker in slow motion"""
    weight_offset: float = 2.0
    """mean square of Δx in units of its bound"""
    weight_residual: float = 0.02
    """mean square of the geometric residuals; ten times as much gains 0.1 dB in novel views and loses 0.2 dB relit"""
    weight_repulsion: float = 0.02
    """repulsion of pairs of Gaussians nearer than ``least_distance``"""
    least_distance: float = 0.5
    """in units of the spacing"""
    repulsion_every: int = 8
    """steps between evaluations of the repulsion, which builds a k-d tree"""
    weight_visibility: float = 0.2
    """square error of the SH visibility against traced visibility"""
    weight_light_chroma: float = 0.1
    """chroma of the probe in every direction, relative to the light search's"""
    weight_light_sky: float = 0.03
    """robust distance of the probe from a natural sky"""

    black_backgrounds: float = 0.5
    """share of the steps over black, the rest over random colours; with 0 LPIPS is 2 % higher"""
    light_texels: int = 128
    """texels of the probe sampled per step, by luminance × solid angle"""
    traced_texels: int = 4
    """brightest sampled texels, whose shadows are traced instead of evaluated from SH coefficients"""
    full_light_fraction: float = 0.05
    """share of the steps, at the end, that sum over all texels"""
    visibility_directions: int = 12
    """directions per step in which visibility is traced to supervise its network"""
    pose_noise: float = 0.05
    """standard deviation of the noise on the encoders' input poses, rad"""

    hold_out: bool = False
    """leave every fifth training frame out, as the split ``validation``"""
    refine_poses: bool = False
    """correct the capture's body poses while training"""
    refine_after: float = 0.08
    """share of the steps before poses are corrected"""
    rate_poses: float = 3e-3
    """learning rate of pose corrections, rad and m; half or twice as much loses 0.2 to 0.3 dB"""
    weight_poses: float = 1e-3
    """mean square correction in units of its bounds"""

    preview_every: int = 500
    """steps between previews"""
    save_every: int = 500
    """steps between saved states"""


def preset(name: str) -> TrainConfig:
    """The configuration named ``quick``, ``standard`` or ``full``."""
    standard = TrainConfig()
    if name == "standard":
        return standard
    if name == "full":
        return dataclasses.replace(standard, steps=5 * standard.steps, rate_final=0.1, rate_cooled=1.0)
    if name == "quick":
        quick = resized(standard, 12_000, 600)
        return dataclasses.replace(quick, preview_every=200, save_every=200)
    raise InputError("preset", expected="quick, standard or full", got=name)


def nodes_for(gaussians: int) -> int:
    """Number of nodes for a number of Gaussians."""
    return max(16, min(gaussians // NODE_SHARE, MAX_NODES))


def resized(config: TrainConfig, gaussians: int | None, steps: int | None) -> TrainConfig:
    """``config`` with another number of Gaussians, their nodes, and steps; None keeps a value."""
    model = config.model
    if gaussians is not None:
        model = dataclasses.replace(model, gaussians=gaussians, nodes=nodes_for(gaussians))
    return dataclasses.replace(config, model=model, steps=config.steps if steps is None else steps)


def check_sizes(config: TrainConfig) -> None:
    """Raise ``InputError``, naming the option, for a size that cannot be trained."""
    gaussians, scale = config.model.gaussians, config.image_scale
    check_option(config.steps >= 1, "--steps", "at least 1", config.steps)
    check_option(0 < scale <= 1, "--image-scale", "more than 0, at most 1", scale)
    check_option(64 <= gaussians <= 1_000_000, "--gaussians", "64 to 1000000", gaussians)


def to_dict(config: TrainConfig) -> dict[str, Any]:
    """The configuration as plain JSON values."""
    return dataclasses.asdict(config)


def from_dict(values: dict[str, Any]) -> TrainConfig:
    """Rebuild a configuration of this version or an earlier one: fields that are missing get their defaults.

    Raises ``InputError`` for an unknown field.
    """
    return _build(TrainConfig, {**values, "model": _build(ModelConfig, values["model"])})


def _build(kind: Any, values: dict[str, Any]) -> Any:
    if unknown := sorted(set(values) - {field.name for field in dataclasses.fields(kind)}):
        raise InputError("configuration", expected=f"the fields of {kind.__name__}", got=f"others: {unknown}")
    return kind(**values)
