"""The command ``rnd-play``."""

from __future__ import annotations

from collections.abc import Sequence

from rnd_runtime.cli.command import parse, run_command, show
from rnd_runtime.playback.start import load_ahead
from rnd_viewer.inputs.options import PlayOptions
from rnd_viewer.inputs.scenes import is_scene


def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``rnd-play`` with ``arguments`` (the process's own when None) and return its exit code.

    0 when all frames are written, 2 for unusable input (one line on stderr), 130 after Ctrl-C.
    """
    return run_command("rnd-play", lambda: _play(parse(PlayOptions, "rnd-play", arguments)))


def _play(options: PlayOptions) -> int:
    if options.doctor:
        return _doctor()
    scene = options.avatar is not None and is_scene(options.avatar)
    ahead = load_ahead(None if scene else options.avatar, options.rendering.threads)
    from .play import play  # here, so that --help and --doctor work where a library does not load

    return play(options, ahead)


def _doctor() -> int:
    from rnd_runtime.playback.doctor import report

    from .video import finding

    for found in [*report(), finding()]:
        show(f"{found.label:<14} {found.value}")
        if found.advice is not None:
            show(f"{'':<14} → {found.advice}")
    return 0
