"""One writer a folder or a file at a time: a second one is refused, naming the first."""

from __future__ import annotations

import errno
import glob
import json
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from time import monotonic, sleep, strftime

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import temporary_stem
from rnd_runtime.core.signals import at_end

try:
    import fcntl
except ImportError:  # Windows: folders are not locked
    fcntl = None  # type: ignore[assignment]

LOCK_FILE = ".rnd-lock"
_SETTLING_S = 2.0  # in which whoever has just locked a file has written who he is
_NO_LOCKS = {errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS, errno.EROFS, errno.EACCES}


class _HeldError(Exception):
    """Another process holds the lock: the message says which."""


@contextmanager
def folder_lock(folder: str | Path, command: str, *, shared_by: str | None = None) -> Iterator[None]:
    """Hold ``folder`` for ``command``; the kernel lets go of it however the process ends.

    Args:
        folder: an existing folder that the command writes into.
        command: its name, for whoever comes second.
        shared_by: processes that give the same text hold the folder together, as parts of one clip do.

    Raises:
        InputError: another process holds it. A file system without locks is written to without one.
    """
    with _held(Path(folder) / LOCK_FILE, "folder", folder, command, shared_by):
        yield


@contextmanager
def file_lock(file: str | Path, command: str) -> Iterator[None]:
    """Hold the output ``file`` for ``command`` and remove what earlier writers of it, who were killed, left behind.

    Raises:
        InputError: another process writes it.
    """
    file = Path(file)
    with _held(file.with_name(f".{file.name[:64]}{LOCK_FILE}"), "file", file, command, None) as held:
        for left in file.parent.glob(glob.escape(temporary_stem(file)) + "????????" + file.suffix) if held else ():
            left.unlink(missing_ok=True)
        yield


@contextmanager
def _held(path: Path, what: str, held: str | Path, command: str, shared_by: str | None) -> Iterator[bool]:
    """Lock the file ``path`` on behalf of ``held``; whether the file system has locks."""
    if fcntl is None:
        yield False
        return
    try:
        stream = _locked(path, command, shared_by)
    except _HeldError as error:
        raise InputError(f"{what} is being written to", got=error, file=held, hint="choose another --out") from None
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            raise
        stream = None
    with at_end(lambda: _remove(path, stream)):
        try:
            yield stream is not None
        finally:
            _remove(path, stream)
            if stream is not None:
                os.close(stream)


def _remove(path: Path, stream: int | None) -> None:
    """Remove the lock's file if nobody else holds it."""
    if stream is not None:
        with suppress(OSError):
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
            path.unlink(missing_ok=True)


def _locked(path: Path, command: str, shared_by: str | None) -> int:
    while True:
        stream = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        try:
            _take(stream, path, command, shared_by)
            with suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(stream), path.stat()):
                    return stream
        except BaseException:
            os.close(stream)
            raise
        os.close(stream)  # its holder took the file away meanwhile: lock the new one


def _take(stream: int, path: Path, command: str, shared_by: str | None) -> None:
    give_up = monotonic() + _SETTLING_S
    while True:
        with suppress(BlockingIOError):
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
            break
        holder = _holder(stream)
        if shared_by is not None and holder.get("shared_by") == shared_by:
            with suppress(BlockingIOError):
                fcntl.flock(stream, fcntl.LOCK_SH | fcntl.LOCK_NB)
                return
        elif holder or monotonic() > give_up:
            known = {"command": "another command", "pid": "?", "host": "?", "since": "?", **holder}
            raise _HeldError("{command} (process {pid} on {host}, since {since})".format_map(known))
        sleep(0.02)  # the holder is about to write its note, or to share
    note = {"command": command, "pid": os.getpid(), "host": socket.gethostname(), "since": strftime("%H:%M:%S")}
    os.ftruncate(stream, 0)
    os.pwrite(stream, json.dumps({**note, "shared_by": shared_by}).encode(), 0)
    if shared_by is not None:
        fcntl.flock(stream, fcntl.LOCK_SH)


def _holder(stream: int) -> dict[str, str]:
    try:
        note = json.loads(os.pread(stream, 4096, 0))
    except ValueError:
        return {}
    return {str(key): str(value) for key, value in note.items()} if isinstance(note, dict) else {}
