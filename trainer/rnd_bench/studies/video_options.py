"""The options of the studies of videos."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from rnd_runtime.cli.command import Count, Flag, Number, OptionalFile, option


@dataclass(frozen=True)
class Video:
    """Fit a body to rendered people's videos and to real calibrated cameras, each by itself; score against the truth.

    rnd-bench study video out/video --capture ../shared/data/capture --video dancer.mp4 --json out/video.json
    """

    out: Annotated[Path, tyro.conf.Positional, option("FOLDER")]
    """folder for observations"""
    capture: Annotated[tuple[Path, ...], option("FOLDER ...")]
    """captures of rendered people"""
    video: Annotated[tuple[Path, ...], option("FILE ...")]
    """a video of the training frames of each, one for one"""
    real: Annotated[Path | None, option("FOLDER")] = None
    """Pose2Sim's folder Demo_SinglePerson: adds its cameras 01 and 03"""
    json: OptionalFile = None
    """write the rows here"""


@dataclass(frozen=True)
class Filmed:
    """Train avatars of videos alone, and score them on images that no video showed.

    rnd-bench study filmed out/filmed --clip me.mp4
    """

    out: Annotated[Path, tyro.conf.Positional, option("FOLDER")]
    """folder for captures, runs and strips; what is done is not done again"""
    capture: Annotated[Path | None, option("FOLDER")] = None
    """capture of a rendered person, with --video"""
    video: OptionalFile = None
    """video of its training frames, one for one: its avatar is scored on the capture's other frames, in exact poses"""
    real: Annotated[Path | None, option("FOLDER")] = None
    """Pose2Sim's folder Demo_SinglePerson: its cameras 01 and 03, each scored on the three other cameras"""
    clip: OptionalFile = None
    """video of anybody: its last fifth is scored, its poses fitted to the images first"""
    methods: Annotated[tuple[str, ...], option("NAME ...")] = ()
    """some of the methods. Default: all"""
    hold_out: Flag = False
    """of the rendered person, score every fifth training frame, held out: to choose by"""
    steps: Count = 600
    """of every training"""
    gaussians: Count = 12_000
    """of every avatar"""
    image_scale: Number = 0.5
    """of the training images"""
    perceptual_weights: OptionalFile = None
    """as of rnd-train"""
    judge_weights: OptionalFile = None
    """network of the scores' LPIPS, which no loss saw"""
    json: OptionalFile = None
    """write the rows here"""
