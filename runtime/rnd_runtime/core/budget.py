"""The bytes and the seconds that one file may cost while it is read."""

from __future__ import annotations

import time
from pathlib import Path

from .errors import InputError

_MIN_BYTES = 256 << 20
_EXPANSION = 16  # times the file's size
_SECONDS = 60.0
_limit: int | None = None  # bytes, of this process; None: by the file's size


def set_max_expanded(megabytes: int | None) -> None:
    """Set what any file may expand to, in this process; None for the default.

    The default is the larger of 256 MB and 16 times the file's size.
    """
    global _limit  # one limit of the process
    if megabytes is not None and megabytes < 1:
        raise InputError("--max-expand-mb", expected="at least 1", got=megabytes)
    _limit = None if megabytes is None else megabytes << 20


class Budget:
    """Remaining bytes and seconds of a file; both are counted before they are spent.

    Args:
        file_bytes: the file's size.
        file: for messages.
        seconds: from now on.
    """

    def __init__(self, file_bytes: int, *, file: str | Path | None = None, seconds: float = _SECONDS) -> None:
        self.limit = _limit or max(_MIN_BYTES, _EXPANSION * file_bytes)
        self.left = self.limit
        self._file, self._seconds, self._end = file, seconds, time.monotonic() + seconds

    @classmethod
    def of(cls, path: str | Path) -> Budget:
        """The budget of the file at ``path``."""
        return cls(Path(path).stat().st_size, file=path)

    def take(self, count: int, what: str = "data") -> None:
        """Count ``count`` bytes that ``what`` is about to fill.

        Raises:
            InputError: the file would expand to more than its limit, or its time is over.
        """
        self.left -= int(count)
        if self.left < 0:
            raise InputError(
                f"{what} expands too far",
                expected=f"at most {self.limit >> 20} MB in all",
                got=f"{(self.limit - self.left) >> 20} MB or more",
                file=self._file,
                hint="--max-expand-mb N allows more",
            )
        self.check_time(what)

    def check_time(self, what: str = "data") -> None:
        """Raise ``InputError`` where the file's time is over."""
        if time.monotonic() > self._end:
            raise InputError(what, expected=f"to be read within {self._seconds:g} s", got="more", file=self._file)
