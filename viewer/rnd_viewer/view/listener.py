"""An accept loop that no client ends, and limits on what clients can hold.

A connection costs two threads and four file descriptors. Where all are taken, the oldest connection that brought no
token is dropped for the new one, so that a flood of idle clients does not lock out a page.
"""

from __future__ import annotations

import os
import resource
import selectors
import struct
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from socket import SHUT_RDWR, SO_SNDTIMEO, SOL_SOCKET, socket
from threading import Condition, Event, Thread
from time import monotonic, sleep
from typing import Any

MAX_CONNECTIONS = 64
MIN_CONNECTIONS = 4
"""however few file descriptors there are"""
SHARE_OF_ADDRESS, SHARE_OF_PAGES = 0.75, 0.5
"""of all connections: those of one address, and those that are websockets"""
FILES_PER_CONNECTION = 4
"""the socket, websockets' pair that ends it, and its poll"""
RESERVED_FILES = 16
"""for pages, clips and light probes"""
PATIENCE_S = 0.5
"""for a dropped connection to end, before the new one is refused"""
PAUSE_S = 0.05
"""after an accept that failed: out of file descriptors, memory or threads"""
SEND_S = 30
"""in which a client must read something of what is sent"""


def connection_limit() -> int:
    """As many as the process's limit of file descriptors has space for, at most ``MAX_CONNECTIONS``."""
    limit = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    if limit == resource.RLIM_INFINITY:
        return MAX_CONNECTIONS
    free = limit - len(os.listdir("/dev/fd")) - RESERVED_FILES  # noqa: PTH208
    return max(MIN_CONNECTIONS, min(free // FILES_PER_CONNECTION, MAX_CONNECTIONS))


@dataclass(eq=False)
class _Client:
    """``known``: brought the token; ``page``: has a websocket; ``dropped``: is about to end."""

    socket: socket
    address: str
    known: bool = False
    page: bool = False
    dropped: bool = False

    def drop(self) -> None:
        self.dropped = True
        with suppress(OSError):  # closed already
            self.socket.shutdown(SHUT_RDWR)


class Listener:
    """Runs a server of ``websockets.sync`` with at most ``limit`` connections."""

    def __init__(self, server: Any, limit: int) -> None:
        self._server, self._limit = server, limit
        self._per_address, self._pages = int(SHARE_OF_ADDRESS * limit), int(SHARE_OF_PAGES * limit)
        self._clients: dict[socket, _Client] = {}  # the oldest first
        self._changed, self._started, self._stopped = Condition(), Event(), False
        server.socket.setblocking(False)  # the client may be gone between poll and accept

    @property
    def port(self) -> int:
        return self._server.socket.getsockname()[1]

    def serve_forever(self) -> None:
        """Accept connections until ``stop`` or ``shutdown``."""
        server = self._server
        self._started.set()
        try:
            with selectors.DefaultSelector() as poll:
                with suppress(ValueError, OSError):  # closed already
                    poll.register(server.shutdown_watcher, selectors.EVENT_READ)
                    poll.register(server.socket, selectors.EVENT_READ)
                while not self._stopped and server.socket.fileno() >= 0:
                    poll.select()
                    self._accept()
        finally:
            server.socket_closed.set()
            server.shutdown_watcher.close()

    def stop(self) -> None:
        """Let ``serve_forever`` return; a signal's handler may call it at any moment."""
        self._stopped = True
        with suppress(OSError):  # ended already
            self._server.shutdown_notifier.send(b"x")

    def shutdown(self) -> None:
        """Close the listening socket and say goodbye to all pages; wait until they are gone."""
        self._server.socket.close()
        if not self._started.is_set():  # else the server would wait for its end
            self._server.socket_closed.set()
            self._server.shutdown_watcher.close()
        self._server.shutdown()

    def hang_up(self) -> None:
        """End what waits for a page that reads no more, or for a client that never asked for anything."""
        with self._changed:
            for client in self._clients.values():
                client.drop()

    def recognise(self, connection: socket) -> None:
        """The client of ``connection`` brought the token: others are dropped before it."""
        with self._changed:
            if client := self._clients.get(connection):
                client.known = True

    def admit_page(self, connection: socket) -> bool:
        """Whether there is space for one more websocket; if so it is never dropped for a new connection."""
        with self._changed:
            client = self._clients.get(connection)
            if client is None or client.dropped or sum(c.page for c in self._clients.values()) >= self._pages:
                return False
            client.page = True
            return True

    def _accept(self) -> None:
        try:
            connection, address = self._server.socket.accept()
        except (BlockingIOError, ConnectionAbortedError):  # the client is gone
            return
        except OSError:
            if self._server.socket.fileno() >= 0:
                with self._changed:
                    _drop_oldest(self._clients.values())
                sleep(PAUSE_S)
            return
        if not self._enter(connection, address[0]):
            connection.close()
            return
        thread = Thread(target=self._talk, args=(connection, address))
        with self._server.lock:
            self._server.handler_threads.add(thread)
        try:
            thread.start()
        except RuntimeError:  # out of threads
            with self._server.lock:
                self._server.handler_threads.discard(thread)
            self._leave(connection)
            connection.close()
            sleep(PAUSE_S)

    def _talk(self, connection: socket, address: Any) -> None:
        try:
            with suppress(OSError):  # gone already
                connection.setsockopt(SOL_SOCKET, SO_SNDTIMEO, struct.pack("ll", SEND_S, 0))
            self._server.handler(connection, address)
        finally:
            self._leave(connection)

    def _enter(self, connection: socket, address: str) -> bool:
        """Whether there is space for ``connection``, made by dropping another where needed."""
        deadline = monotonic() + PATIENCE_S
        with self._changed:
            while crowd := self._crowd(address):
                if not any(client.dropped for client in crowd) and not _drop_oldest(crowd):
                    return False
                if not self._changed.wait(deadline - monotonic()):
                    return False
            self._clients[connection] = _Client(connection, address)
        return True

    def _crowd(self, address: str) -> list[_Client]:
        """Those of whom one must go before another of ``address`` may come."""
        neighbours = [client for client in self._clients.values() if client.address == address]
        if len(neighbours) >= self._per_address:
            return neighbours
        return list(self._clients.values()) if len(self._clients) >= self._limit else []

    def _leave(self, connection: socket) -> None:
        with self._changed:
            self._clients.pop(connection, None)
            self._changed.notify_all()


def _drop_oldest(clients: Iterable[_Client]) -> bool:
    """Drop the oldest that brought no token, else the oldest that is no page; False where there is none."""
    candidates = [client for client in clients if not client.page and not client.dropped]
    if candidates:
        min(candidates, key=lambda client: client.known).drop()
    return bool(candidates)
