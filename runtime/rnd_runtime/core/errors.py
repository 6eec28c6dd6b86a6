"""The one exception for a user's mistake, and the checks that raise it."""

from __future__ import annotations

import errno
import unicodedata
from collections.abc import Iterable
from pathlib import Path

_MAX_LINE = 500  # characters of a line of which a file may have written parts
_TAIL = 150  # of them, at its end
_WITHHELD = {errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOSPC, errno.EDQUOT, errno.ENAMETOOLONG}


class InputError(Exception):
    """Something the user gave us cannot be used.

    The message is one line made of what is wrong, what was expected, what was found, and where::

        walk.npz: frame 17: poses: expected finite numbers, got NaN

    Raised at the border (files, command lines, public functions) and shown without a traceback; commands
    exit with code 2.
    """

    def __init__(
        self,
        what: str,
        *,
        expected: object = None,
        got: object = None,
        file: str | Path | None = None,
        frame: int | None = None,
        hint: str | None = None,
    ) -> None:
        words = [str(file)] if file is not None else []
        if frame is not None:
            words.append(f"frame {frame}")
        line = ": ".join([*words, what])
        if expected is not None:
            line += f": expected {expected}"
        if got is not None:
            line += f"{', ' if expected is not None else ': '}got {got}"
        if hint is not None:
            line += f" ({hint})"
        self.what, self.expected, self.got, self.hint = what, expected, got, hint
        self.file, self.frame = file, frame
        super().__init__(printable(" ".join(filter(None, map(str.strip, line.splitlines())))))

    def at(self, *, file: str | Path | None = None, frame: int | None = None) -> InputError:
        """The same mistake with the file or the frame, where it lacks them."""
        return InputError(
            self.what,
            expected=self.expected,
            got=self.got,
            file=file if self.file is None else self.file,
            frame=frame if self.frame is None else self.frame,
            hint=self.hint,
        )


def printable(line: str, most: int = _MAX_LINE) -> str:
    """``line`` for a terminal: control characters escaped, the middle left out beyond ``most`` characters."""
    if len(line) > most:
        line = f"{line[: most - _TAIL - 3]} … {line[-_TAIL:]}"
    if line.isprintable():
        return line
    escaped = (c if c.isprintable() or unicodedata.category(c) == "Zs" else _escaped(c) for c in line)
    line = "".join(escaped)
    return line if len(line) <= most else f"{line[: most - 2]} …"


def _escaped(character: str) -> str:
    return character.encode("unicode_escape").decode()


def refuse_changed(options: object, names: Iterable[str], hint: str) -> None:
    """Raise ``InputError`` for one of ``names`` that is not as its class has it: it would do nothing."""
    for name in names:
        value = getattr(options, name)
        if value != getattr(type(options), name):
            raise InputError(flag(name), expected="the default", got=value, hint=hint)


def refuse_outside(options: object, limits: dict[str, tuple[float, float]]) -> None:
    """Raise ``InputError`` for a number, where there is one, beyond its ``limits`` (least, most), by field."""
    for name, (low, high) in limits.items():
        value = getattr(options, name)
        if value is not None and not low <= value <= high:  # false for NaN
            raise InputError(flag(name), expected=f"{low:g} to {high:g}", got=value)


def flag(name: str) -> str:
    """How an option is written on the command line."""
    return "--" + name.replace("_", "-")


def check_option(good: bool, name: str, expected: str, got: object) -> None:
    """Raise ``InputError`` for the option ``name`` unless it is ``good``."""
    if not good:
        raise InputError(name, expected=expected, got=got)


def check_cull(cosine: float | None) -> None:
    """Raise ``InputError`` for the option ``--cull`` unless it is a cosine, or was not given."""
    check_option(cosine is None or -1 <= cosine <= 1, "--cull", "a cosine, from -1 to 1", cosine)


def withheld(error: OSError) -> str | None:
    """The line for a file that the machine withholds; None of any other error."""
    if error.errno not in _WITHHELD:
        return None
    file = "" if error.filename is None else f"{error.filename}: "
    return f"{file}{error.strerror}"


def first_line(error: Exception) -> str:
    """Of the message of an error, at most 300 letters; the name of its class if it has none.

    For exceptions of libraries on a user's file. A lack of memory is not the file's fault.

    Raises:
        MemoryError: ``error`` is one, or says that memory could not be allocated.
    """
    line = next(iter(str(error).strip().splitlines()), type(error).__name__)[:300]
    if isinstance(error, MemoryError) or "allocate memory" in line or "bad_alloc" in line:
        raise MemoryError(line) from error
    return line
