"""rnd-data: captures from data sets and videos, and checks of captures."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from rnd_runtime.cli.command import (
    OptionalFile,
    OptionalFolder,
    finish,
    log,
    option,
    parse_subcommand,
    run_command,
    show,
)
from rnd_runtime.core.files import is_folder
from rnd_trainer.importing.options import ImportOptions

from .console import need_extra


@dataclass(frozen=True)
class ImportCommand:
    """Turn a video of one person, or a data set, into a capture. The layout of SOURCE is detected.

    Body, poses, masks and lens of a video are estimated, or given: --body SMPL_NEUTRAL.npz --poses wham_output.pkl

    rnd-data import me.mp4 me
    """

    source: Annotated[tyro.conf.Positional[Path], option("SOURCE")]
    """A data set's folder for one subject, a video, or a folder of frames."""
    out: Annotated[tyro.conf.Positional[Path], option("FOLDER")]
    """Folder for the capture."""
    reading: Annotated[ImportOptions, tyro.conf.arg(name="")] = field(default_factory=ImportOptions)

    def run(self) -> int:
        from rnd_trainer.estimating.own_video import import_video, is_own_video
        from rnd_trainer.importing.importer import check_numbers, import_source
        from rnd_trainer.importing.report import import_and_report

        check_numbers(self.reading)
        importer = import_video if is_own_video(self.source, self.reading) else import_source
        return import_and_report(self.source, self.out, self.reading, importer)


@dataclass(frozen=True)
class CheckCommand:
    """Check units, cameras, masks, silhouettes, normals and timing of a capture. Exit code 1: something is wrong.

    rnd-data check me
    """

    capture: Annotated[tyro.conf.Positional[Path], option("CAPTURE")]
    """Folder with capture.json, or that file."""
    out: OptionalFolder = None
    """Folder for check.json (IoU of every frame) and check.png (overlay). Default: CAPTURE/check."""

    def run(self) -> int:
        from rnd_trainer.checking.report import check_and_report

        folder = self.capture if is_folder(self.capture) else self.capture.parent
        return check_and_report(self.capture, folder / "check" if self.out is None else self.out)


@dataclass(frozen=True)
class ConvertBodyCommand:
    """Turn a body model (SMPL, SMPL-H or SMPL-X as .npz or .pkl, or the word anny) into a body.npz.

    rnd-data convert-body SMPL_NEUTRAL.npz body.npz --betas 0.5 -0.2
    """

    model: Annotated[tyro.conf.Positional[str], option("FILE|anny")]
    """The model; a pickle is read without executing anything."""
    out: Annotated[tyro.conf.Positional[Path], option("FILE")]
    """The body.npz to write."""
    betas: Annotated[tuple[float, ...], option("N ...")] = ()
    """Shape parameters, the first of them; the rest are 0."""
    license: Annotated[str | None, option("TEXT")] = None
    """Licence to write into the file."""

    def run(self) -> int:
        from rnd_trainer.importing.body_models import convert_body_model

        finish(self.out, convert_body_model(self.model, self.out, self.betas, self.license))
        return 0


@dataclass(frozen=True)
class NetworksCommand:
    """Fetch the networks that see a person in a video into the user's cache, check them, convert them to ONNX.

    rnd-data networks
    """

    package: OptionalFile = None
    """The package's .tgz, if it is on this disk. Default: npm fetches it."""

    def run(self) -> int:
        from rnd_trainer.estimating.observing import networks

        log(f"fetching {networks.PACKAGE} {networks.VERSION}" if self.package is None else f"reading {self.package}")
        for network, path in zip(networks.NETWORKS, networks.fetch_networks(self.package)):
            show(f"{path}: {network.what}, {networks.LICENCE}, from {networks.PACKAGE} {networks.VERSION}")
        finish(networks.network_folder(), "three networks", then="rnd-data import me.mp4 captures/me")
        return 0


COMMANDS = {
    "import": ImportCommand,
    "check": CheckCommand,
    "convert-body": ConvertBodyCommand,
    "networks": NetworksCommand,
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of ``rnd-data``."""

    def command() -> int:
        description = "Captures from data sets and videos, and checks of captures."
        chosen = parse_subcommand(COMMANDS, "rnd-data", arguments, description=description)
        need_extra()
        code: int = chosen.run()
        return code

    sys.exit(run_command("rnd-data", command))


if __name__ == "__main__":
    main()
