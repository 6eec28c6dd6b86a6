"""The one exception for a user's mistake, and how a command reports it."""

from __future__ import annotations

import contextlib
import errno
import io
import os
import re
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

Parsed = TypeVar("Parsed")
# By which queues, systems and terminals that are closed end a program.
_ENDINGS = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
# No permission, a file system that is read-only, full, full for this user, or that takes no such name: nobody's
# mistake in the program.
_OF_THE_MACHINE = {errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOSPC, errno.EDQUOT, errno.ENAMETOOLONG}


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
        super().__init__(" ".join(filter(None, map(str.strip, line.splitlines()))))

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


def run_command(name: str, main: Callable[[], int | None]) -> int:
    """Run ``main`` as the command ``name`` and return its exit code.

    2 for an ``InputError`` and for a file that the machine withholds (one line on stderr), 130 for Ctrl-C and for
    SIGTERM and SIGHUP, which are the same to us, 141 in silence where nobody reads the output to its end
    (``rnd-play --help | head``), otherwise what ``main`` returns. A terminal that cannot show a letter shows a ?. What
    is said to a stream that was closed is lost.
    """
    for stream in ("stdout", "stderr"):
        if getattr(sys, stream) is None:  # closed by who started us
            setattr(sys, stream, Path(os.devnull).open("w", encoding="utf-8"))  # noqa: SIM115
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")
    try:
        try:
            with _ended_as_interrupted():
                return main() or 0
        finally:
            sys.stdout.flush()  # not only when Python ends, who would complain of a closed pipe
    except InputError as error:
        print(f"{name}: {error}", file=sys.stderr)  # noqa: T201
        return 2
    except KeyboardInterrupt:
        print(f"{name}: interrupted", file=sys.stderr)  # noqa: T201
        return 130
    except BrokenPipeError:
        with contextlib.suppress(io.UnsupportedOperation):  # a test's stdout is no file
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # for what is left in it
        return 128 + 13  # as a shell reports SIGPIPE
    except OSError as error:
        if (reason := withheld(error)) is None:
            raise
        print(f"{name}: {reason}", file=sys.stderr)  # noqa: T201
        return 2


def withheld(error: OSError) -> str | None:
    """The line for a file that the machine withholds; None of any other error."""
    if error.errno not in _OF_THE_MACHINE:
        return None
    place = "" if error.filename is None else f"{error.filename}: "
    return f"{place}{error.strerror}"


@contextlib.contextmanager
def _ended_as_interrupted() -> Iterator[None]:
    """Take what else ends a program, if not ignored (``nohup``), for Ctrl-C: what is begun is saved or taken away."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        on_interrupt = signal.getsignal(signal.SIGINT)
        if not callable(on_interrupt):  # Ctrl-C is ignored, as in the background of a shell
            raise KeyboardInterrupt
        on_interrupt(signal.SIGINT, frame)

    if threading.current_thread() is not threading.main_thread():  # only the main thread may handle signals
        yield
        return
    endings = [number for number in _ENDINGS if signal.getsignal(number) is not signal.SIG_IGN]
    before = {number: signal.signal(number, interrupt) for number in endings}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def parse_options(parse: Callable[[], Parsed]) -> Parsed:
    """What ``parse``, a call of tyro's, makes of the command line, where no path is empty.

    Raises:
        InputError: what tyro has against it, a page with a frame around it, in one line.
    """
    page = io.StringIO()
    try:
        with contextlib.redirect_stderr(page), _paths():
            options = parse()
    except SystemExit as leaving:
        if not leaving.code:  # --help
            raise
        raise _refusal(page.getvalue()) from None
    sys.stderr.write(page.getvalue())
    return options


def _paths() -> ConstructorRegistry:
    """By which tyro takes paths as it does by itself, but no empty ones."""
    from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec

    registry = ConstructorRegistry()

    @registry.primitive_rule
    def rule(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Path] | None:
        if info.type is not Path:
            return None
        return PrimitiveConstructorSpec(
            nargs=1,
            metavar="PATH",
            instance_from_str=_path_of,
            is_instance=lambda value: isinstance(value, Path),
            str_from_instance=lambda path: [str(path)],
        )

    return registry


def _path_of(words: list[str]) -> Path:
    if not words[0]:
        raise ValueError("no path")  # Path("") is the folder that we are in
    return Path(words[0])


_NO_PATH = re.compile(r"^Error parsing (\S+): .*(no path|''\])$")
_NOT_A_NUMBER = re.compile(r"^Error parsing (\S+): .*?\b(int|float)\b.*?'(.*)'\]?$", re.IGNORECASE)


def _no_number(found: re.Match[str]) -> str:
    kind = "a whole number" if found[2].lower() == "int" else "a number"
    return f"{found[1]}: expected {kind}, got {found[3]}"


def _refusal(page: str) -> InputError:
    """A page of tyro's: a title, what is wrong, perhaps what was meant, where to read more, with rules between them."""
    lines = [line.strip(" │╭╮╰╯") for line in page.splitlines()][1:]
    parts = re.split(r"^[-─]+$", "\n".join(lines), flags=re.MULTILINE)
    parts = [part.strip() for part in parts if part.strip()] or [page]
    what = parts[0].split("\n\n")[0].removesuffix(".").replace(" (required)", ";").rstrip(";")
    what = _NOT_A_NUMBER.sub(_no_number, " ".join(what.split()))
    what = _NO_PATH.sub(r"\1: expected a path, got nothing", what)
    meant = next((part.splitlines()[1].split()[0] for part in parts if part.startswith("Perhaps")), None)
    hint = [f"perhaps {meant.rstrip(',')}"] if meant else []
    hint += [f"see {command}" for command in re.findall(r"[\w-]+(?: \w+)* --help", parts[-1])]
    if not what[:2].isupper():  # as a metavar is
        what = what[:1].lower() + what[1:]
    return InputError(what, hint="; ".join(hint) or None)
