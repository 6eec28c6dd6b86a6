"""``kill -9`` at random moments: what stands under a final name is whole, and training goes on along the same curve."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from rnd_runtime.avatar import Avatar
from rnd_runtime.errors import InputError
from rnd_runtime.images import read_image
from rnd_trainer.checkpoint import load_checkpoint, read_tensors
from rnd_trainer.train import STATE_SCHEMA

from .commands import EXPORT, PLAY, TRAIN, environment
from .figures import Figure, at_most, holds
from .subject import Subject
from .trainings import studio

STEPS = 24
STEP_SECONDS = 60.0
"""a command that takes longer is killed at the latest then"""


def kill_all(subject: Subject, times: int) -> list[Figure]:
    """Kill training, export and play ``times`` times each; then let the training finish and compare its curve."""
    folder = subject.work / "kill"
    folder.mkdir(parents=True, exist_ok=True)
    capture = studio(subject).folder
    motion = folder / "walk.npz"
    from rnd_runtime.motion import save_motion

    save_motion(motion, subject.walk(1.0))
    train = [
        str(capture), "--preset", "quick", "--steps", str(STEPS), "--gaussians", "400", "--image-scale", "0.5",
    ]  # fmt: skip
    play = [str(subject.avatar_file), "--motion", str(motion), "--size", "48", "--format", "png,exr,mp4"]
    jobs: dict[str, tuple[str, list[str]]] = {
        "training": (TRAIN, [*train, "--out", str(folder / "training")]),
        "export": (EXPORT, [str(subject.checkpoint), "--out", str(folder / "export/avatar.onnx")]),
        "play": (PLAY, [*play, "--out", str(folder / "play")]),
    }
    whole = folder / "whole"
    duration = {name: _timed(module, arguments, folder) for name, (module, arguments) in jobs.items()}
    (folder / "training").rename(whole)
    rng = np.random.default_rng(6)
    figures = []
    for name, (module, arguments) in jobs.items():
        wrong: list[str] = []
        killed = 0
        for _ in range(times):
            more = ["--resume"] if name == "training" and (folder / name / "training.state").exists() else []
            moment = float(rng.uniform(0.3, 1.0)) * duration[name]
            killed += _killed(module, [*arguments, *more], folder, moment)
            wrong += half_files(folder / name)
        figures.append(
            holds(f"{name}: killed {killed} of {times} runs, files that are not whole", sorted(set(wrong)))
        )
    module, arguments = jobs["training"]
    more = ["--resume"] if (folder / "training/training.state").exists() else []
    _timed(module, [*arguments, *more], folder)
    figures.append(
        at_most("training after all kills: curve off the unbroken one", _off(whole, folder / "training"), 0)
    )
    return figures


def _command(module: str, arguments: list[str]) -> list[str]:
    return [sys.executable, "-c", f"import sys; from {module} import main; sys.exit(main())", *arguments]


def _timed(module: str, arguments: list[str], folder: Path) -> float:
    """Seconds of a run to its end. One thread: its bits are compared."""
    started = time.monotonic()
    env = environment(OMP_NUM_THREADS="1", NUMBA_NUM_THREADS="1")
    done = subprocess.run(
        _command(module, arguments), cwd=folder, env=env, capture_output=True, text=True, check=False
    )
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
    """Largest difference of two metrics logs; infinite when rows are missing or doubled."""
    curves = [
        [json.loads(line) for line in (folder / "metrics.jsonl").read_text(encoding="utf-8").splitlines()]
        for folder in (whole, resumed)
    ]
    if [row["step"] for row in curves[0]] != [row["step"] for row in curves[1]]:
        return float("inf")
    return max(abs(a["image"] - b["image"]) for a, b in zip(*curves))
