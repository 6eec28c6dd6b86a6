"""What the commands share: exit codes, options, help, log lines. For commands only; a library raises and returns.

A command is a dataclass of options and a function::

    def main(arguments: Sequence[str] | None = None) -> int:
        return run_command("rnd-x", lambda: work(parse(Options, "rnd-x", arguments)))

``main`` imports what compiles kernels: ``core.kernels.prepare_process`` comes before numba.

The docstring of ``Options`` is the help's description and ends with an example line; each field's is the option's help.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import signal
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, make_dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar

import tyro
from tyro.constructors import PrimitiveConstructorSpec

from rnd_runtime.core.budget import set_max_expanded
from rnd_runtime.core.errors import InputError, printable, withheld
from rnd_runtime.core.kernels import prepare_process
from rnd_runtime.core.signals import handled, received
from rnd_runtime.core.threads import cores

from .parsing import names, refusal, refuse_unknown, registry

Options = TypeVar("Options")
MAX_SIDE = 16384
"""pixels of a frame's side: OpenGL's usual limit; a larger one is a typo that would fill the memory"""
_SIZES = {"480p": (854, 480), "720p": (1280, 720), "1080p": (1920, 1080), "1440p": (2560, 1440), "2160p": (3840, 2160)}


_MAX_LOG = 2000  # characters of a line on stderr


# --- running -------------------------------------------------------------------------------------------------------


@dataclass
class _Running:
    """The command of this process."""

    name: str = "rnd-avatar"
    quiet: bool = False


_running = _Running()


def run_command(name: str, main: Callable[[], int | None]) -> int:
    """Prepare the process, run ``main`` as the command ``name`` and return its exit code.

    2 for an ``InputError`` and for a file that the machine withholds (one line on stderr); 130 for Ctrl-C, 143 for
    SIGTERM, 129 for SIGHUP (``core.signals``); 141, silently, where the reader of stdout has gone
    (``rnd-play --help | head``); otherwise what ``main`` returns. A letter that the terminal lacks becomes ``?``.
    """
    note = prepare_process()
    _running.name, _running.quiet = name, False
    for stream in ("stdout", "stderr"):
        if getattr(sys, stream) is None:  # closed by the parent process
            setattr(sys, stream, Path(os.devnull).open("w", encoding="utf-8"))  # noqa: SIM115
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")
    if note is not None and "--quiet" not in sys.argv:  # options are not parsed yet
        log(note)
    try:
        try:
            with handled(name):
                cores()  # refuses what numba would trip over at its import
                return main() or 0
        finally:
            sys.stdout.flush()  # at exit Python would complain of a closed pipe
    except InputError as error:
        _error(str(error))
        return 2
    except KeyboardInterrupt:
        _error("interrupted")
        return 128 + (received() or signal.SIGINT)
    except MemoryError as error:
        _error("memory is full" + (f": {error}" if str(error) else ""))
        return 1
    except BrokenPipeError:
        with contextlib.suppress(io.UnsupportedOperation):  # a test's stdout is no file
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # for what is left in it
        return 128 + 13  # as a shell reports SIGPIPE
    except OSError as error:
        if (reason := withheld(error)) is None:
            raise
        _error(reason)
        return 2


def is_quiet() -> bool:
    """Whether ``--quiet`` was given."""
    return _running.quiet


def log(line: str) -> None:
    """Print one line on stderr, after the command's name; nothing under ``--quiet``."""
    if not _running.quiet:
        _error(line)


def warn(message: str) -> None:
    """Log a warning."""
    log(f"warning: {message}")


def show(line: str) -> None:
    """Print a line of the result on stdout; nothing under ``--quiet``."""
    if not _running.quiet:
        print(line, flush=True)  # noqa: T201


def finish(result: object, summary: str = "", *, then: str | None = None) -> None:
    """Print the result's path, its ``summary``, and the command that comes ``then``; if quiet, the path."""
    print(result if _running.quiet or not summary else f"{result}: {summary}", flush=True)  # noqa: T201
    if then is not None:
        show(f"next: {then}")


def _error(line: str) -> None:
    print(f"{_running.name}: {printable(line, _MAX_LOG)}", file=sys.stderr, flush=True)  # noqa: T201


# --- types of options ----------------------------------------------------------------------------------------------


def _default_hint(default: str) -> str:
    return "" if default in ("", "''", "None", "False") else f"(default: {default})"


def option(metavar: str | None = None, **settings: Any) -> Any:
    """The annotation of an option with this metavar; its help names a default if there is one."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint=_default_hint, **settings)


def group(name: str) -> Any:
    """The annotation of a dataclass of options as a field of another: a group of its own in the help."""
    return tyro.conf.OmitArgPrefixes, tyro.conf.arg(name=name)


def parse_size(text: str) -> tuple[int, int | None]:
    """``512`` → (512, None); ``640x480`` → (640, 480); ``720p`` → (1280, 720). ``ValueError`` for anything else."""
    if text in _SIZES:
        return _SIZES[text]
    match = re.fullmatch(r"(\d{1,6})(?:x(\d{1,6}))?", text)
    sides = [int(side) for side in match.groups() if side] if match else [0]
    if not all(1 <= side <= MAX_SIDE for side in sides):
        raise ValueError(f"expected N, WxH, 720p or 1080p, a side of 1 to {MAX_SIDE}, got {text or 'nothing'}")
    return sides[0], sides[1] if len(sides) > 1 else None


def size_text(size: tuple[int, int | None]) -> str:
    """``512`` or ``640x480``: what ``parse_size`` reads."""
    return "x".join(str(side) for side in size if side is not None)


_SIZE: PrimitiveConstructorSpec[Any] = PrimitiveConstructorSpec(
    nargs=1,
    metavar="N|WxH",
    instance_from_str=lambda words: parse_size(words[0]),
    is_instance=lambda value: value is None or isinstance(value, tuple),
    str_from_instance=lambda size: [] if size is None else [size_text(size)],
)

File = Annotated[Path, option("FILE")]
OptionalFile = Annotated[Path | None, option("FILE")]
Files = Annotated[tuple[Path, ...], option("FILE ...")]
Folder = Annotated[Path, option("FOLDER")]
OptionalFolder = Annotated[Path | None, option("FOLDER")]
Count = Annotated[int, option("N")]
OptionalCount = Annotated[int | None, option("N")]
Number = Annotated[float, option("N")]
OptionalNumber = Annotated[float | None, option("N")]
Flag = Annotated[bool, tyro.conf.FlagCreatePairsOff, option()]
Size = Annotated[tuple[int, int | None], _SIZE, option("N|WxH")]
OptionalSize = Annotated[tuple[int, int | None] | None, _SIZE, option("N|WxH")]


# --- parsing -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _General:
    quiet: Flag = False
    """Print errors and the result's path only."""
    version: Flag = False
    """Print the version and exit."""
    max_expand_mb: OptionalCount = None
    """MB that a file may expand to while it is read (default: 256, or 16 times its size)."""


def parse(
    kind: type[Options], prog: str, arguments: Sequence[str] | None = None, *, unknown: Mapping[str, str] | None = None
) -> Options:
    """The options of the class ``kind`` on the command line of ``prog``.

    Args:
        arguments: the process's own when None.
        unknown: hints for options that the command does not take: name without dashes → sentence.

    Raises:
        InputError: in one line, for what cannot be parsed.
    """
    words = _words(prog, arguments)
    refuse_unknown([*names(kind), *names(_General)], prog, words, unknown or {})
    options: Options = _parsed(lambda: tyro.cli(_with_general(kind), prog=prog, args=words, registry=registry()))
    return options


def parse_subcommand(
    kinds: Mapping[str, type[Any]],
    prog: str,
    arguments: Sequence[str] | None = None,
    *,
    description: str,
    unknown: Mapping[str, str] | None = None,
) -> Any:
    """As ``parse`` for a command with subcommands: an instance of the class that the first word names.

    Without arguments the help is printed.
    """
    words = _words(prog, arguments) or ["--help"]
    if words[0] in kinds:
        taken = [*names(kinds[words[0]]), *names(_General)]
        refuse_unknown(taken, f"{prog} {words[0]}", words[1:], unknown or {})
    commands: dict[str, Callable[..., Any]] = {name: _with_general(kind) for name, kind in kinds.items()}
    return _parsed(
        lambda: tyro.extras.subcommand_cli_from_dict(
            commands, prog=prog, args=words, description=description, registry=registry()
        )
    )


def _words(prog: str, arguments: Sequence[str] | None) -> list[str]:
    words = list(sys.argv[1:] if arguments is None else arguments)
    if "--version" in words:
        from rnd_runtime import __version__

        print(f"{prog} {__version__}")  # noqa: T201
        raise SystemExit(0)
    return words


def _with_general(kind: type[Any]) -> type[Any]:
    return make_dataclass(
        kind.__name__,
        [
            ("options", Annotated[kind, tyro.conf.arg(name="")]),
            ("general", Annotated[_General, *group("general")], field(default_factory=_General)),
        ],
        namespace={"__doc__": kind.__doc__},
    )


def _parsed(parser: Callable[[], Any]) -> Any:
    page = io.StringIO()
    try:
        with contextlib.redirect_stderr(page):
            parsed = parser()
    except SystemExit as leaving:
        if not leaving.code:  # --help
            raise
        raise refusal(page.getvalue()) from None
    sys.stderr.write(page.getvalue())
    _running.quiet = parsed.general.quiet
    set_max_expanded(parsed.general.max_expand_mb)
    return parsed.options
