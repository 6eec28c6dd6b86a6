"""The command ``rnd-view``."""

from __future__ import annotations

import secrets
import webbrowser
from collections.abc import Sequence
from threading import Thread
from typing import NoReturn

from rich.console import Console

from rnd_runtime.cli.command import is_quiet, log, parse, run_command
from rnd_runtime.core.kernels import COMPILING, kernels_are_cold
from rnd_runtime.core.signals import on_signal
from rnd_runtime.core.threads import set_threads
from rnd_runtime.playback.start import load_ahead
from rnd_viewer.inputs.scenes import is_scene

from .access import is_loopback
from .options import ViewOptions


def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``rnd-view`` with ``arguments`` (the process's own when None) until Ctrl-C; 2 for unusable input."""
    return run_command("rnd-view", lambda: view(parse(ViewOptions, "rnd-view", arguments)))


def view(options: ViewOptions) -> NoReturn:
    """Serve the avatar or the training that ``options`` name until the process is interrupted.

    Raises:
        InputError: for whatever cannot be used.
    """
    watching = options.avatar.is_dir()
    cast = is_scene(options.avatar) and not watching
    ahead = load_ahead(None if watching or cast else options.avatar, options.threads)
    from .cast_scene import CastScene  # here, so that --help works where a library does not load
    from .scene import Scene
    from .server import load_websockets, serve
    from .training import Training

    load_websockets()
    set_threads(options.threads)
    shown: Scene | Training
    if watching:
        shown = Training(options)
    else:
        cold = kernels_are_cold()
        with Console(stderr=True, quiet=is_quiet()).status("loading"):
            shown = CastScene(options) if cast else Scene(options, ahead)
            if cold:
                log(COMPILING)
            shown.warm_up()
    try:
        token = secrets.token_urlsafe(16)
        with serve(shown, options.host, options.port, token, options.fps_floor) as (server, url):
            print(f"rnd-view: {url}", flush=True)  # noqa: T201
            if options.browser and is_loopback(options.host):
                Thread(target=webbrowser.open, args=(url,), daemon=True).start()  # some wait for their page
            with on_signal(server.stop):
                server.serve_forever()
        raise KeyboardInterrupt  # by which alone serving ends; the pages are told
    finally:
        shown.close()
