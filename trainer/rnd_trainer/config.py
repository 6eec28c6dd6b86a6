"""Every number that a training depends on, with its reason, in one frozen dataclass."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, Literal

from rnd_runtime.core.errors import InputError, check_option

MAX_NODES = 1_875
"""3 cm apart on a body, over which what the networks say is smooth. Twice as many gain less than 0.1 dB in held-out
pictures, 0.14 at most under other lights, and networks take twice as long (docs/tried.md)"""
NODE_SHARE = 8
"""Gaussians to each node, where that makes fewer"""


@dataclass(frozen=True)
class ModelConfig:
    """What the avatar is made of; stored in the checkpoint, since it says how to rebuild the networks."""

    gaussians: int = 30_000
    """Gaussians on the template's surface; fixed, nothing is densified or pruned"""
    nodes: int = MAX_NODES
    """points at which the networks are evaluated; the Gaussians interpolate between them (smooth quantities)"""
    window_poses: int = 10
    """d: poses in the motion window (the paper's ablation: 20 gains little over 10)"""
    window_seconds: float = 0.3
    """time that the window spans, so that a 120 fps file and its 30 fps copy give the same pose"""
    width: int = 64
    """width of the attention and of the hidden layers; the query side is baked, so it costs little at playback"""
    heads: int = 2
    """attention heads: with four every figure is the same (docs/tried.md)"""
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
    motion_encoder: Literal["full", "spatial"] = "full"
    """'spatial': no temporal attention, the paper's ablation"""
    visibility: Literal["pose", "paper", "none"] = "pose"
    """'paper': of x_c and the normal, at the direction to the camera; 'none': no shadows. Ablations, not exported"""
    learned_normals: bool = True
    """False: the template's normals (mesh-normal shading, an ablation)"""


@dataclass(frozen=True)
class TrainConfig:
    """Schedule, losses and rates. `preset()` gives the three that are offered."""

    model: ModelConfig = dataclasses.field(default_factory=ModelConfig)
    steps: int = 6_000
    """optimisation steps, one picture each: 20 to 25 minutes on two cores"""
    stage1_fraction: float = 0.25
    """share of the steps spent on geometry with a plain colour before the light is learned"""
    unseen_fraction: float = 0.375
    """as many steps more, by this share of them, without pictures: skinning learns unseen poses. A half
    costs 0.06 dB more under other lights (quick has it: a thousand steps)"""
    image_scale: float = 1.0
    """training pictures are shrunk by this factor"""
    seed: int = 0
    """of every random draw"""
    light: Literal["learn", "capture", "none"] = "learn"
    """'capture': the capture's own light map, an oracle that tells what the learned light costs; 'none': plain
    colours to the end, as avatars that cannot be relit are trained"""
    normals: Literal["estimated", "true"] = "estimated"
    """'true': the capture's exact normals, an oracle"""
    probe_channels: Literal[1, 3] = 3
    """1: a grey light, as printed in the paper"""

    light_search: bool = True
    """start the second stage from a sky and suns found by least squares, instead of from a white probe"""

    rate_networks: float = 2e-3
    """Adam's step for the networks, at the start"""
    rate_residuals: float = 3e-2
    """Adam's step for the per-Gaussian residuals. Half of it leaves LPIPS higher, twice as much loses 0.2 dB
    (docs/tried.md)"""
    rate_light: float = 1e-2
    """Adam's step for the logarithms of the probe's texels"""
    rate_final: float = 0.5
    """share of all rates that is left at the last picture, falling exponentially. A tenth, as it was, ends a training
    before it has learned what it could: half a dB at a quarter of the steps (docs/tried.md)"""
    rate_cooled: float = 0.15
    """what is left of that after the last steps, over which rates fall once more: large ones leave noise"""
    cooling_fraction: float = 0.15
    """share of the steps that are these"""

    weight_dssim: float = 0.2
    """of 1 − SSIM beside L1, in image terms"""
    dssim_scales: int = 3
    """halvings over which 1 − SSIM is averaged where there is no perceptual network"""
    weight_lpips: float = 0.05
    """of LPIPS, with --perceptual-weights: four times as much takes a quarter off it in training pictures, a hundredth
    in held-out ones, and costs 0.1 to 0.3 dB"""
    lpips_every: int = 2
    """steps between evaluations of LPIPS: it costs as much as everything else in a step"""
    weight_consistency: float = 0.002
    """of L_gc, with --perceptual-weights"""
    consistency_every: int = 8
    """steps between evaluations of L_gc: a second picture and two feature stacks"""
    weight_mask: float = 0.5
    """of L1 between alpha and the mask"""
    weight_normal: float = 0.1
    """λ_n, of L1 between splatted and estimated normals: estimates err by about 10 degrees, so it must not rule"""
    weight_skinning: float = 1e-2
    """of KL(W ‖ W_template); decays to a tenth over the run"""
    weight_edges: float = 400.0
    """of the stretch of skin between bones in unseen poses, beside the mean square in mm that skin moves in
    filmed ones: in the third stage alone. With a quarter of it a squat stretches more (P1 in docs/stability.md), and
    held-out pictures are no better"""
    weight_smooth: float = 3e4
    """of the mean square change of such skin's weights where a pose hardly changes, in the third stage alone: without
    it some trainings flicker in slow motion (P9 in docs/stability.md)"""
    weight_offset: float = 2.0
    """of the mean square of Δx in units of its bound"""
    weight_residual: float = 0.02
    """of the mean square of the geometric residuals: an unseen Gaussian follows its neighbours. Ten times as much gains
    0.1 dB in novel views and loses 0.2 under other lights"""
    weight_repulsion: float = 0.02
    """of pairs of Gaussians that lie nearer than ``least_distance``"""
    least_distance: float = 0.5
    """spacings between two Gaussians below which they repel one another"""
    repulsion_every: int = 8
    """steps between evaluations of the repulsion: finding the pairs takes a k-d tree"""
    weight_visibility: float = 0.2
    """of the traced visibility's square error"""
    weight_light_grey: float = 0.02
    """of the chroma of the probe as a whole: white light on average"""

    weight_light_sky: float = 0.03
    """of the distance from a natural sky, sun apart: what lights the side that is never seen is like the rest"""

    black_backgrounds: float = 0.5
    """share of the steps over black, where an outline drawn too wide shows most; the rest over random colours, which
    what is opaque must hide. None: LPIPS 2 % higher, everything else within the spread of the seeds"""

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

    refine_poses: bool = False
    """correct the capture's body poses while training"""
    refine_after: float = 0.08
    """share of the steps before poses may move: the first shape is too rough to correct anything by"""
    rate_poses: float = 1.5e-3
    """Adam's step for pose corrections, radians and metres, at each look at a frame"""
    weight_poses: float = 1e-3
    """of the mean square correction in units of its bounds"""

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
        # over so many steps the standard's high rates are worse: 34.67 dB and LPIPS .0156, not 34.77 and .0147
        return dataclasses.replace(standard, steps=5 * standard.steps, rate_final=0.1, rate_cooled=1.0)
    if name == "quick":
        quick = resized(standard, 12_000, 2_000)
        return dataclasses.replace(quick, unseen_fraction=0.5, preview_every=250, save_every=250)
    raise InputError("preset", expected="quick, standard or full", got=name)


def nodes_for(gaussians: int) -> int:
    """At how many nodes the networks of so many Gaussians are evaluated."""
    return max(16, min(gaussians // NODE_SHARE, MAX_NODES))


def resized(config: TrainConfig, gaussians: int | None, steps: int | None) -> TrainConfig:
    """``config`` with another number of Gaussians (and the nodes for them) and of steps, where given."""
    model = config.model
    if gaussians is not None:
        model = dataclasses.replace(model, gaussians=gaussians, nodes=nodes_for(gaussians))
    return dataclasses.replace(config, model=model, steps=config.steps if steps is None else steps)


def check_sizes(config: TrainConfig) -> None:
    """Raise ``InputError``, naming the option, where a training cannot be of that size."""
    gaussians, scale = config.model.gaussians, config.image_scale
    check_option(config.steps >= 1, "--steps", "at least 1", config.steps)
    check_option(0 < scale <= 1, "--image-scale", "more than 0, at most 1", scale)
    check_option(64 <= gaussians <= 1_000_000, "--gaussians", "64 to 1000000", gaussians)


def to_dict(config: TrainConfig) -> dict[str, Any]:
    """The configuration as plain JSON values."""
    return dataclasses.asdict(config)


def from_dict(values: dict[str, Any]) -> TrainConfig:
    """Rebuild a configuration. Raises ``InputError`` for an unknown or a missing field."""
    return _build(TrainConfig, {**values, "model": _build(ModelConfig, values["model"])})


def _build(kind: Any, values: dict[str, Any]) -> Any:
    wrong = sorted(set(values) ^ {field.name for field in dataclasses.fields(kind)})
    if wrong:
        raise InputError("configuration", expected=f"the fields of {kind.__name__}", got=f"others: {wrong}")
    return kind(**values)
