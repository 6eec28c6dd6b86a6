"""``kill -9`` at random times: files under a final name are complete, and training resumes along the same curve."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import av
import numpy as np

from rnd_bench.scenes.subject import Subject
from rnd_runtime.avatar.avatar import Avatar
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.images import read_image
from rnd_runtime.motion.motion import save_motion
from rnd_trainer.model.checkpoint import load_checkpoint, read_tensors
from rnd_trainer.training.state import STATE_SCHEMA

from .figures import Figure, at_most, holds
from .processes import TRAIN, Command, environment, export, play
from .small import studio

STEPS, SAVED_EVERY = 48, 4
STEP_SECONDS = 60.0  # latest time of a kill after the start
PATIENCE = 4  # runs per kill, at most: some end before they are killed


def kill_all(subject: Subject, times: int) -> list[Figure]:
    """Kill training, export and play ``times`` times each.

    Training resumes after each kill; each complete curve is compared with an unbroken one.
    """
    folder = subject.work / "kill"
    folder.mkdir(parents=True, exist_ok=True)
    save_motion(folder / "walk.npz", subject.walk(1.0))
    options = f"--preset quick --steps {STEPS} --save-every {SAVED_EVERY} --gaussians 400 --image-scale 0.5".split()

    def train(out: str) -> Command:
        return TRAIN, [str(studio(subject).folder), *options, "--out", str(folder / out)]

    rng, figures = np.random.default_rng(6), []

    def kill(name: str, command: Command, duration: float, ended: Callable[[], None] = lambda: None) -> None:
        """Add the figure of a command that takes ``duration`` seconds; ``ended`` is called after each complete run."""
        wrong: set[str] = set()
        killed = runs = 0
        while killed < times and runs < PATIENCE * times:
            runs += 1
            if _killed(_resuming(command, folder / name), folder, float(rng.uniform(0.3, 1.0)) * duration):
                killed += 1
            else:
                ended()
            wrong |= set(incomplete_files(folder / name))
        figures.append(holds(f"{name}: killed {killed} of {times} times, files that are not whole", sorted(wrong)))

    exporting = export(subject.checkpoint, folder / "export/avatar.onnx")
    kill("export", exporting, _timed(exporting, folder))
    playing = play(subject.avatar_file, folder / "walk.npz", folder / "play", "--size", 48, "--format", "png,exr,mp4")
    kill("play", playing, _timed(playing, folder))
    _timed(train("compiled"), folder)  # kernels just compiled sum in another order than kernels from numba's cache
    duration = _timed(train("whole"), folder)
    curves: list[float] = []

    def ended() -> None:
        curves.append(_off(folder / "whole", folder / "training"))
        shutil.rmtree(folder / "training")

    kill("training", train("training"), duration, ended)
    _timed(_resuming(train("training"), folder / "training"), folder)
    ended()
    text = f"training, {len(curves)} times to its end: curve off the unbroken one"
    return [*figures, at_most(text, max(curves), 0)]


def _resuming(command: Command, out: Path) -> Command:
    return (command[0], [*command[1], "--resume"]) if (out / "training.state").exists() else command


def _started(command: Command, folder: Path, errors: int) -> subprocess.Popen[str]:
    """A process with one thread: bits are compared."""
    line = [sys.executable, "-c", f"import sys; from {command[0]} import main; sys.exit(main())", *command[1]]
    env = environment(OMP_NUM_THREADS="1", NUMBA_NUM_THREADS="1")
    return subprocess.Popen(line, cwd=folder, env=env, stdout=subprocess.DEVNULL, stderr=errors, text=True)


def _timed(command: Command, folder: Path) -> float:
    """Seconds of a complete run."""
    begin = time.monotonic()
    process = _started(command, folder, subprocess.PIPE)
    errors = process.communicate()[1]
    if process.returncode != 0:
        raise InputError(f"{command[0]} failed", got=errors.strip()[-300:] or process.returncode)
    return min(time.monotonic() - begin, STEP_SECONDS)


def _killed(command: Command, folder: Path, after: float) -> bool:
    """Kill a command ``after`` seconds; whether it was still running."""
    process = _started(command, folder, subprocess.DEVNULL)
    try:
        process.wait(after)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
        return True
    return False


def incomplete_files(folder: Path) -> list[str]:
    """Files under their final names that cannot be read completely."""
    readers: dict[str, Callable[[Path], object]] = {
        ".png": read_image,
        ".exr": read_image,
        ".onnx": Avatar.load,
        ".ckpt": load_checkpoint,
        ".state": lambda path: read_tensors(path, STATE_SCHEMA),
        ".json": lambda path: json.loads(path.read_text(encoding="utf-8")),
        ".mp4": _decode,
    }
    wrong = []
    for path in sorted(folder.rglob("*")):
        if path.is_file() and not path.name.startswith(".") and path.suffix in readers:
            try:
                readers[path.suffix](path)
            except Exception as error:
                wrong.append(f"{path.name}: {type(error).__name__}")
    return wrong


def _decode(path: Path) -> None:
    with av.open(str(path)) as container:
        if not list(container.decode(video=0)):
            raise ValueError("no frames")


def _off(unbroken: Path, resumed: Path) -> float:
    """Largest difference of any term in two metrics logs; infinite for missing or repeated rows."""
    logs = [
        [json.loads(line) for line in (folder / "metrics.jsonl").read_text(encoding="utf-8").splitlines()]
        for folder in (unbroken, resumed)
    ]
    curves = [{(row["step"], name): row[name] for row in log for name in row if name != "seconds"} for log in logs]
    if len(logs[0]) != len(logs[1]) or curves[0].keys() != curves[1].keys():
        return float("inf")
    return float(max(abs(value - curves[1][key]) for key, value in curves[0].items()))
