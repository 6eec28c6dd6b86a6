"""The command ``rnd-play``."""

from __future__ import annotations

from collections.abc import Sequence

import tyro

from rnd_runtime.core.command import parse_options, run_command
from rnd_runtime.playback.start import load_ahead
from rnd_viewer.inputs.options import PlayOptions


def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``rnd-play`` with ``arguments`` (the process's own when None) and return its exit code.

    0 when all frames are written, 2 for unusable input (one line on stderr), 130 after Ctrl-C.
    """

    def command() -> int:
        options = parse_options(lambda: tyro.cli(PlayOptions, prog="rnd-play", args=arguments))
        if options.doctor:
            return _doctor()
        ahead = load_ahead(options.avatar, options.threads)
        from .play import play  # here, so that --help and --doctor work where a library does not load

        return play(options, ahead)

    return run_command("rnd-play", command)


def _doctor() -> int:
    from rnd_runtime.playback.doctor import report
    from rnd_viewer.inputs.console import print_findings

    from .video import finding

    print_findings([*report(), finding()])
    return 0
