"""The options of ``rnd-bench study lifter``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from rnd_runtime.cli.command import Count, File, OptionalFile, OptionalNumber, option
from rnd_runtime.core.errors import check_option

Folder = Annotated[Path, option("FOLDER")]
OptionalFolder = Annotated[Path | None, option("FOLDER")]


@dataclass(frozen=True)
class Lifter:
    """Film people in captured motions, see them with the landmark network, train the lifter on that, score it.

    rnd-bench study lifter out/lifter --motions ../shared/data/mocap --characters ../shared/data/characters
    --lights ../shared/data/hdri --capture ../shared/data/capture --video dancer.mp4 --json out/lifter.json
    """

    out: Annotated[Path, tyro.conf.Positional, option("FOLDER")]
    """folder for people, films, observations and lifter.onnx, which are not made again where they are there"""
    motions: Folder
    """folder with .npz of motions at 30 frames a second, 22 joints"""
    characters: Folder
    """folder with .npz of rigged characters, who are filmed beside the light stage's people"""
    lights: Folder
    """folder with .hdr files: light and background"""
    capture: Folder
    """capture of a rendered person who is not trained on"""
    video: File
    """video of its training frames"""
    windows: Count = 3264
    """of 40 frames, to film for training; fewer are kept: the person may be lost"""
    steps: Count = 2000
    """of training; the best network on the validation windows counts"""
    seconds: OptionalNumber = None
    """of filming, and of training, at most"""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """films 15 windows a second on a data centre's GPU, one in a minute on a core"""
    real: OptionalFolder = None
    """Pose2Sim's folder Demo_SinglePerson: adds the rows of its cameras 01 and 03"""
    json: OptionalFile = None
    """write the figures here"""

    def check(self) -> None:
        """Refuse sizes that cannot be filmed or trained."""
        check_option(self.windows >= 10, "--windows", "at least 10", self.windows)
        check_option(self.steps >= 1, "--steps", "at least 1", self.steps)
        check_option(self.seconds is None or self.seconds > 0, "--seconds", "more than 0", self.seconds)
