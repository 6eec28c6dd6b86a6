"""``rnd-train --view``: a page on this machine that shows a training while it runs.

A thread serves what the run folder holds anyway, ``metrics.jsonl`` and ``previews/``; the training knows nothing
of it. When the training ends, a page that is open is told how, and shown the last preview, before the thread ends.
It answers to 127.0.0.1 alone, and only when asked by that name, so that no page of the web can read it.
"""

from __future__ import annotations

import json
import os
import re
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal

from .metrics_log import row_of
from .schedule import Schedule

PORT = 7860
"""tried first; any free one when it is taken"""
POINTS = 300
"""of a curve: more than the page has pixels for helps nobody"""
RECENT = 200
"""steps whose speed gives the time left"""
WATCH_S = 30.0
"""after which a page that waits for the end is answered and asks anew: browsers give up in the end"""
GOODBYE_S = 2.0
"""in which a page that was told of the end fetches the last preview"""
Ending = Literal["finished", "stopped"]
_PREVIEW = re.compile(r"step_\d+\.png")


class Metrics:
    """``metrics.jsonl`` as far as it is written, read on from where the last call stopped."""

    def __init__(self, path: Path) -> None:
        self.path, self.rows = path, list[dict[str, Any]]()
        self._offset, self._file = 0, 0
        self._lock = threading.Lock()

    def read(self) -> list[dict[str, Any]]:
        """All rows so far; a line still being written waits for the next call, a file cut by --resume starts anew.

        Damaged rows are left out, as --resume leaves them out.
        """
        with self._lock:
            if not self.path.exists():
                return []
            with self.path.open("rb") as stream:
                file = os.fstat(stream.fileno()).st_ino
                if file != self._file:
                    self.rows, self._offset, self._file = [], 0, file
                stream.seek(self._offset)
                content = stream.read()
            whole = content[: content.rfind(b"\n") + 1]
            self.rows += [row for line in whole.splitlines() if (row := row_of(line)) is not None]
            self._offset += len(whole)
            return list(self.rows)


def state(rows: list[dict[str, Any]], schedule: Schedule, previews: list[str]) -> dict[str, Any]:
    """What the page shows: progress, seconds left, one binned curve for each loss term, the preview's names.

    Curves are ``[[step, mean], …]`` with at most ``POINTS`` points.
    """
    seconds_left, total = None, schedule.total
    if len(rows) > 1:
        recent = rows[max(0, len(rows) - RECENT)], rows[-1]
        first, last = (schedule.effort(row["step"] + 1) for row in recent)
        seconds = recent[1]["seconds"] - recent[0]["seconds"]
        seconds_left = (schedule.effort(total) - last) * seconds / (last - first)
    curves: dict[str, list[list[float]]] = {}
    terms = list(dict.fromkeys(name for row in rows for name in row))
    for term in terms:
        if term not in ("step", "stage", "seconds", "skipped"):
            points = [(row["step"], row[term]) for row in rows if term in row]
            curves[term] = _binned(points, -(-total // POINTS))
    return {
        "done": rows[-1]["step"] + 1 if rows else 0,
        "total": total,
        "stage": rows[-1]["stage"] if rows else 1,
        "seconds": rows[-1]["seconds"] if rows else 0,
        "seconds_left": seconds_left,
        "skipped": sum("skipped" in row for row in rows),
        "curves": curves,
        "previews": previews,
    }


def _binned(points: list[tuple[int, float]], width: int) -> list[list[float]]:
    """Means of the finite values of each ``width`` steps."""
    bins: dict[int, list[float]] = {}
    for step, value in points:
        if abs(value) < float("inf"):
            bins.setdefault(step // width, []).append(value)
    return [[width * k + width / 2, sum(values) / len(values)] for k, values in sorted(bins.items())]


@contextmanager
def live_view(folder: Path, schedule: Schedule, port: int = PORT) -> Iterator[str]:
    """Serve the run in ``folder`` while the block runs; yields the page's address.

    A page that is open then learns of the end: "finished", or "stopped" where the block raised something.
    """
    try:
        server = _Server(("127.0.0.1", port), _Handler)
    except OSError:  # somebody else's, perhaps another training's
        server = _Server(("127.0.0.1", 0), _Handler)
    server.folder, server.schedule, server.over = folder, schedule, threading.Event()
    server.metrics = Metrics(folder / "metrics.jsonl")
    thread = threading.Thread(target=server.serve_forever, name="live view", daemon=True)
    thread.start()
    try:
        try:
            yield f"http://127.0.0.1:{server.server_port}/"
        except BaseException:
            server.end("stopped")
            raise
        server.end("finished")
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    folder: Path
    schedule: Schedule
    metrics: Metrics
    ended: Ending | None = None
    over: threading.Event
    watched = -WATCH_S  # when a page last asked for the end, on the monotonic clock

    def end(self, how: Ending) -> None:
        """Tell the pages that are open; where none is, nobody is waited for."""
        self.ended = how
        self.over.set()
        if time.monotonic() - self.watched <= WATCH_S:
            with suppress(KeyboardInterrupt):  # it has ended anyway
                time.sleep(GOODBYE_S)

    def state(self) -> dict[str, Any]:
        """``state`` of the run as it is now, and how it ended."""
        return state(self.metrics.read(), self.schedule, self.previews()) | self.ending()

    def previews(self) -> list[str]:
        """Names of the preview pictures, the first one first."""
        folder = self.folder / "previews"
        return sorted(p.name for p in folder.glob("step_*.png")) if folder.is_dir() else []

    def ending(self) -> dict[str, Any]:
        """What the page says of the end: how, and where things lie; ``scores`` is None where there are none."""
        avatar, scores = self.folder / "avatar.ckpt", self.folder / "eval.json"
        scored = self.ended == "finished" and scores.exists()
        return {"ended": self.ended, "avatar": str(avatar), "scores": str(scores) if scored else None}

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A page that was closed or reloaded breaks its connection: nobody needs to read of it."""
        if not isinstance(sys.exception(), ConnectionError):
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    server: _Server

    def do_GET(self) -> None:
        if self.headers.get("Host") not in {f"{name}:{self.server.server_port}" for name in ("127.0.0.1", "localhost")}:
            self.send_error(HTTPStatus.FORBIDDEN)
            return
        name = self.path.removeprefix("/previews/")
        if self.path == "/":
            page = files("rnd_trainer").joinpath("live_view.html").read_bytes()
            self._answer(page, "text/html; charset=utf-8")
        elif self.path in ("/state.json", "/end.json"):
            if self.path == "/end.json":  # a page in the background asks too seldom to see the end by itself
                self.server.watched = time.monotonic()
                self.server.over.wait(WATCH_S)
            self._answer(json.dumps(self.server.state()).encode(), "application/json")
        elif _PREVIEW.fullmatch(name) and name in self.server.previews():
            self._answer((self.server.folder / "previews" / name).read_bytes(), "image/png")
        else:
            self.send_error(HTTPStatus.NOT_FOUND)

    def _answer(self, content: bytes, kind: str) -> None:
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, *_: object) -> None:
        """Nothing: the terminal belongs to the training."""
