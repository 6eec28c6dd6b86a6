"""End a command by a signal at any moment: one line on stderr, exit code 128 + number, no temporary left.

The handlers do not raise: between two bytecodes of a library an exception would become another error. A command
that ends in its own way, as a training saves first, does so at the first signal (``on_signal``).
"""

from __future__ import annotations

import atexit
import os
import shutil
import signal
import socket
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType

ENDING = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
"""signals of users, queues and terminals that end a program"""
PATIENCE_S = 2.0
"""seconds after which a signal ends a main thread that is busy in a library"""
_SHOW_CURSOR = "\x1b[?25h\n"  # a progress bar hides it


class _State:
    """Of this process."""

    def __init__(self) -> None:
        self.name = "rnd-avatar"
        self.first = 0  # number of the first signal
        self.handled = 0  # signals handled by the main thread
        self.callbacks: list[Callable[[], None]] = []
        self.cleanups: dict[object, Callable[[], object]] = {}
        self.lock = threading.RLock()  # who ends keeps it, so that no temporary is added
        self.ending = threading.Lock()
        self.ender = 0  # the thread that holds ``ending``
        self.installed = False
        self.wakeup: socket.socket | None = None  # of the watcher; open as long as the handlers are there


_state = _State()


def received() -> int:
    """The number of the first signal since the handlers are installed; 0 for none."""
    return _state.first


def install_in_command() -> None:
    """Handle signals to the end of this process if it is one of the commands ``rnd-…``, while it still imports."""
    program = Path(sys.argv[0]).stem if sys.argv else ""
    if program.startswith("rnd-") and threading.current_thread() is threading.main_thread():
        _install(program)
        atexit.register(_ignore_signals)


def _ignore_signals() -> None:
    """Ignore signals while the interpreter shuts down, so that they change no exit code."""
    for number in ENDING:
        signal.signal(number, signal.SIG_IGN)


@contextmanager
def handled(name: str) -> Iterator[None]:
    """Let signals end this process as the command ``name``; those that the parent ignores (``nohup``) stay ignored.

    The handlers go with the block. Outside of the main thread, which alone may set them, nothing changes.
    """
    if _state.installed or threading.current_thread() is not threading.main_thread():
        yield
        return
    remove = _install(name)
    try:
        yield
    finally:
        remove()


def _install(name: str) -> Callable[[], None]:
    """Set the handlers and return what restores those before."""
    _state.name, _state.first, _state.handled, _state.installed = name, 0, 0, True
    numbers = [number for number in ENDING if signal.getsignal(number) is not signal.SIG_IGN]
    before = {number: signal.signal(number, _handle) for number in numbers}
    reading, writing = socket.socketpair()
    writing.setblocking(False)
    _state.wakeup = writing
    wakeup = signal.set_wakeup_fd(writing.fileno(), warn_on_full_buffer=False)
    threading.Thread(target=_watch, args=[reading], name="signals", daemon=True).start()

    def remove() -> None:
        signal.set_wakeup_fd(wakeup)
        for number, handler in before.items():
            signal.signal(number, handler)
        writing.close()
        _state.installed = False

    return remove


@contextmanager
def on_signal(callback: Callable[[], None]) -> Iterator[None]:
    """Call ``callback`` in the main thread at the first signal instead of ending the process; the second ends it.

    Outside of a command the first Ctrl-C is taken so, and the second raises ``KeyboardInterrupt``.
    """
    _state.callbacks.append(callback)
    alone = not _state.installed and threading.current_thread() is threading.main_thread()
    before = signal.signal(signal.SIGINT, _handle) if alone else None
    if alone:
        _state.first = 0
    try:
        yield
    finally:
        if alone:
            signal.signal(signal.SIGINT, before)
        _state.callbacks.remove(callback)


@contextmanager
def at_end(cleanup: Callable[[], object]) -> Iterator[None]:
    """Call ``cleanup`` if a signal ends the process within the block, maybe more than once and in another thread."""
    key = object()
    with _state.lock:
        _state.cleanups[key] = cleanup
    try:
        yield
    finally:
        _state.cleanups.pop(key, None)


@contextmanager
def temporary_folder() -> Iterator[Path]:
    """A new folder, removed after the block, also where a signal ends the process."""
    with _state.lock:
        folder = tempfile.mkdtemp(prefix="rnd-")
        remove = at_end(lambda: shutil.rmtree(folder, ignore_errors=True))
        remove.__enter__()
    try:
        yield Path(folder)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        remove.__exit__(None, None, None)


def _handle(number: int, frame: FrameType | None) -> None:
    _state.handled += 1
    if _state.first == 0:
        _state.first = number
        if _state.callbacks:
            _state.callbacks[-1]()
            return
    if not _state.installed:
        raise KeyboardInterrupt
    _end(number)


def _watch(reading: socket.socket) -> None:
    """End the process where the main thread does not: a call of C that takes long lets handlers wait."""
    received = 0
    with reading:
        while number := reading.recv(1):
            if number[0] not in ENDING:
                continue
            received += 1
            if received == 1 and _state.callbacks:  # it is asked to end and may take its time
                continue
            time.sleep(PATIENCE_S)
            if _state.installed and _state.handled < received:
                _end(number[0])


def _end(number: int) -> None:
    """Clean up, print the line, end the process. Once: further signals find it ending, other threads wait for it."""
    if not _state.ending.acquire(blocking=False):
        if _state.ender != threading.get_ident():
            time.sleep(PATIENCE_S)  # children are gone: the command would end as if it were done
        return
    _state.ender = threading.get_ident()
    _state.lock.acquire(timeout=1.0)
    _clean_up()
    for child in _children():
        with suppress(OSError):
            os.kill(child, signal.SIGTERM)
    line = f"{_state.name}: interrupted\n"
    if sys.modules["__main__"].__name__ != "__mp_main__":  # as in a process that the command has started
        with suppress(OSError, ValueError):
            os.write(2, ((_SHOW_CURSOR if os.isatty(2) else "") + line).encode())
    _clean_up()  # what other threads have put back meanwhile
    os._exit(128 + number)


def _clean_up() -> None:
    for cleanup in reversed(list(_state.cleanups.values())):
        with suppress(Exception):
            cleanup()


def _children() -> list[int]:
    """Processes that this one has started; none where the system does not list them."""
    try:
        tasks = list(Path("/proc/self/task").iterdir())
        return [int(word) for task in tasks for word in (task / "children").read_text().split()]
    except OSError:
        return []
