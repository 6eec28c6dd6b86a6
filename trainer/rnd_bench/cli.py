"""rnd-bench: speed, stability and studies, as JSON rows, tables and charts."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from rnd_runtime.cli.command import parse_subcommand, run_command
from rnd_runtime.cli.extras import need_packages

from .lifter.options import Lifter
from .options import Compare, Frame, Grid, Ground, Raster, Scenes, Step
from .stability.cli import Stability
from .studies.options import Ablations, Agreement, Causes, Lengths, People
from .studies.video_options import Filmed, Video

SPEED, STUDY = "rnd_bench.speed.cli", "rnd_bench.studies.cli"


@dataclass(frozen=True)
class Study:
    """Studies of many trainings, and of the light stage: rnd-bench study NAME."""


COMMANDS: dict[str, tuple[Any, str, str]] = {
    "raster": (Raster, SPEED, "run_raster"),
    "frame": (Frame, SPEED, "run_frame"),
    "grid": (Grid, SPEED, "run_grid"),
    "step": (Step, SPEED, "run_step"),
    "scenes": (Scenes, SPEED, "run_scenes"),
    "compare": (Compare, SPEED, "run_compare"),
    "ground": (Ground, "rnd_bench.ground.cli", "run"),
    "stability": (Stability, "rnd_bench.stability.cli", "run"),
    "study": (Study, "", ""),
}
STUDIES: dict[str, tuple[Any, str, str]] = {
    "ablations": (Ablations, STUDY, "run_trainings"),
    "causes": (Causes, STUDY, "run_trainings"),
    "lengths": (Lengths, STUDY, "run_trainings"),
    "people": (People, STUDY, "run_people"),
    "agreement": (Agreement, STUDY, "run_agreement"),
    "video": (Video, "rnd_bench.studies.video", "run"),
    "filmed": (Filmed, "rnd_bench.studies.filmed", "run"),
    "lifter": (Lifter, "rnd_bench.lifter.cli", "run"),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point of ``rnd-bench``."""
    words, prog, commands = list(sys.argv[1:] if arguments is None else arguments), "rnd-bench", COMMANDS
    description = "Measure time and error of the same calls, and the cases in which methods of this kind break."
    if words[:1] == ["study"]:
        words, prog, commands, description = words[1:], "rnd-bench study", STUDIES, str(Study.__doc__)

    def command() -> None:
        kinds = {name: kind for name, (kind, _, _) in commands.items()}
        options = parse_subcommand(kinds, prog, words, description=description)
        need_packages("bench", "torch", "safetensors", "scipy")
        _, module, function = next(entry for entry in commands.values() if type(options) is entry[0])
        getattr(importlib.import_module(module), function)(options)

    return run_command("rnd-bench", command)
