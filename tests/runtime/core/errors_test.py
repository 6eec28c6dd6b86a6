"""One line that names what, expected, got, file and frame; and the exit codes of commands."""

import errno
import os
import signal
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest
import tyro

from rnd_runtime.core.command import parse_options, run_command
from rnd_runtime.core.errors import InputError, refuse_changed
from rnd_runtime.core.files import write_json


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (InputError("poses"), "poses"),
        (InputError("poses", expected="numbers", got="NaN"), "poses: expected numbers, got NaN"),
        (InputError("poses", got=0), "poses: got 0"),
        (InputError("poses", expected=24), "poses: expected 24"),
        (
            InputError("poses", expected="numbers", got="NaN", file=Path("a/walk.npz"), frame=17),
            "a/walk.npz: frame 17: poses: expected numbers, got NaN",
        ),
        (InputError("poses", frame=0, hint="are these degrees?"), "frame 0: poses (are these degrees?)"),
        (InputError("poses", got="two\n  lines\t"), "poses: got two lines"),
        (InputError("not found", file="two  spaces.npz"), "two  spaces.npz: not found"),
    ],
)
def test_message(error, line):
    assert str(error) == line


def test_a_place_found_later_is_added_once():
    error = InputError("size", expected=1, got=2, hint="resize it").at(file="a.png", frame=3)
    assert str(error) == "a.png: frame 3: size: expected 1, got 2 (resize it)"
    assert str(error.at(file="b.png", frame=9)) == str(error)
    assert str(InputError("size").at(frame=0).at(frame=5)) == "frame 0: size"


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


@dataclass
class Options:
    size: int = 3
    least: float = 0.0
    most: float | None = None
    count: int | None = None


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["--siez", "5"], "unrecognized options: --siez, 5 (perhaps --size; see rnd-x y --help)"),
        (["--size"], "missing value for argument '--size'. Expected 1 values (see rnd-x y --help)"),
        (["--size", "5x"], "--size: expected a whole number, got 5x (see rnd-x y --help)"),
        (["--least", "5x"], "--least: expected a number, got 5x (see rnd-x y --help)"),
        (["--most", "5x"], "--most: expected a number, got 5x (see rnd-x y --help)"),
        (["--count", "5x"], "--count: expected a whole number, got 5x (see rnd-x y --help)"),
    ],
)
def test_what_tyro_has_against_a_command_line_is_one_line(words, line, capsys):
    def command() -> None:
        parse_options(lambda: tyro.cli(Options, prog="rnd-x y", args=words))

    assert run_command("rnd-x", command) == 2
    assert capsys.readouterr() == ("", f"rnd-x: {line}\n")


@dataclass
class Places:
    run: tyro.conf.Positional[Path]
    """folder of rnd-x"""
    to: tyro.conf.Positional[Path]
    """another"""


def test_what_is_missing_is_told_with_what_it_is(capsys):
    run_command("rnd-x", lambda: parse_options(lambda: tyro.cli(Places, prog="rnd-x", args=[])))
    line = "rnd-x: missing from rnd-x: PATH folder of rnd-x; PATH another (see rnd-x --help)\n"
    assert capsys.readouterr() == ("", line)


@dataclass
class Files:
    file: tyro.conf.Positional[Path]
    out: Path | None = None
    lights: tuple[Path, ...] = ()


@pytest.mark.parametrize(
    ("words", "name"),
    [(["", "--out", "b"], "PATH"), (["a", "--out", ""], "--out"), (["a", "--lights", "b", ""], "--lights")],
)
def test_an_empty_path_is_refused(words, name, capsys):
    """To Path it would be the folder that we are in."""
    assert run_command("rnd-x", lambda: parse_options(lambda: tyro.cli(Files, prog="rnd-x", args=words))) == 2
    line = f"rnd-x: {name}: expected a path, got nothing (see rnd-x --help)\n"
    assert capsys.readouterr().err == line


@dataclass
class Named(Options):
    name: str = "a"


def test_what_is_not_as_its_class_has_it_is_refused():
    refuse_changed(Named(size=4), ("name",), "no use")
    refuse_changed(Named(), ("name", "size"), "no use")
    with pytest.raises(InputError, match=r"^--size: expected the default, got 4 \(no use\)$"):
        refuse_changed(Named(size=4), ("name", "size"), "no use")


def test_options_that_are_right_and_help_pass(capsys):
    assert parse_options(lambda: tyro.cli(Options, args=["--size", "5"])) == Options(5)
    with pytest.raises(SystemExit) as leaving:
        parse_options(lambda: tyro.cli(Options, args=["--help"]))
    assert not leaving.value.code and "--size" in capsys.readouterr().out


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
        "import sys; from rnd_runtime.core.command import run_command\n"
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
from rnd_runtime.core.command import run_command
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
    ignore = (lambda: signal.signal(signal.SIGINT, signal.SIG_IGN)) if ignored else None
    command = [sys.executable, "-c", _COMMAND, str(tmp_path / "a.txt"), ending]
    done = subprocess.run(command, capture_output=True, text=True, timeout=25, preexec_fn=ignore)
    assert (done.returncode, done.stderr) == (130, "rnd-x: interrupted\n")
    assert not list(tmp_path.iterdir())


def test_a_terminal_without_our_letters_still_shows_the_rest():
    words = "from rnd_runtime.core.command import run_command; run_command('rnd-x', lambda: print('\u03b1 \u2264 1'))"
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
    words = "from rnd_runtime.core.command import run_command as run; raise SystemExit(run('rnd-x', lambda: print('done')))"
    done = subprocess.run(f'"{sys.executable}" -c "{words}" {closed}', shell=True, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
