"""One writer a folder at a time: a second one is refused, naming the first."""

from __future__ import annotations

import errno
import json
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from time import strftime

from .errors import InputError

try:
    import fcntl
except ImportError:  # Windows: folders are not locked
    fcntl = None  # type: ignore[assignment]

LOCK_FILE = ".rnd-lock"
_NO_LOCKS = {errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS, errno.EROFS, errno.EACCES}


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
    path = Path(folder) / LOCK_FILE
    if fcntl is None:
        yield
        return
    try:
        stream = _locked(path, command, shared_by)
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            raise
        stream = None
    try:
        yield
    finally:
        if stream is not None:
            with suppress(OSError):  # the last one takes the file away
                fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
                path.unlink(missing_ok=True)
            os.close(stream)


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
    try:
        fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        holder = _holder(stream)
        if shared_by is not None and holder.get("shared_by") == shared_by:
            with suppress(BlockingIOError):
                fcntl.flock(stream, fcntl.LOCK_SH | fcntl.LOCK_NB)
                return
        who = "{command} (process {pid} on {host}, since {since})".format_map(
            {"command": "another command", "pid": "?", "host": "?", "since": "?", **holder}
        )
        raise InputError("folder is being written to", got=who, file=path.parent, hint="choose another --out") from None
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
