"""The command ``rnd-convert``: avatars, bodies and motions in the formats of other tools."""

from __future__ import annotations

from collections.abc import Sequence

from rnd_runtime.cli.command import parse_subcommand, run_command

from .options import COMMANDS


def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``rnd-convert`` with ``arguments`` (the process's own when None) and return its exit code."""

    def command() -> None:
        description = "Write avatars, bodies and motions in the formats of other tools."
        options = parse_subcommand(COMMANDS, "rnd-convert", arguments, description=description)
        from .convert import convert  # here, so that --help needs no heavy library

        convert(options)

    return run_command("rnd-convert", command)
