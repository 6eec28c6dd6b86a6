"""The options of ``rnd-bench study lifter``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from rnd_runtime.cli.command import Count, File, OptionalFile, option
from rnd_runtime.core.errors import check_option

Folder = Annotated[Path, option("FOLDER")]
OptionalFolder = Annotated[Path | None, option("FOLDER")]


@dataclass(frozen=True)
class Lifter:
    """Fit the landmark network's errors to a rendered person, solve the lifter's weights on captured motions, score it.

    rnd-bench study lifter out/lifter --motions ../shared/data/mocap --capture ../shared/data/capture
    --video dancer.mp4 --json out/lifter.json
    """

    out: Annotated[Path, tyro.conf.Positional, option("FOLDER")]
    """folder for observations and lifter.onnx, which are not made again where they are there"""
    motions: Folder
    """folder with .npz of motions at 30 frames a second, 22 joints"""
    capture: Folder
    """capture of a rendered person, whose training frames the landmark network's errors are fitted to"""
    video: File
    """video of these frames, 15 a second"""
    batches: Count = 8
    """of 900 samples each, from which each of the network's two stages is solved"""
    steps: Count = 50
    """of gradient descent after that"""
    real: OptionalFolder = None
    """Pose2Sim's folder Demo_SinglePerson: adds the rows of its cameras 01 and 03"""
    json: OptionalFile = None
    """write the figures here"""

    def check(self) -> None:
        """Refuse sizes that cannot be fitted or trained."""
        check_option(self.batches >= 1, "--batches", "at least 1", self.batches)
        check_option(self.steps >= 1, "--steps", "at least 1", self.steps)
