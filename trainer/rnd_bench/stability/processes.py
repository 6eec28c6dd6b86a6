"""Commands run in processes of their own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

PLAY, EXPORT, TRAIN = "rnd_viewer.play.cli", "rnd_export.cli", "rnd_trainer.commands.train"
PATIENCE_S = 3600  # kernels compile, on machines that have other work

Command = tuple[str, list[str]]  # the module whose ``main`` is run, and its arguments

# Runs several commands in one interpreter; prints exit code and stderr of each as JSON.
_DRIVER = """
import contextlib, importlib, io, json, os, sys
for module, arguments in json.loads(sys.argv[1]):
    said = io.StringIO()
    sys.argv = [module, *arguments]
    with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
        try:
            code = importlib.import_module(module).main() or 0
        except SystemExit as stop:
            code = stop.code or 0
        except BaseException as error:
            code = f"{type(error).__name__}: {error}"
    print(json.dumps([code, said.getvalue()]), flush=True)
"""


class Done(NamedTuple):
    """Exit code of a command, or the exception that escaped it, and its stderr."""

    code: int | str
    errors: str

    @property
    def refused(self) -> bool:
        """Whether it ended in one line with exit code 2."""
        return self.code == 2 and len(self.errors.strip().splitlines()) == 1

    def __str__(self) -> str:
        return f"exit {self.code}, {self.errors.strip()[-80:]!r}"


def play(avatar: Path, motion: Path, out: Path, *options: object) -> Command:
    """``rnd-play`` with these files."""
    return PLAY, [str(avatar), "--motion", str(motion), "--out", str(out), *map(str, options)]


def export(checkpoint: Path, out: Path, *options: str) -> Command:
    """``rnd-export`` with these files."""
    return EXPORT, [str(checkpoint), "--out", str(out), *options]


def environment(**more: str) -> dict[str, str]:
    """This process's environment with its import path."""
    return {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path), **more}


def run_commands(folder: Path, commands: Sequence[Command], **more: str) -> list[Done]:
    """Run ``commands`` in sequence in one interpreter, in ``folder``."""
    result = subprocess.run(
        [sys.executable, "-c", _DRIVER, json.dumps(list(commands))],
        cwd=folder,
        env=environment(**more),
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    done = [Done(*json.loads(line)) for line in result.stdout.splitlines()]
    lost = len(commands) - len(done)
    return [*done, *[Done(f"died with {result.returncode}", result.stderr[-300:])] * lost]
