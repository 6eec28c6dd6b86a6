"""The options of ``rnd-bench study lifter``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from rnd_runtime.cli.command import Count, OptionalFile, option
from rnd_runtime.core.errors import check_option

Folder = Annotated[Path, option("FOLDER")]
OptionalFolder = Annotated[Path | None, option("FOLDER")]


@dataclass(frozen=True)
class Lifter:
    """Film people in captured motions, fit the landmark network's errors, train the lifter on them, score it; resumes.

    rnd-bench study lifter out/lifter --motions ../shared/data/mocap --characters ../shared/data/characters
    --probes ../shared/data/hdri --json out/lifter.json
    """

    out: Annotated[Path, tyro.conf.Positional, option("FOLDER")]
    """folder for filmed windows, errors, states and lifter.onnx"""
    motions: Folder
    """folder with .npz of motions at 30 frames a second, 22 joints"""
    characters: Folder
    """folder with .npz of rigged characters, filmed beside the stage's people"""
    probes: Folder
    """folder with .hdr light probes, backgrounds of the filmed people"""
    windows: Count = 60
    """filmed windows of twelve images from which the errors are fitted; 20 of held-out motions are filmed besides"""
    steps: Count = 3_000
    """of the training"""
    real: OptionalFolder = None
    """Pose2Sim's folder Demo_SinglePerson: adds the rows of its cameras 01 and 03"""
    json: OptionalFile = None
    """write the figures here"""

    def check(self) -> None:
        """Refuse sizes that cannot be fitted or trained."""
        check_option(self.windows >= 2, "--windows", "at least 2", self.windows)
        check_option(self.steps >= 1, "--steps", "at least 1", self.steps)
