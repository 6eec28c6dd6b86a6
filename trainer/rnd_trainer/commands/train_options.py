"""The options of ``rnd-train``; each comment is the option's help."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from rnd_runtime.cli.command import Count, Flag, Folder, OptionalCount, OptionalFile, OptionalNumber, group, option
from rnd_runtime.cli.jobs import On


@dataclass(frozen=True)
class Schedule:
    """Schedule and device."""

    preset: Literal["quick", "standard", "full"] = "standard"
    """Some two and a half minutes, ten minutes, or an hour on two cores."""
    steps: OptionalCount = None
    """Steps with an image. Default: 2400 (quick: 600, full: 12000). The third stage adds 3/4 as many short steps."""
    gaussians: OptionalCount = None
    """Number of Gaussians. Default: 30000 (quick: 12000), also of full."""
    image_scale: OptionalNumber = None
    """Size of the training images over that of the capture's, such as 0.5. Default: the preset's."""
    save_every: OptionalCount = None
    """Steps between saved states, from which --resume continues. Default: the preset's."""
    seed: Count = 0
    """Seed of all random numbers."""
    device: Annotated[str, option("cpu|cuda[:N]")] = "cpu"
    """cuda trains on a GPU with gsplat as the rasteriser (extra [cuda])."""


@dataclass(frozen=True)
class Learning:
    """Losses, poses and motion."""

    perceptual_weights: OptionalFile = None
    """AlexNet, SqueezeNet or VGG16 (.safetensors or .pth): adds the LPIPS and consistency losses."""
    consistency_weights: OptionalFile = None
    """Another of them, or its first blocks, for the consistency loss."""
    unseen_poses: bool = True
    """Teach the skinning out-of-distribution poses after the images."""
    hold_out: Flag = False
    """Leave every fifth training frame out and score those alone: what choices are made by."""
    skin: OptionalCount = None
    """Tone of the skin, 1 (palest) to 6 (darkest) by Fitzpatrick: how bright albedo is against light."""
    hdr: OptionalFile = None
    """Light probe of the place where the images were taken, .exr or .hdr: its yaw and exposure are found."""
    grey_card: Annotated[str | None, option("FRAME:X,Y")] = None
    """A pixel of a training image that shows an 18 % grey card: fixes colour and level of the light."""
    refine_poses: Flag = False
    """Correct the capture's body poses while training, as always those of a video; writes refined_motion.npz."""
    motion: Annotated[str | None, option("FILE")] = None
    """Another motion file of the capture."""


@dataclass(frozen=True)
class Ablations:
    """Oracles and ablations, for studies."""

    light: Literal["learn", "capture", "none"] = "learn"
    """capture: under the capture's own light map; none: plain colours, an avatar that cannot be relit."""
    normals: Literal["estimated", "true"] = "estimated"
    """true: the capture's exact normals."""
    probe_channels: Literal[1, 3] = 3
    """1: a grey light."""
    visibility: Literal["pose", "paper", "none"] = "pose"
    """paper: visibility towards the camera, as printed; none: no shadows. Not exported."""


@dataclass(frozen=True)
class TrainOptions:
    """Learn an avatar from one monocular capture, or from a video of one person.

    rnd-train me.mp4 --out runs/me
    """

    capture: Annotated[tyro.conf.Positional[Path], option("CAPTURE|VIDEO")]
    """Folder with capture.json; a video is first imported into OUT/capture."""
    more: Annotated[tyro.conf.Positional[tuple[Path, ...]], option("CAPTURE|VIDEO ...")] = ()
    """More of them: each is trained into OUT/NAME."""
    out: Folder = Path("runs/avatar")
    """Folder for avatar.ckpt, previews/, metrics.jsonl, status.json and config.json."""
    resume: Flag = False
    """Continue a stopped training in OUT; of several, begin those that have not begun."""
    skip_existing: Flag = False
    """Leave out captures whose training has finished."""
    on: On = None
    """Train on N processes of this machine, or on the workers of a Dask scheduler (extra [dask])."""
    schedule: Annotated[Schedule, *group("schedule")] = field(default_factory=Schedule)
    learning: Annotated[Learning, *group("learning")] = field(default_factory=Learning)
    ablations: Annotated[Ablations, *group("oracles and ablations")] = field(default_factory=Ablations)
