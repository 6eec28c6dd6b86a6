"""``kill -9`` at random moments: what stands under a final name is whole, and training goes on along the same curve."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from rnd_bench.scenes.figures import Figure, at_most, holds
from rnd_bench.scenes.subject import Subject
from rnd_runtime.avatar.avatar import Avatar
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.images import read_image
from rnd_trainer.model.checkpoint import load_checkpoint, read_tensors
from rnd_trainer.training.state import STATE_SCHEMA

from .commands import EXPORT, PLAY, TRAIN, environment
from .trainings import studio

STEPS, SAVED_EVERY = 48, 4
STEP_SECONDS = 60.0
"""a command that takes longer is killed at the latest then"""
PATIENCE = 4
"""runs for each kill, at most: some end by themselves before they are killed"""


def kill_all(subject: Subject, times: int) -> list[Figure]:
    """Kill training, export and play ``times`` times each.

    Training goes on after each kill from its last state; whenever it comes to its end its curve is compared with an
    unbroken one, and the next starts anew.
    """
    folder = subject.work / "kill"
    folder.mkdir(parents=True, exist_ok=True)
    capture = studio(subject).folder
    motion = folder / "walk.npz"
    from rnd_runtime.motion.motion import save_motion

    save_motion(motion, subject.walk(1.0))
    train = [
        str(capture),
        "--preset",
        "quick",
        "--steps",
        str(STEPS),
        "--save-every",
        str(SAVED_EVERY),
        "--gaussians",
        "400",
        "--image-scale",
        "0.5",
    ]
    play = [str(subject.avatar_file), "--motion", str(motion), "--size", "48", "--format", "png,exr,mp4"]
    rounds = _Rounds(folder, times)
    export = [str(subject.checkpoint), "--out", str(folder / "export/avatar.onnx")]
    rounds.kill("export", EXPORT, export, _timed(EXPORT, export, folder))
    play += ["--out", str(folder / "play")]
    rounds.kill("play", PLAY, play, _timed(PLAY, play, folder))
    # first once for nothing: what numba has just compiled adds in another order than what it finds compiled
    _timed(TRAIN, [*train, "--out", str(folder / "compiled")], folder)
    duration = _timed(TRAIN, [*train, "--out", str(folder / "whole")], folder)
    curves: list[float] = []

    def ended() -> None:
        curves.append(_off(folder / "whole", folder / "training"))
        shutil.rmtree(folder / "training")

    line = [*train, "--out", str(folder / "training")]
    rounds.kill("training", TRAIN, line, duration, folder / "training/training.state", ended)
    _timed(TRAIN, [*line, *_resumed(folder / "training/training.state")], folder)
    ended()
    text = f"training, {len(curves)} times to its end: curve off the unbroken one"
    return [*rounds.figures, at_most(text, max(curves), 0)]


class _Rounds:
    """Kills of one command after the other at random moments, until there are ``times`` of each."""

    def __init__(self, folder: Path, times: int) -> None:
        self.folder, self.times = folder, times
        self.figures: list[Figure] = []
        self._rng = np.random.default_rng(6)

    def kill(
        self,
        name: str,
        module: str,
        arguments: list[str],
        duration: float,
        state: Path | None = None,
        ended: Callable[[], None] = lambda: None,
    ) -> None:
        """Add the figure of ``name``, which takes ``duration`` seconds when nobody kills it.

        With a ``state`` runs go on from it; ``ended`` follows each that comes to its end.
        """
        wrong: set[str] = set()
        killed = runs = 0
        while killed < self.times and runs < PATIENCE * self.times:
            runs += 1
            moment = float(self._rng.uniform(0.3, 1.0)) * duration
            if _killed(module, [*arguments, *_resumed(state)], self.folder, moment):
                killed += 1
            else:
                ended()
            wrong |= set(half_files(self.folder / name))
        text = f"{name}: killed {killed} of {self.times} times, files that are not whole"
        self.figures.append(holds(text, sorted(wrong)))


def _resumed(state: Path | None) -> list[str]:
    return ["--resume"] if state is not None and state.exists() else []


def _command(module: str, arguments: list[str]) -> list[str]:
    return [sys.executable, "-c", f"import sys; from {module} import main; sys.exit(main())", *arguments]


def _timed(module: str, arguments: list[str], folder: Path) -> float:
    """Seconds of a run to its end. One thread: its bits are compared."""
    started = time.monotonic()
    env = environment(OMP_NUM_THREADS="1", NUMBA_NUM_THREADS="1")
    done = subprocess.run(_command(module, arguments), cwd=folder, env=env, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise InputError(f"{module} failed", got=done.stderr.strip()[-300:] or done.returncode)
    return min(time.monotonic() - started, STEP_SECONDS)


def _killed(module: str, arguments: list[str], folder: Path, after: float) -> bool:
    """Start, wait, kill; whether it was still running."""
    env = environment(OMP_NUM_THREADS="1", NUMBA_NUM_THREADS="1")
    process = subprocess.Popen(
        _command(module, arguments), cwd=folder, env=env, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        process.wait(after)
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGKILL)
        process.wait()
        return True
    return False


def half_files(folder: Path) -> list[str]:
    """Files under their final names that cannot be read whole."""
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
    import av

    with av.open(str(path)) as container:
        if not list(container.decode(video=0)):
            raise ValueError("no frames")


def _off(whole: Path, resumed: Path) -> float:
    """Largest difference of any term in two metrics logs; infinite when rows are missing or doubled."""
    logs = [
        [json.loads(line) for line in (folder / "metrics.jsonl").read_text(encoding="utf-8").splitlines()]
        for folder in (whole, resumed)
    ]
    curves = [{(row["step"], name): row[name] for row in log for name in row if name != "seconds"} for log in logs]
    if len(logs[0]) != len(logs[1]) or curves[0].keys() != curves[1].keys():
        return float("inf")
    return float(max(abs(value - curves[1][key]) for key, value in curves[0].items()))
