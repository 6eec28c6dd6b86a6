"""The one exception for a user's mistake, and how a command reports it."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path


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
        places = [str(file)] if file is not None else []
        if frame is not None:
            places.append(f"frame {frame}")
        line = ": ".join([*places, what])
        if expected is not None:
            line += f": expected {expected}"
        if got is not None:
            line += f"{', ' if expected is not None else ': '}got {got}"
        if hint is not None:
            line += f" ({hint})"
        self.what, self.expected, self.got, self.hint = what, expected, got, hint
        self.file, self.frame = file, frame
        super().__init__(" ".join(line.split()))

    def at(self, *, file: str | Path | None = None, frame: int | None = None) -> InputError:
        """The same mistake with the place it lacked, for callers who know the file or the frame."""
        return InputError(
            self.what,
            expected=self.expected,
            got=self.got,
            file=file if self.file is None else self.file,
            frame=frame if self.frame is None else self.frame,
            hint=self.hint,
        )


def run_command(name: str, main: Callable[[], int | None]) -> int:
    """Run ``main`` as the command ``name`` and return its exit code.

    2 for an :class:`InputError` (one line on stderr), 130 for Ctrl-C, otherwise what ``main`` returns.
    """
    try:
        return main() or 0
    except InputError as error:
        print(f"{name}: {error}", file=sys.stderr)  # noqa: T201
        return 2
    except KeyboardInterrupt:
        print(f"{name}: interrupted", file=sys.stderr)  # noqa: T201
        return 130
