"""Floods, slow clients and garbage: they are dropped, and a page is answered meanwhile."""

from __future__ import annotations

import errno
import http.client
import json
import os
import resource
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from time import monotonic, sleep
from urllib.parse import urlsplit

import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

import rnd_viewer.view.listener
import rnd_viewer.view.server
from rnd_viewer.view.listener import MAX_CONNECTIONS, MIN_CONNECTIONS, connection_limit
from rnd_viewer.view.options import ViewOptions
from rnd_viewer.view.server import MAX_BYTES_IN, MAX_WAITING, serve
from rnd_viewer.view.training import Training

ANSWER_S = 2.0
"""in which a page is answered, whatever others do"""
SLOW_CLIENTS = 2000
MAX_GROWTH = 64 << 20
"""bytes that 2 000 connections may add"""
# A training's page needs no avatar. The server answers until its input ends.
SERVER = """
import resource, sys, threading
files = int(sys.argv[2])
resource.setrlimit(resource.RLIMIT_NOFILE, (files, files))
from pathlib import Path
from rnd_viewer.view.options import ViewOptions
from rnd_viewer.view.server import serve
from rnd_viewer.view.training import Training
with serve(Training(ViewOptions(Path(sys.argv[1]))), "127.0.0.1", 0, "s3cret") as (server, url):
    threading.Thread(target=server.serve_forever).start()
    print(url, flush=True)
    sys.stdin.read()
print("ended", flush=True)
"""


@pytest.fixture
def run(tmp_path) -> Path:
    (tmp_path / "config.json").write_text("{}")
    return tmp_path


@pytest.fixture
def url(run) -> Iterator[str]:
    """Of a server in this process."""
    with serve(Training(ViewOptions(run)), "127.0.0.1", 0, "s3cret") as (server, url):
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield url
        server.shutdown()
        thread.join()


@contextmanager
def _server(run: Path, files: int) -> Iterator[tuple[str, subprocess.Popen[str]]]:
    """A server in a process of its own, with at most ``files`` file descriptors; it ends without a word."""
    command = [sys.executable, "-c", SERVER, str(run), str(files)]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, text=True) as process:
        try:
            assert process.stdout
            yield process.stdout.readline().strip(), process
            output, errors = process.communicate("", timeout=30)
        finally:
            process.kill()
    assert (output, errors, process.returncode) == ("ended\n", "", 0)


def _connect(url: str) -> socket.socket:
    place = urlsplit(url)
    return socket.create_connection((place.hostname, place.port), timeout=10)


def _socket_url(url: str) -> str:
    return urlsplit(url)._replace(scheme="ws", path="/socket").geturl()


def _answers(url: str) -> float:
    """Seconds until the page came."""
    place, started = urlsplit(url), monotonic()
    connection = http.client.HTTPConnection(place.hostname, place.port, timeout=10)
    connection.request("GET", f"{place.path}?{place.query}")
    assert connection.getresponse().status == 200
    connection.close()
    return monotonic() - started


def _ends(connection: socket.socket) -> bytes:
    """What comes until the server ends the connection."""
    received = b""
    with suppress(ConnectionResetError):
        while part := connection.recv(1 << 16):
            received += part
    return received


def _memory(process: subprocess.Popen[str]) -> int:
    """Resident bytes."""
    status = Path(f"/proc/{process.pid}/status").read_text("ascii")
    return 1024 * int(status.split("VmRSS:")[1].split()[0])


@pytest.fixture
def many_files() -> Iterator[None]:
    """File descriptors for 2 000 clients."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if hard != resource.RLIM_INFINITY and hard < 2 * SLOW_CLIENTS:
        pytest.skip("needs more file descriptors")
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, 2 * SLOW_CLIENTS), hard))
    yield
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


@pytest.mark.parametrize(("files", "clients"), [(64, 100), pytest.param(1024, SLOW_CLIENTS, marks=pytest.mark.slow)])
def test_idle_clients_lock_nobody_out(run, many_files, files, clients):
    with _server(run, files) as (url, process), ExitStack() as idle:
        assert _answers(url) < ANSWER_S
        before = _memory(process)
        for number in range(clients):
            idle.enter_context(_connect(url))
            if number % (clients // 4) == clients // 8:
                assert _answers(url) < ANSWER_S
        assert _answers(url) < ANSWER_S
        assert _memory(process) - before < MAX_GROWTH
        threads = len(list(Path(f"/proc/{process.pid}/task").iterdir()))
        assert threads <= 2 * MAX_CONNECTIONS + 8


def test_a_page_that_is_open_outlives_a_flood(url, run, monkeypatch):
    monkeypatch.setattr(Training, "scene", lambda training: _Idle())
    with connect(_socket_url(url)) as page, ExitStack() as idle:
        json.loads(page.recv())
        for _ in range(2 * MAX_CONNECTIONS):
            idle.enter_context(_connect(url))
        page.send("{}")
        assert json.loads(page.recv())["kind"] == "error"


class _Idle:
    """A scene of which nothing is rendered."""

    threads = None

    def description(self) -> dict[str, str]:
        return {}

    def close(self) -> None:
        pass


def test_pages_beyond_the_limit_are_told_so(url, monkeypatch):
    monkeypatch.setattr(Training, "scene", lambda training: _Idle())
    with ExitStack() as pages:
        for _ in range(MAX_CONNECTIONS // 2):
            pages.enter_context(connect(_socket_url(url)))
        with pytest.raises(InvalidStatus, match="503"):
            pages.enter_context(connect(_socket_url(url)))
        assert _answers(url) < ANSWER_S


@pytest.mark.parametrize(
    "sent",
    [
        b"GET /" + b"a" * (1 << 20),  # a line without end
        b"GET / HTTP/1.1\r\n" + b"".join(b"X-%d: %s\r\n" % (k, b"a" * 8000) for k in range(200)),
        b"GET / HTTP/1.1\r\nHost: " + b"a" * (1 << 20),
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + bytes(500) + b"\n",  # TLS
        bytes(range(256)) * 64,
        b"POST / HTTP/1.1\r\nContent-Length: 99999999999\r\n\r\n" + bytes(1 << 16),
        b"GET / HTTP/1.1\r\nTransfer-Encoding: chunked\r\n\r\n",
        b"GET /\xff HTTP/1.1\r\n\r\n",
        b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n",
    ],
    ids=["line", "headers", "header", "tls", "bytes", "body", "chunked", "not ascii", "http2"],
)
def test_garbage_is_dropped(url, sent):
    with _connect(url) as connection:
        with suppress(OSError):  # it is gone before all is sent
            connection.sendall(sent)
            connection.shutdown(socket.SHUT_WR)
        answer = _ends(connection)
    assert not answer or 400 <= int(answer.split()[1]) < 500
    assert _answers(url) < ANSWER_S


@pytest.mark.parametrize("letters", ["", "GET / HTTP/1.1\r\nX: " + 100 * "slow"], ids=["idle", "slow"])
def test_a_client_that_takes_its_time_is_dropped(run, monkeypatch, letters):
    monkeypatch.setattr(rnd_viewer.view.server, "HANDSHAKE_S", 0.5)
    with serve(Training(ViewOptions(run)), "127.0.0.1", 0, "s3cret") as (server, url):
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        started = monotonic()
        with _connect(url) as connection:
            with suppress(OSError):
                for letter in letters:  # a total of 20 s
                    connection.sendall(letter.encode())
                    sleep(0.05)
            assert _ends(connection) == b""
        assert 0.4 < monotonic() - started < 5
        server.shutdown()
        thread.join()


def _too_long(page) -> None:
    page.send("a" * (MAX_BYTES_IN + 1))


def _too_long_by_its_header(page) -> None:
    page.socket.sendall(b"\x81\xff\x7f\xff\xff\xff\xff\xff\xff\xff")


def _too_many(page) -> None:
    for _ in range(100 * MAX_WAITING):
        page.send("{}")


def _not_masked(page) -> None:
    page.socket.sendall(b"\x81\x02{}")


def _fragments(page) -> None:
    page.send("a" for _ in range(100 * MAX_WAITING))


@pytest.mark.parametrize("hostile", [_too_long, _too_long_by_its_header, _too_many, _not_masked, _fragments])
def test_a_hostile_websocket_is_closed(url, monkeypatch, hostile: Callable[..., None]):
    held = threading.Event()
    monkeypatch.setattr(Training, "scene", lambda training: held.wait(1) or _Idle())  # meanwhile, requests wait
    with connect(_socket_url(url)) as page, pytest.raises((ConnectionClosed, OSError)):
        hostile(page)
        while True:
            page.recv(timeout=10)
    held.set()
    assert _answers(url) < ANSWER_S


@pytest.mark.parametrize("sent", ["[" * 5000, '{"ask": "render"}', '{"ask": 1e999}', b"\xff", "\0"])
def test_a_message_that_makes_no_sense_is_answered(url, monkeypatch, sent):
    monkeypatch.setattr(Training, "scene", lambda training: _Idle())
    with connect(_socket_url(url)) as page:
        page.recv()
        page.send(sent)
        assert json.loads(page.recv())["kind"] == "error"


@pytest.mark.parametrize("number", [errno.EMFILE, errno.ENFILE, errno.ENOMEM, errno.ECONNABORTED, errno.EPERM])
def test_an_accept_that_fails_does_not_end_the_loop(url, monkeypatch, number):
    failures = []
    original = socket.socket.accept

    def accept(listening):
        if len(failures) < 3:
            failures.append(number)
            raise OSError(number, os.strerror(number))
        return original(listening)

    monkeypatch.setattr(socket.socket, "accept", accept)
    assert _answers(url) < ANSWER_S
    assert len(failures) == 3


def test_a_thread_that_cannot_start_does_not_end_the_loop(url, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(rnd_viewer.view.listener, "Thread", _NoThread)
        with _connect(url) as connection:
            assert _ends(connection) == b""
    assert _answers(url) < ANSWER_S


class _NoThread(threading.Thread):
    def start(self) -> None:
        raise RuntimeError("can't start new thread")


def test_one_address_leaves_space_for_others(url):
    with ExitStack() as stack:
        place = urlsplit(url)
        other = stack.enter_context(
            socket.create_connection((place.hostname, place.port), 10, source_address=("127.0.0.2", 0))
        )
        for _ in range(2 * MAX_CONNECTIONS):
            stack.enter_context(_connect(url))
        other.sendall(b"GET / HTTP/1.1\r\n\r\n")
        assert other.recv(20).startswith(b"HTTP/1.1 4")


def test_the_limit_follows_that_of_file_descriptors(monkeypatch):
    limits = {}
    for files in (20, 64, 4096, rnd_viewer.view.listener.resource.RLIM_INFINITY):
        monkeypatch.setattr(rnd_viewer.view.listener.resource, "getrlimit", lambda _, files=files: (files, files))
        limits[files] = connection_limit()
    assert list(limits.values()) == sorted(limits.values())
    assert min(limits.values()) == MIN_CONNECTIONS and max(limits.values()) == MAX_CONNECTIONS
