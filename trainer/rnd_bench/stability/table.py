"""``rnd-bench --stability``: every row of the stability list at full size, as JSON, Markdown and pictures.

Rows that were measured before stay in the file until they are measured again, so a run can be stopped and split.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from numba import get_num_threads

from rnd_runtime.core.errors import InputError, check_option, parse_options, run_command
from rnd_runtime.core.files import atomic_path, earlier_rows, sha256_of, write_json
from rnd_runtime.playback.doctor import machine
from rnd_trainer.commands.eval import need_extra

if TYPE_CHECKING:
    from rnd_bench.scenes.figures import Figure, Result
    from rnd_bench.scenes.subject import Subject

SHARED_CAPTURE = Path("../shared/data/capture")
EMBEDDED_CAPTURE = Path("assets/capture")
SMALL_STEPS = 600
"""of the avatar that is trained where none is given"""


@dataclass(frozen=True)
class StabilityOptions:
    """Run the rows of the stability list at full size; with --fuzz, --soak or --kill also what takes hours."""

    checkpoint: Path | None = None
    """avatar.ckpt trained on the capture; without one an avatar is trained on it in some minutes, and is no good one"""
    capture: Path | None = None
    """the pictures it was trained on; by default ../shared/data/capture where present, else assets/capture"""
    json: Path = Path("assets/bench/stability.json")
    """the table; a .md and a folder of pictures stand beside it"""
    rows: Annotated[str, tyro.conf.arg(metavar="LIST")] = "all"
    """such as P1,L8; 'none' for only what is asked for below"""
    size: int = 512
    """side of the pictures in pixels"""
    fuzz: int = 0
    """broken inputs for every reader; resumes in WORK"""
    soak: int = 0
    """frames of playback, and a tenth as many steps of training; resumes"""
    kill: int = 0
    """times that training, export and play are each killed"""
    determinism: bool = False
    """compare the bytes of export and play at one and at two threads, and EGL with OSMesa"""
    work: Path | None = None
    """folder for files in between, kept; by default a temporary one"""


def stability_main(argv: Sequence[str]) -> int:
    """Run ``rnd-bench --stability`` with ``argv``; the exit code is 0 whatever the rows say, 2 for bad options."""

    def command() -> None:
        _stability(parse_options(lambda: tyro.cli(StabilityOptions, prog="rnd-bench --stability", args=argv)))

    return run_command("rnd-bench", command)


def _stability(options: StabilityOptions) -> None:
    need_extra()
    from rich.console import Console

    try:
        from .rows import ROWS, TIMES
    except ModuleNotFoundError as error:
        hint = 'needs the extra: pip install "rnd-avatar[dev]", in a clone ".[dev]"'
        raise InputError(f"{error.name} is not installed", hint=hint) from error

    known = [row.id for row in (*ROWS, TIMES)]
    wanted = known if options.rows == "all" else [] if options.rows == "none" else options.rows.split(",")
    if unknown := set(wanted) - set(known):
        raise InputError("--rows", expected=f"some of {','.join(known)}", got=",".join(sorted(unknown)))
    check_option(16 <= options.size <= 4096, "--size", "16 to 4096", options.size)
    _rows(options)  # before hours go by, not after the first row
    console = Console()
    with tempfile.TemporaryDirectory() as temporary:
        work = options.work or Path(temporary)
        work.mkdir(parents=True, exist_ok=True)
        subject = _subject(options, work)
        measured_on = _measured_on(subject)
        for row in (*ROWS, TIMES):
            if row.id in wanted:
                with console.status(f"{row.id} {row.failure}"):
                    result = row.measure(subject)
                _keep(options, _told(row.on, measured_on), row.id, row.failure, result.figures, result)
                _show(console, row.id, result.figures)
        for name, failure, on, figures in _long_runs(options, subject):
            _keep(options, _told(on, measured_on), name, failure, figures, None)
            _show(console, name, figures)


def _subject(options: StabilityOptions, work: Path) -> Subject:
    """The avatar of the checkpoint, exported here, or one trained in minutes on the capture."""
    from rnd_bench.scenes.subject import Subject
    from rnd_runtime.capture.capture import load_capture

    from .commands import EXPORT, run_commands
    from .trainings import train_small

    checkpoint, folder = options.checkpoint, options.capture
    if folder is None:
        folder = SHARED_CAPTURE if SHARED_CAPTURE.exists() else EMBEDDED_CAPTURE
    capture = load_capture(folder)
    if checkpoint is None:
        checkpoint = train_small(work / "run", capture, SMALL_STEPS, 30_000)
    avatar = work / "avatar.onnx"
    done = run_commands(work, [(EXPORT, [str(checkpoint.resolve()), "--out", str(avatar.resolve())])])[0]
    if done.code != 0:
        raise InputError("the checkpoint cannot be exported", got=done.errors.strip()[-200:], file=checkpoint)
    return Subject(avatar.resolve(), checkpoint.resolve(), capture, work.resolve(), small=False, size=options.size)


def _measured_on(subject: Subject) -> dict[str, Any]:
    """Where, and of the avatar: which, and how large it and its pictures are."""
    return {
        "threads": get_num_threads(),
        "machine": machine(),
        "gaussians": subject.avatar.gaussians,
        "size": subject.size,
        "checkpoint_sha256": sha256_of(subject.checkpoint),
    }


def _told(on: str, measured_on: dict[str, Any]) -> dict[str, Any]:
    """What a row says of what it was measured ``on``: the avatar's numbers where that is the avatar."""
    from rnd_bench.scenes.figures import AVATAR

    places = {name: measured_on[name] for name in ("threads", "machine")}
    return {"on": on, **(measured_on if on == AVATAR else places)}


def _fuzz(options: StabilityOptions, subject: Subject) -> Sequence[Figure]:
    """Figures of --fuzz; with --work a run that was stopped goes on."""
    from rich.console import Console
    from rich.progress import Progress, TimeRemainingColumn

    from .commands import EXPORT, run_commands
    from .fuzz import READERS, batches, fuzz, prepare
    from .trainings import studio, train_small

    folder = subject.work / "fuzz"
    if not (folder / "files/light.hdr").exists():  # which is written last
        capture = studio(subject)
        small = train_small(folder / "run", capture, 12, 200)
        run_commands(folder, [(EXPORT, [str(small), "--out", str(folder / "small.onnx")])])
        prepare(folder / "files", folder / "small.onnx", small, capture.folder)
    columns = (*Progress.get_default_columns()[:-1], TimeRemainingColumn(elapsed_when_finished=True))
    with Progress(*columns, console=Console(stderr=True), speed_estimate_period=600) as progress:
        task = progress.add_task("broken files", total=len(READERS) * batches(options.fuzz))
        figures, record = fuzz(folder / "files", options.fuzz, on_batch=lambda: progress.advance(task))
    write_json(options.json.with_name("stability_fuzz.json"), record)
    return figures


def _long_runs(options: StabilityOptions, subject: Subject) -> Iterable[tuple[str, str, str, Sequence[Figure]]]:
    """What is asked for by --fuzz, --soak, --kill and --determinism: id, failure, what it is measured on, figures."""
    from rnd_bench.scenes.figures import AVATAR

    from .rows import SHORT

    if options.fuzz:
        yield "F", "hostile files", "small files", _fuzz(options, subject)
    if options.soak:
        from .soak import soak_playback, soak_training

        state = subject.work / "soak.json"
        yield "S1", "soak, playback", AVATAR, soak_playback(subject, options.soak, state)
        yield "S2", "soak, training", SHORT, soak_training(subject, options.soak // 10, state)
    if options.kill:
        from .kill import kill_all

        yield "K", "kill -9", "the avatar; trainings of 400 Gaussians", kill_all(subject, options.kill)
    if options.determinism:
        from .determinism import same_bytes

        yield "D", "determinism", AVATAR, same_bytes(subject).figures


def _rows(options: StabilityOptions) -> list[dict[str, Any]]:
    return earlier_rows(options.json, what="rows of rnd-bench --stability", names=("id", "what"))


def _keep(
    options: StabilityOptions,
    measured_on: dict[str, Any],
    name: str,
    failure: str,
    figures: Sequence[Figure],
    result: Result | None,
) -> None:
    """Replace the row's figures in the JSON, write the table again, and the pictures."""
    from rnd_runtime.core.images import write_image

    rows = [row for row in _rows(options) if row["id"] != name]
    rows += [
        {
            "id": name,
            "failure": failure,
            "what": figure.what,
            "measured": figure.measured,
            "unit": figure.unit,
            "line": figure.line,
            "verdict": _verdict(figure),
            "baseline": figure.baseline,
            "baseline_name": figure.baseline_name,
            **measured_on,
        }
        for figure in figures
    ]
    rows.sort(key=lambda row: _place(row["id"]))
    write_json(options.json, rows)
    with atomic_path(options.json.with_suffix(".md")) as temporary:
        temporary.write_text(markdown(rows), encoding="utf-8")
    if result is not None and result.pictures is not None:
        import numpy as np

        ours, reference = result.pictures
        write_image(options.json.with_suffix("") / f"{name}.png", np.concatenate([ours, reference], axis=1))


def _place(name: str) -> tuple[int, int]:
    """Rows in the order of the list: P, G, L, R, then the rest."""
    return "PGLRTFSKD".find(name[0]), int(name[1:] or 0)


def _verdict(figure: Figure) -> str:
    if figure.measured is None:
        return "not measured"
    if not figure.passes:
        return "fail"
    return "pass" if figure.line else "reported"


def markdown(rows: Sequence[dict[str, Any]]) -> str:
    """The rows as a table. JSON has null for NaN: what was measured and is no number is told by its verdict."""
    from rnd_bench.scenes.figures import amount

    lines = ["| id | failure | measured | | line | | the plain method |", "|---|---|---|---|---|---|---|"]
    for row in rows:
        baseline, unit, measured = "", row["unit"], row["measured"]
        if measured is None and row["verdict"] != "not measured":
            measured = math.nan
        if row["baseline_name"]:
            plain = math.nan if row["baseline"] is None else row["baseline"]
            baseline = f"{row['baseline_name']}: {amount(plain, unit)}"
        mark = {"pass": "✓", "fail": "**✗**"}.get(row["verdict"], "")
        what = row["what"].replace("|", "\\|").replace("\n", " ")
        lines.append(
            f"| {row['id']} | {row['failure']} | {what} | {amount(measured, unit)} | {row['line']} | {mark} "
            f"| {baseline} |"
        )
    return "\n".join(lines) + "\n"


def _show(console: Any, name: str, figures: Sequence[Figure]) -> None:
    from rnd_bench.scenes.figures import amount

    for figure in figures:
        baseline = ""
        if figure.baseline is not None:
            baseline = f"  ({figure.baseline_name}: {amount(figure.baseline, '')})"
        mark = {"pass": "✓", "fail": "✗"}.get(_verdict(figure), " ")
        line = f"{mark} {name:4} {figure.what}: {amount(figure.measured, figure.unit)} {figure.line}{baseline}"
        console.print(line, highlight=False, markup=False, emoji=False)
