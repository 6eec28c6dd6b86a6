"""Signals end a command in one line, at any moment, and leave no temporary."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from rnd_runtime.core import signals
from rnd_runtime.core.signals import on_signal, temporary_folder
from support.paths import ASSETS

BIN = Path(sys.executable).parent
HEAD = """
import os, signal, subprocess, sys, threading, time
from rnd_runtime.cli.command import run_command
from rnd_runtime.core.files import atomic_path
from rnd_runtime.core.signals import at_end, on_signal, temporary_folder
def ready():
    print("ready", flush=True)
"""
_SHOWS_HANDLERS = pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="shows no handlers")
ENDINGS = [("SIGINT", 130), ("SIGTERM", 143), ("SIGHUP", 129)]


@pytest.fixture(autouse=True)
def heeded():
    """A runner in the background passes on that Ctrl-C is ignored, and ``nohup`` that hang-ups are."""
    handlers = {signal.SIGINT: signal.default_int_handler, signal.SIGHUP: signal.SIG_DFL}
    before = {number: signal.signal(number, handler) for number, handler in handlers.items()}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def _started(body: str, *words: object) -> subprocess.Popen[str]:
    code = HEAD + body + "\nsys.exit(run_command('rnd-x', main))\n"
    command = [sys.executable, "-c", code, *map(str, words)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd="/")
    assert process.stdout and process.stdout.readline() == "ready\n"
    return process


def _outcome(process: subprocess.Popen[str], timeout: float = 30) -> tuple[int, str]:
    _, errors = process.communicate(timeout=timeout)
    return process.returncode, errors


@pytest.mark.parametrize(("name", "code"), ENDINGS)
def test_code_says_which_signal_it_was(tmp_path, name, code):
    body = """
def main():
    with atomic_path(sys.argv[1] + "/a.txt"), temporary_folder() as folder:
        print("ready", flush=True)
        print(folder, flush=True)
        time.sleep(60)
"""
    process = _started(body, tmp_path)
    folder = Path(process.stdout.readline().strip())
    assert folder.is_dir() and len(list(tmp_path.iterdir())) == 1
    process.send_signal(getattr(signal, name))
    assert _outcome(process) == (code, "rnd-x: interrupted\n")
    assert not list(tmp_path.iterdir()) and not folder.exists()


def test_code_that_takes_exceptions_for_its_own_is_ended_too():
    body = """
def main():
    ready()
    while True:
        try:
            time.sleep(60)
        except BaseException:
            raise SystemError("boxing")
"""
    process = _started(body)
    process.send_signal(signal.SIGINT)
    assert _outcome(process) == (130, "rnd-x: interrupted\n")


def test_main_thread_in_a_long_call_is_ended_by_the_watcher(tmp_path):
    """Python's handler waits for the call to return."""
    body = """
def main():
    import ctypes
    wait = ctypes.CDLL(None).usleep
    with atomic_path(sys.argv[1] + "/a.txt"):
        ready()
        signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGTERM])  # of this thread: another one receives it
        wait(60_000_000)
"""
    process = _started(body, tmp_path)
    begin = time.monotonic()
    process.send_signal(signal.SIGTERM)
    assert _outcome(process) == (143, "rnd-x: interrupted\n")
    assert time.monotonic() - begin < signals.PATIENCE_S + 5
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("name", "code"), ENDINGS)
def test_first_signal_asks_and_the_second_ends(name, code):
    body = """
def main():
    asked = []
    with on_signal(lambda: asked.append(1)):
        ready()
        while not asked:
            time.sleep(0.01)
        print("saving", flush=True)
        time.sleep(float(sys.argv[1]))
    raise KeyboardInterrupt
"""
    for saving, twice in ((0.1, False), (60, True)):
        process = _started(body, saving)
        process.send_signal(getattr(signal, name))
        assert process.stdout.readline() == "saving\n"
        if twice:
            process.send_signal(getattr(signal, name))
        assert _outcome(process) == (code, "rnd-x: interrupted\n")


def test_signals_that_the_parent_ignores_stay_ignored():
    body = "def main():\n    ready()\n    os.kill(os.getpid(), signal.SIGHUP)\n    time.sleep(0.1)\n    return 7"
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        process = _started(body)
    finally:
        signal.signal(signal.SIGHUP, before)
    assert _outcome(process) == (7, "")


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="lists no children")
def test_children_end_with_the_command():
    body = """
def main():
    child = subprocess.Popen(["sleep", "60"])
    ready()
    print(child.pid, flush=True)
    child.wait()
"""
    process = _started(body)
    child = int(process.stdout.readline())
    process.send_signal(signal.SIGTERM)
    assert _outcome(process)[0] == 143
    for _ in range(100):
        try:
            os.kill(child, 0)
        except ProcessLookupError:
            return
        if "Z" in Path(f"/proc/{child}/stat").read_text():  # nobody waits for it here
            return
        time.sleep(0.05)
    pytest.fail("the child runs on")


def test_in_a_library_the_second_ctrl_c_is_pythons():
    asked = []

    def press() -> None:
        os.kill(os.getpid(), signal.SIGINT)

    before = signal.getsignal(signal.SIGINT)
    with on_signal(lambda: asked.append(1)):
        press()
        assert asked == [1]
        with pytest.raises(KeyboardInterrupt):
            press()
    assert signal.getsignal(signal.SIGINT) is before


def test_a_temporary_folder_goes_with_its_block():
    with pytest.raises(ValueError), temporary_folder() as folder:
        (folder / "a").touch()
        raise ValueError
    assert not folder.exists()


def _interrupted(command: list[object], out: Path, after: float, number: int) -> None:
    """Start, wait, send the signal, and check the end; a process that has ended before is started again, sooner."""
    while True:
        process = subprocess.Popen(
            [str(word) for word in command], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
        )
        _wait_for_handlers(process.pid)
        time.sleep(after)
        if process.poll() is None:
            break
        assert process.communicate() and process.returncode == 0
        after /= 2
    process.send_signal(number)
    code, errors = _outcome(process)
    if code == 0:  # its work was done, and the interpreter on its way out
        _interrupted(command, out, after / 2, number)
        return
    assert code == 128 + number, (after, code, errors)
    assert errors.splitlines()[-1].endswith(": interrupted") and "Traceback" not in errors, (after, errors)
    hidden = [file for file in out.rglob(".*") if not file.name.startswith(".run-")]
    assert not hidden, after


def _wait_for_handlers(pid: int) -> None:
    """Until the process handles SIGTERM: before, Python itself is being loaded."""
    while True:
        caught = re.search(r"SigCgt:\s*([0-9a-f]+)", Path(f"/proc/{pid}/status").read_text())
        if caught is None or int(caught[1], 16) >> (signal.SIGTERM - 1) & 1:
            return
        time.sleep(0.01)


def _random_moments(command: list[object], out: Path, times: int, longest: float) -> None:
    random = np.random.default_rng(0)
    for after in random.uniform(0, longest, times):
        _interrupted(command, out, float(after), [signal.SIGINT, signal.SIGTERM][int(random.random() < 0.3)])


@_SHOWS_HANDLERS
def test_rnd_play_at_random_moments(tmp_path):  # four; fifty of each command are row H3 of the stability suite
    out = tmp_path / "out"
    files = [ASSETS / "avatar.onnx", "--motion", ASSETS / "walk.npz", "--out", out]
    _random_moments([BIN / "rnd-play", *files, "--size", 64, "--format", "png,exr,mp4"], out, 4, 4.0)


@_SHOWS_HANDLERS
def test_rnd_convert_at_random_moments(tmp_path):
    out = tmp_path / "out"
    files = [ASSETS / "avatar.onnx", "--motion", ASSETS / "walk.npz", "--out", out]
    _random_moments([BIN / "rnd-convert", "splats", *files, "--format", "ply"], out, 4, 4.0)


@_SHOWS_HANDLERS
def test_rnd_export_at_random_moments(tmp_path, tiny_checkpoint):
    out = tmp_path / "out"
    _random_moments([BIN / "rnd-export", tiny_checkpoint, "--out", out / "avatar.onnx"], out, 4, 6.0)
