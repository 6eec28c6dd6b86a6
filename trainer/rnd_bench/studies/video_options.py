"""The options of ``rnd-bench study video``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from rnd_runtime.cli.command import File, OptionalFile, option


@dataclass(frozen=True)
class Video:
    """Fit a body to a rendered person's video and to real calibrated cameras, each by itself; score against the truth.

    rnd-bench study video out/video --capture ../shared/data/capture --video dancer.mp4 --json out/video.json
    """

    out: Annotated[Path, tyro.conf.Positional, option("FOLDER")]
    """folder for observations"""
    capture: Annotated[Path, option("FOLDER")]
    """capture of a rendered person"""
    video: File
    """video of its training frames, one for one"""
    real: Annotated[Path | None, option("FOLDER")] = None
    """Pose2Sim's folder Demo_SinglePerson: adds its cameras 01 and 03"""
    json: OptionalFile = None
    """write the rows here"""
