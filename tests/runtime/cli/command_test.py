"""Commands: exit codes, one line for each refusal, help, version, quiet."""

import errno
import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import pytest
import tyro

from rnd_runtime import __version__
from rnd_runtime.cli import command
from rnd_runtime.cli.command import (
    MAX_SIDE,
    Count,
    File,
    Files,
    Flag,
    OptionalCount,
    OptionalFile,
    OptionalNumber,
    OptionalSize,
    finish,
    group,
    log,
    parse,
    parse_size,
    parse_subcommand,
    run_command,
    show,
    size_text,
)
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import write_json


def _raise(error: BaseException):
    raise error


def test_commands_report_in_one_line_and_by_exit_code(capsys):
    assert run_command("rnd-x", lambda: _raise(InputError("no such thing", file="a.npz"))) == 2
    assert capsys.readouterr().err == "rnd-x: a.npz: no such thing\n"
    assert run_command("rnd-x", lambda: _raise(KeyboardInterrupt())) == 130
    assert capsys.readouterr().err == "rnd-x: interrupted\n"
    assert run_command("rnd-x", lambda: None) == 0
    assert run_command("rnd-x", lambda: 7) == 7
    assert capsys.readouterr() == ("", "")


@dataclass(frozen=True)
class Camera:
    """The view."""

    distance: OptionalNumber = None
    """metres"""
    turn: Flag = False
    """around"""


@dataclass(frozen=True)
class Options:
    """Do something.

    rnd-x a.npz --hdr sky.exr
    """

    file: tyro.conf.Positional[File]
    """what to read"""
    out: OptionalFile = None
    """where to write"""
    hdr: Files = ()
    """lights"""
    size: OptionalSize = None
    """of a frame"""
    steps: Count = 3
    """how many"""
    most: OptionalCount = None
    """at most"""
    mode: Literal["fast", "good"] = "fast"
    """how"""
    camera: Annotated[Camera, *group("camera")] = field(default_factory=Camera)


def _run(words: Sequence[str], **settings) -> int:
    return run_command("rnd-x", lambda: print(parse(Options, "rnd-x", words, **settings)))


def test_options_are_read(capsys):
    words = [
        "a",
        "--out",
        "b",
        "--hdr",
        "c",
        "d",
        "--size",
        "1080p",
        "--steps=5",
        "--most",
        "2",
        "--distance",
        "-1.5",
        "--turn",
        "--mode",
        "good",
    ]
    expected = Options(Path("a"), Path("b"), (Path("c"), Path("d")), (1920, 1080), 5, 2, "good", Camera(-1.5, True))
    assert parse(Options, "rnd-x", words) == expected
    assert parse(Options, "rnd-x", ["a"]) == Options(Path("a"))


@pytest.mark.parametrize(
    ("words", "line"),
    [
        ("a --siez 5", "unknown option --siez (perhaps --size; see rnd-x --help)"),
        ("a --light sky.exr", "--light: rnd-x takes --hdr (see rnd-x --help)"),
        ("a --probe=sky.exr", "--probe: rnd-x takes --hdr (see rnd-x --help)"),
        ("a --magic", "unknown option --magic (say please)"),
        ("a --steps", "--steps: expected a value, got nothing (see rnd-x --help)"),
        ("a --steps 5x", "--steps: expected a whole number, got 5x (see rnd-x --help)"),
        ("a --most 5x", "--most: expected a whole number, got 5x (see rnd-x --help)"),
        ("a --distance far", "--distance: expected a number, got far (see rnd-x --help)"),
        ("a --mode slow", "--mode: expected fast, good, got slow (see rnd-x --help)"),
        ("a --out=", "--out: expected a path, got nothing (see rnd-x --help)"),
        ("--steps 5", "missing from rnd-x: FILE what to read (see rnd-x --help)"),
    ],
)
def test_a_wrong_option_is_one_line(words, line, capsys):
    assert _run(words.split(), unknown={"magic": "say please"}) == 2
    assert capsys.readouterr() == ("", f"rnd-x: {line}\n")


def test_help_has_groups_metavars_and_the_example(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")
    with pytest.raises(SystemExit) as leaving:
        _run(["--help"])
    text = capsys.readouterr().out
    assert not leaving.value.code and "None" not in text and "False" not in text
    for words in ("rnd-x a.npz --hdr sky.exr", "camera options", "general options", "--out FILE", "--size N|WxH"):
        assert words in text
    for words in ("--hdr FILE ...", "--most N", "--distance N", "(default: 3)", "--quiet", "--version"):
        assert words in text


def test_version(capsys):
    with pytest.raises(SystemExit) as leaving:
        _run(["--version"])
    assert not leaving.value.code and capsys.readouterr().out == f"rnd-x {__version__}\n"


def test_a_subcommand_has_options_of_its_own(capsys):
    kinds = {"one": Camera, "two": Options}

    def run(*words: str) -> int:
        return run_command("rnd-x", lambda: print(parse_subcommand(kinds, "rnd-x", words, description="Either.")))

    assert run("one", "--distance", "2") == 0 and capsys.readouterr().out == f"{Camera(2.0)}\n"
    assert run("one", "--light", "a") == 2 and "rnd-x: unknown option --light" in capsys.readouterr().err
    assert run("two", "a", "--light", "a") == 2 and "--light: rnd-x two takes --hdr" in capsys.readouterr().err
    assert run("three") == 2 and "three" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        run()
    assert "Either." in capsys.readouterr().out


def test_quiet_leaves_errors_and_the_results_path(capsys):
    def work(words: list[str]) -> None:
        parse(Options, "rnd-x", words)
        log("busy")
        show("a table")
        finish("out.png", "3 frames", then="rnd-y out.png")

    run_command("rnd-x", lambda: work(["a"]))
    assert capsys.readouterr() == ("a table\nout.png: 3 frames\nnext: rnd-y out.png\n", "rnd-x: busy\n")
    run_command("rnd-x", lambda: work(["a", "--quiet"]))
    assert capsys.readouterr() == ("out.png\n", "") and command.is_quiet()


@pytest.mark.parametrize(
    ("text", "size"), [("512", (512, None)), ("64x48", (64, 48)), ("720p", (1280, 720)), ("1080p", (1920, 1080))]
)
def test_sizes(text, size):
    assert parse_size(text) == size and parse_size(size_text(size)) == size


@pytest.mark.parametrize("text", ["0", "x", "12x", "-5", f"{MAX_SIDE + 1}", "1x99999", "3.5", "", "721p"])
def test_impossible_sizes_are_refused(text):
    with pytest.raises(ValueError, match="expected N, WxH"):
        parse_size(text)


def test_what_the_machine_withholds_is_one_line(capsys):
    full = OSError(errno.ENOSPC, "No space left on device", "out/a.png")
    assert run_command("rnd-x", lambda: _raise(full)) == 2
    assert capsys.readouterr().err == "rnd-x: out/a.png: No space left on device\n"
    assert run_command("rnd-x", lambda: _raise(PermissionError(errno.EACCES, "Permission denied"))) == 2
    assert capsys.readouterr().err == "rnd-x: Permission denied\n"


def test_our_own_mistakes_keep_their_traceback():
    with pytest.raises(ZeroDivisionError):
        run_command("rnd-x", lambda: 1 // 0)
    with pytest.raises(FileNotFoundError):
        run_command("rnd-x", lambda: open("no such file"))  # noqa: PTH123, SIM115


@pytest.mark.parametrize("lines", [1, 100_000])  # less than a pipe holds, and more
@pytest.mark.parametrize("ending", ["", "; raise SystemExit(0)"])
def test_a_reader_who_has_gone_ends_the_command_in_silence(lines, ending):
    program = (
        "import sys; from rnd_runtime.cli.command import run_command\n"
        f"def main():\n    print('line\\n' * {lines}){ending}\n"
        "sys.exit(run_command('rnd-x', main))"
    )
    reading, writing = os.pipe()
    os.close(reading)
    done = subprocess.run(
        [sys.executable, "-c", program], stdout=writing, stderr=subprocess.PIPE, text=True, timeout=60
    )
    os.close(writing)
    assert (done.returncode, done.stderr) == (141, "")


_COMMAND = """
import os, signal, sys, time
from rnd_runtime.cli.command import run_command
from rnd_runtime.core.files import atomic_path

def main():
    with atomic_path(sys.argv[1]) as file:
        file.write_text("half")
        os.kill(os.getpid(), getattr(signal, sys.argv[2]))
        time.sleep(30)

sys.exit(run_command("rnd-x", main))
"""


@pytest.mark.parametrize("ending", ["SIGTERM", "SIGHUP"])
@pytest.mark.parametrize("ignored", [False, True])
def test_a_program_that_is_ended_takes_its_half_files_away(tmp_path, ignored, ending):
    """SIGTERM and SIGHUP, also where a shell that put the command into the background has switched Ctrl-C off."""

    def begin() -> None:
        signal.signal(signal.SIGHUP, signal.SIG_DFL)  # the tests may run under nohup
        if ignored:
            signal.signal(signal.SIGINT, signal.SIG_IGN)

    command = [sys.executable, "-c", _COMMAND, str(tmp_path / "a.txt"), ending]
    done = subprocess.run(command, capture_output=True, text=True, timeout=25, preexec_fn=begin)
    number = getattr(signal, ending)
    assert (done.returncode, done.stderr) == (128 + number, "rnd-x: interrupted\n")
    assert not list(tmp_path.iterdir())


def test_a_terminal_without_our_letters_still_shows_the_rest():
    words = "from rnd_runtime.cli.command import run_command; run_command('rnd-x', lambda: print('\u03b1 \u2264 1'))"
    environment = os.environ | {"PYTHONIOENCODING": "latin-1"}
    done = subprocess.run([sys.executable, "-c", words], capture_output=True, text=True, env=environment)
    assert (done.stdout, done.stderr) == ("? ? 1\n", "")


def test_a_name_that_the_file_system_takes_is_written_and_a_longer_one_is_one_line(tmp_path, capsys):
    longest = os.pathconf(tmp_path, "PC_NAME_MAX")

    def write(letters: int) -> int:
        name = "a" * (letters - 4) + ".txt"
        return run_command("rnd-x", lambda: write_json(tmp_path / name, []))

    assert write(longest) == 0 and len(list(tmp_path.iterdir())) == 1
    assert write(longest + 1) == 2
    error = capsys.readouterr().err
    assert error.endswith("File name too long\n") and error.count("\n") == 1
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize("closed", [">&-", "2>&-"])
def test_streams_that_are_closed_end_nothing(closed):
    words = "from rnd_runtime.cli.command import run_command; exit(run_command('rnd-x', lambda: print('done')))"
    done = subprocess.run(f'"{sys.executable}" -c "{words}" {closed}', shell=True, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
