"""rnd-view as a process of its own, as its user starts it."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

INTERRUPTED = 130
LONGEST_END_S = 60  # generously: a picture may still be drawn, on a busy machine
START = "import sys; from rnd_viewer.view.cli import main; sys.exit(main())"


@contextmanager
def running(*arguments: str) -> Iterator[str]:
    """Start rnd-view on a free port, yield the address that it prints, and end it as Ctrl-C does."""
    command = [sys.executable, "-c", START, *arguments, "--port", "0", "--no-browser"]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, preexec_fn=_heed_interrupts
    ) as viewer:
        assert viewer.stdout and viewer.stderr
        line = viewer.stdout.readline()
        assert line.startswith("rnd-view: http://"), (line, viewer.stderr.read())
        try:
            yield line.removeprefix("rnd-view: ").strip()
        finally:
            viewer.send_signal(signal.SIGINT)
            try:
                ended = viewer.wait(LONGEST_END_S)
            finally:
                viewer.kill()
        assert ended == INTERRUPTED


def _heed_interrupts() -> None:
    """What a shell starts in the background, tests among it, passes on that Ctrl-C is ignored."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
