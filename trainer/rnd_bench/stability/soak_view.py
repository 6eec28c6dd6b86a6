"""``rnd-view`` for hours, with clients that come and go: pages, files, strangers, idle and broken connections."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from http.client import HTTPException
from pathlib import Path
from time import monotonic, perf_counter, sleep
from typing import Any
from urllib.error import HTTPError
from urllib.parse import urlsplit
from urllib.request import urlopen

import numpy as np
from websockets.exceptions import WebSocketException

from rnd_bench.scenes.subject import Subject
from rnd_runtime.core.errors import InputError

from .figures import Figure, at_most, below, not_measured, reported
from .processes import environment
from .soak import TOO_SHORT

VIEW = "import sys; from rnd_viewer.view.cli import main; sys.exit(main())"
SIDE = 64
"""px: of the images that pages ask for"""
IDLE = 100
"""connections that ask for nothing, more than the server holds"""
WARM = 1200
"""clients before memory is watched: each thread of the server takes an arena of malloc's"""
EVERY = 20
"""clients between two readings of memory"""
PAUSE_S = 0.1
"""between two clients: they and the server take a tenth of a core"""
RETRY_S = 0.05
"""until a refused client comes again"""
TRIES = 20
ANSWER_S = 2.0
SLOPE_BYTES = 1000.0
PATIENCE_S = 30.0


def soak_view(subject: Subject, minutes: float) -> list[Figure]:
    """Let clients of each kind, alternating, visit one ``rnd-view`` on a loopback address for ``minutes``."""
    idle: deque[socket.socket] = deque()
    seconds, memory = [], []
    with _viewer(subject.avatar_file) as (url, process), ExitStack() as stack:
        stack.callback(_close_all, idle)
        kinds: list[Callable[[str], None]] = [_page, _file, _leave, _stranger, _garbage, lambda url: _idle(url, idle)]
        clients, refused, end = 0, 0, monotonic() + 60 * minutes
        while monotonic() < end:
            refused += _visit(kinds[clients % len(kinds)], url)
            started = perf_counter()
            refused += _visit(_file, url)
            seconds.append(perf_counter() - started)
            if clients >= WARM and clients % EVERY == 0:
                memory.append(_memory(process.pid))
            clients += 1
            sleep(PAUSE_S)
        ended = process.poll() is not None
        _close_all(idle)
        seconds_to_end = _end(process)
    name = f"rnd-view, {clients} clients in {minutes:.3g} minutes"
    growth = f"{name}: memory a client"
    slope = np.polyfit(EVERY * np.arange(len(memory)), memory, 1)[0] if len(memory) > 10 else None
    return [
        not_measured(growth, TOO_SHORT) if slope is None else below(growth, float(slope), SLOPE_BYTES, "bytes"),
        reported(f"{name}: answer to a page, p99", float(np.quantile(seconds, 0.99)), "s"),
        replace(below(f"{name}: longest answer to a page", max(seconds), ANSWER_S, "s"), timing=True),
        reported(f"{name}: connections refused, then taken", refused),
        at_most(f"{name}: ended early", int(ended), 0),
        replace(below(f"{name}: time to end after SIGTERM", seconds_to_end, PATIENCE_S, "s"), timing=True),
    ]


def visit_idle(subject: Subject, count: int) -> tuple[float, bool]:
    """Seconds of a page's image beside ``count`` idle connections, and whether the server ended."""
    with _viewer(subject.avatar_file) as (url, process), ExitStack() as stack:
        for _ in range(count):
            with suppress(OSError):
                stack.callback(_connect(url).close)
        started = perf_counter()
        _visit(_page, url)
        return perf_counter() - started, process.poll() is not None


@contextmanager
def _viewer(avatar: Path) -> Iterator[tuple[str, subprocess.Popen[str]]]:
    """``rnd-view`` of ``avatar`` and the URL that it prints."""
    command = [sys.executable, "-c", VIEW, str(avatar), "--size", str(SIDE), "--port", "0", "--no-browser"]
    with subprocess.Popen(command, env=environment(), stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout
            line = process.stdout.readline()
            if not line.startswith("rnd-view: http://"):
                raise InputError("rnd-view does not start", got=line.strip() or f"exit {process.wait()}")
            yield line.removeprefix("rnd-view: ").strip(), process
        finally:
            _end(process)


def _end(process: subprocess.Popen[str]) -> float:
    """Seconds in which ``process`` ends after SIGTERM; it is killed where that takes longer than ``PATIENCE_S``."""
    started = perf_counter()
    process.send_signal(signal.SIGTERM)
    with suppress(subprocess.TimeoutExpired):
        process.wait(PATIENCE_S)
    process.kill()
    return perf_counter() - started


@contextmanager
def _websocket(url: str) -> Iterator[tuple[Any, dict[str, Any]]]:
    """A connected page and what it asks for: one image."""
    from websockets.sync.client import connect

    address = urlsplit(url)._replace(scheme="ws", path="/socket").geturl()
    with connect(address, max_size=None, compression=None) as page:
        view = json.loads(page.recv(PATIENCE_S))["scene"]["view"]
        state = {"time": 0.0, "width": SIDE, "height": SIDE} | view
        yield page, {"ask": "render", "number": 1, "state": state}


def _visit(visit: Callable[[str], None], url: str) -> int:
    """Come again, as a browser does, where the server has no space within its patience; how often."""
    for refused in range(TRIES):
        try:
            visit(url)
            return refused
        except (OSError, HTTPException, WebSocketException):
            sleep(RETRY_S)
    visit(url)
    return TRIES


def _page(url: str) -> None:
    with _websocket(url) as (page, request):
        page.send(json.dumps(request))
        header = json.loads(page.recv(PATIENCE_S))
        assert header["kind"] == "frame", header
        assert len(page.recv(PATIENCE_S)) == 4 * SIDE * SIDE


def _leave(url: str) -> None:
    """A page that is gone before its image is there."""
    with _websocket(url) as (page, request):
        page.send(json.dumps(request))
        page.socket.shutdown(socket.SHUT_RDWR)


def _file(url: str) -> None:
    with urlopen(url, timeout=PATIENCE_S) as answer:
        answer.read()


def _stranger(url: str) -> None:
    with suppress(HTTPError):
        urlopen(urlsplit(url)._replace(query="token=wrong").geturl(), timeout=PATIENCE_S)
        raise AssertionError("a wrong token is taken")


def _garbage(url: str) -> None:
    with _connect(url) as connection, suppress(OSError):
        connection.sendall(os.urandom(1 << 16))


def _idle(url: str, idle: deque[socket.socket]) -> None:
    idle.append(_connect(url))
    if len(idle) > IDLE:
        idle.popleft().close()


def _close_all(connections: Iterable[socket.socket]) -> None:
    for connection in connections:
        connection.close()


def _connect(url: str) -> socket.socket:
    place = urlsplit(url)
    return socket.create_connection((place.hostname, place.port), PATIENCE_S)


def _memory(process: int) -> int:
    """Bytes that ``process`` wrote and holds."""
    fields = dict(line.split(":", 1) for line in Path(f"/proc/{process}/smaps_rollup").read_text().splitlines()[1:])
    return 1024 * sum(int(fields[name].split()[0]) for name in ("Private_Dirty", "Swap"))
