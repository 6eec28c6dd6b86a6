"""Rows H2, H3, H5, H7 and H8: read-only machines, signals, small images, two writers, idle clients."""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from rnd_bench.scenes.subject import Subject
from rnd_bench.stability.figures import Figure, Result, at_most, below, holds, reported, result
from rnd_bench.stability.processes import EXPORT, PLAY, TRAIN, Command, environment, export, play
from rnd_bench.stability.small import studio
from rnd_bench.stability.soak_view import visit_idle
from rnd_runtime.cli.lock import LOCK_FILE
from rnd_runtime.core.camera import Camera
from rnd_runtime.motion.motion import Motion, save_motion
from rnd_runtime.playback import far
from rnd_runtime.playback.frame import FrameRenderer

CONVERT, VIEWER, DATA = "rnd_viewer.convert.cli", "rnd_viewer.view.cli", "rnd_trainer.commands.data"
MOMENTS_S, PATIENCE_S = 4.0, 60.0
_NAMES = {PLAY: "rnd-play", CONVERT: "rnd-convert", VIEWER: "rnd-view", TRAIN: "rnd-train", DATA: "rnd-data"}
_NAMES[EXPORT] = "rnd-export"
_NUMBERS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
FOCAL, HEIGHT_M = 4000.0, 1.75
NEAR_PX, FAR_PX = 384, (100, 40, 16)
SMALLEST_PX = 8
IDLE = 300
"""connections that ask for nothing: more than the 262 that once ended the server"""
_NOWHERE = {"HOME": "/nonexistent", "XDG_CACHE_HOME": "/nonexistent", "NUMBA_CACHE_DIR": ""}


def _started(command: Command, folder: Path, **more: str) -> subprocess.Popen[str]:
    """A command that heeds all signals, also those that its parent ignores."""
    module, arguments = command
    name = _NAMES[module]
    code = (
        "import signal, sys; signal.signal(signal.SIGHUP, signal.SIG_DFL); "
        "signal.signal(signal.SIGINT, signal.default_int_handler); "
        f"sys.argv[0] = {name!r}; from {module} import main; sys.exit(main())"
    )
    return subprocess.Popen(
        [sys.executable, "-c", code, *arguments],
        cwd=folder,
        env=environment(**more),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )


def _motion_file(subject: Subject, folder: Path, seconds: float) -> Path:
    save_motion(folder / "walk.npz", subject.walk(seconds))
    return folder / "walk.npz"


def no_home(subject: Subject) -> Result:
    """H2: no home and no cache folder: the kernels go to a temporary one, with one line."""
    folder = subject.work / "no_home"
    folder.mkdir(parents=True, exist_ok=True)
    wrong = []
    for words in (["--help"], ["--doctor"])[subject.few(1, 0) :]:
        process = _started((PLAY, words), folder, **_NOWHERE)
        errors = process.communicate()[1]
        if process.returncode != 0 or "Traceback" in errors:
            wrong.append(f"{words[0]}: exit {process.returncode}, {errors[-80:]!r}")
    return result(holds("commands that fail without a home", wrong))


def signals(subject: Subject) -> Result:
    """H3: SIGINT, SIGTERM and SIGHUP at random moments of each command."""
    names = ["rnd-play", "rnd-convert", "rnd-view", "rnd-export", "rnd-train", "rnd-data"][: subject.few(1, 6)]
    return result(*(signals_to(subject, name, subject.few(1, 50)) for name in names))


def signals_to(subject: Subject, name: str, count: int) -> Figure:
    """The figure of H3 for the command ``name``, signalled ``count`` times."""
    folder, rng, wrong, sent = subject.work / "signals" / name, np.random.default_rng(4), list[str](), 0
    folder.mkdir(parents=True, exist_ok=True)
    out, motion, avatar = folder / "out", _motion_file(subject, folder, 4.0), str(subject.avatar_file)
    if name == "rnd-play":
        command = play(subject.avatar_file, motion, out, "--size", 64, "--format", "png,exr,mp4")
    elif name == "rnd-convert":
        command = CONVERT, ["splats", avatar, "--motion", str(motion), "--out", str(out), "--frames", "0:100"]
    elif name == "rnd-view":
        command = VIEWER, [avatar, "--port", "0", "--no-browser", "--size", "64"]
    elif name == "rnd-export":
        command = export(subject.checkpoint, out / "avatar.onnx")
    elif name == "rnd-train":
        words = ["--out", str(out), "--preset", "quick", "--gaussians", "400"]
        command = TRAIN, [str(studio(subject).folder), *words]
    else:
        command = DATA, ["check", str(studio(subject).folder), "--out", str(out)]
    for k in range(count):
        shutil.rmtree(out, ignore_errors=True)
        fault = _interrupted(command, folder, _NUMBERS[k % 3], float(rng.uniform(0, MOMENTS_S)))
        sent += fault is not None
        wrong += [fault] if fault else []
        wrong += [f"left {file.name}" for file in out.rglob(".*") if not file.name.startswith(".run-")]
    return holds(f"{name}: {sent} signals that did not end it in one line with its code", wrong)


def _interrupted(command: Command, folder: Path, number: signal.Signals, after: float) -> str | None:
    """Signal a command ``after`` seconds; its fault, "" for none, None where it had ended before.

    Seconds count from its handlers on: before, Python itself is being loaded.
    """
    process = _started(command, folder)
    while process.poll() is None and not _handles(process.pid, signal.SIGTERM):
        time.sleep(0.01)
    time.sleep(after)
    process.send_signal(number)
    try:
        errors = process.communicate(timeout=PATIENCE_S)[1]
    except subprocess.TimeoutExpired:
        process.kill()
        errors = process.communicate()[1]
    code = process.returncode
    if code == 0:
        return None
    ended = code == 128 + number and "Traceback" not in errors and errors.rstrip().endswith(": interrupted")
    return "" if ended else f"{number.name} after {after:.2f} s: exit {code}, {errors[-60:]!r}"


def _handles(process: int, number: signal.Signals) -> bool:
    """Whether ``process`` handles the signal; True where the system does not tell."""
    try:
        status = Path(f"/proc/{process}/status").read_text(encoding="ascii")
    except OSError:
        return True
    return bool(int(status.split("SigCgt:")[1].split()[0], 16) >> (number - 1) & 1)


def far_away(subject: Subject) -> Result:
    """H5: coverage and energy per (pixel of height)² of a body that recedes, over those of a near one."""
    middle = np.array([0.0, float(np.mean(subject.rest.means[:, 1])), 0.0])
    motion, measured = subject.walk(1.0), {}
    with FrameRenderer(subject.avatar, subject.light, shade="table") as renderer:
        for limit in (far.MIN_PIXELS_PER_METRE, 0.0):
            kept, far.MIN_PIXELS_PER_METRE = far.MIN_PIXELS_PER_METRE, limit
            try:
                sizes = (NEAR_PX, *FAR_PX, SMALLEST_PX)
                measured[limit] = [_amounts(renderer, motion, middle, pixels) for pixels in sizes]
            finally:
                far.MIN_PIXELS_PER_METRE = kept
    figures = []
    changes, plain = (np.abs(np.array(rows[1:]) / rows[0] - 1) * 100 for rows in measured.values())
    for k, what in enumerate(("coverage", "energy")):
        worst, plain_worst = float(changes[:-1, k].max()), float(plain[:-1, k].max())
        figures.append(
            below(f"{what} from 100 to 16 px, change", worst, 5, "%", baseline=("no finer grid", plain_worst))
        )
        smallest, plain_smallest = float(changes[-1, k]), float(plain[-1, k])
        figures.append(below(f"{what} at 8 px, change", smallest, 10, "%", baseline=("no finer grid", plain_smallest)))
    return result(*figures)


def _amounts(renderer: FrameRenderer, motion: Motion, middle: np.ndarray, pixels: int) -> list[float]:
    """Coverage and energy, averaged over two positions in the pixel grid."""
    amounts = []
    for offset in (0.0, 0.37):
        side = int(1.5 * pixels) + 8
        K = np.array([[FOCAL, 0, side / 2 + offset], [0, FOCAL, side / 2 - offset], [0, 0, 1]])
        world_to_camera = np.diag([1.0, -1.0, -1.0, 1.0])
        world_to_camera[:3, 3] = [-middle[0], middle[1], FOCAL * HEIGHT_M / pixels]
        frame = renderer.render(motion, 0.5, Camera(side, side, K, world_to_camera))
        amounts.append([float(frame.alpha.sum()), float(frame.radiance.sum())])
    return [total / pixels**2 for total in np.mean(amounts, axis=0)]


def two_writers(subject: Subject) -> Result:
    """H7: of two different plays into one folder the second is told who holds it."""
    folder, wrong = subject.work / "two", list[str]()
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    motion = _motion_file(subject, folder, 600.0)
    commands = [play(subject.avatar_file, motion, folder / "out", "--size", size) for size in (256, 128)]
    first = _started(commands[0], folder)
    try:
        while first.poll() is None and not (folder / "out" / LOCK_FILE).exists():
            time.sleep(0.02)
        second = _started(commands[1], folder)
        errors = second.communicate()[1]
        held = first.poll() is None
        if held and (second.returncode != 2 or f"process {first.pid}" not in errors):
            wrong.append(f"exit {second.returncode}, {errors[-120:]!r}")
    finally:
        first.kill()
        ended = first.communicate()[1]
    if not held:
        wrong.append(f"the first ended before the second began: {ended[-80:]!r}")
    return result(holds("second writers not told who holds the folder", wrong))


def idle_clients(subject: Subject) -> Result:
    """H8: connections that ask for nothing end neither rnd-view nor its answers."""
    seconds, ended = visit_idle(subject, subject.few(100, IDLE))
    return result(
        at_most("rnd-view ended by idle connections", int(ended), 0),
        reported("answer to a page beside them", seconds, "s"),
    )
