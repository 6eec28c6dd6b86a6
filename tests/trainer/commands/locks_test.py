"""Two trainings, or two imports, into one folder: the second is told who holds it."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from rnd_runtime.cli.lock import LOCK_FILE
from rnd_runtime.core.kernels import COMPILING
from rnd_trainer.commands.data import main as rnd_data
from rnd_trainer.commands.train import main as rnd_train
from support import layouts
from support.imported import LAYOUTS

HOLD = """
import sys
from rnd_runtime.cli.lock import folder_lock
with folder_lock(sys.argv[1], "rnd-play"):
    print("held", flush=True)
    sys.stdin.read()
"""


def _train(capture: Path, out: Path) -> int:
    words = ["--preset", "quick", "--steps", "4", "--gaussians", "200", "--image-scale", "0.5"]
    return rnd_train([str(capture), "--out", str(out), *words])


def _import(source: Path, out: Path) -> int:
    with pytest.raises(SystemExit) as ended:
        rnd_data(["import", str(source), str(out), "--body", str(layouts.body_file(out.parent))])
    assert isinstance(ended.value.code, int)
    return ended.value.code


@pytest.fixture(params=["rnd-train", "rnd-data import"])
def work(request, tmp_path) -> tuple[str, Callable[[Path], int], str]:
    """A command's name, the command into a folder, and what it calls while it holds that."""
    if request.param == "rnd-train":
        folder = request.getfixturevalue("tiny_capture").folder
        return request.param, lambda out: _train(folder, out), "rnd_trainer.commands.train._run_with_progress"
    source = LAYOUTS["ZJU-MoCap"].write_into(tmp_path / "source")
    return request.param, lambda out: _import(source, out), "rnd_trainer.importing.importer.write_capture"


def test_the_second_is_told_who_holds_the_folder(work, tmp_path, capfd):
    _, command, _ = work
    words = [sys.executable, "-c", HOLD, str(tmp_path / "out")]
    (tmp_path / "out").mkdir()
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout and holder.stdout.readline() == "held\n"
        assert command(tmp_path / "out") == 2
        holder.communicate()
    assert f"got rnd-play (process {holder.pid}" in capfd.readouterr().err.splitlines()[-1]
    assert not list((tmp_path / "out").iterdir())


def test_the_first_holds_it_while_it_works(work, tmp_path, monkeypatch, capfd):
    name, command, inner = work
    out, held = tmp_path / "out", []

    def look(*_: object, **__: object) -> None:
        held.append((out / LOCK_FILE).read_text())
        raise KeyboardInterrupt

    monkeypatch.setattr(inner, look)
    assert command(out) == 130
    assert name in held[0] and str(os.getpid()) in held[0]
    assert not (out / LOCK_FILE).exists()


def test_a_training_says_that_it_compiles_first(tiny_capture, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("rnd_trainer.commands.train._run_with_progress", _stop)
    for cold in (True, False):
        monkeypatch.setattr("rnd_trainer.commands.train.kernels_are_cold", lambda package, cold=cold: cold)
        assert _train(tiny_capture.folder, tmp_path / str(cold)) == 130
        assert (f"rnd-train: {COMPILING}\n" in capsys.readouterr().err) == cold


def _stop(*_: object) -> None:
    raise KeyboardInterrupt
