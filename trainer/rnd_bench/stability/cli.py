"""``rnd-bench stability``: every row of the stability list at full size, and the runs of hours."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from rnd_runtime.cli.command import Count, File, Flag, OptionalFile, OptionalFolder, option, show
from rnd_runtime.cli.extras import install_hint
from rnd_runtime.core.errors import InputError, check_option
from rnd_runtime.core.files import sha256_of, write_json
from rnd_runtime.core.signals import temporary_folder

if TYPE_CHECKING:
    from rnd_bench.scenes.subject import Subject

    from .figures import Figure

SMALL_STEPS = 600  # training steps where no checkpoint is given


@dataclass(frozen=True)
class Stability:
    """The cases in which methods of this kind break, beside a plain baseline; --fuzz, --soak and --kill take hours.

    rnd-bench stability assets/capture --rows P1,L8
    """

    capture: Annotated[Path, tyro.conf.Positional, option("CAPTURE")]
    """folder with capture.json"""
    checkpoint: OptionalFile = None
    """avatar.ckpt trained on CAPTURE; by default an avatar of low quality is trained in some minutes"""
    json: File = Path("out/bench/stability.json")
    """the table; a .md and a folder of images are written beside it"""
    rows: Annotated[str, option("LIST")] = "all"
    """such as P1,L8; 'none' for only what is asked for below"""
    size: Count = 512
    """side of the images in pixels"""
    fuzz: Count = 0
    """broken inputs for every reader; resumes in WORK"""
    readers: Annotated[str, option("LIST")] = "all"
    """those of --fuzz, such as pickle,exr"""
    soak: Count = 0
    """frames of playback, and a tenth as many steps of training; resumes in WORK"""
    view: Count = 0
    """minutes for which clients come and go at one rnd-view"""
    kill: Count = 0
    """times that training, export and play are each killed"""
    determinism: Flag = False
    """compare the bytes of export and play at one and at two threads, and EGL with OSMesa"""
    work: OptionalFolder = None
    """folder for intermediate files, kept; by default a temporary one"""


def run(options: Stability) -> None:
    """Measure the chosen rows; each is written as soon as it is measured."""
    try:
        from .rows import ROWS, TIMES
    except ModuleNotFoundError as error:
        raise InputError(f"{error.name} is not installed", hint=install_hint("dev")) from error
    from .table import line_of, rows_of, store

    known = [row.id for row in (*ROWS, TIMES)]
    wanted = known if options.rows == "all" else [] if options.rows == "none" else options.rows.split(",")
    if unknown := set(wanted) - set(known):
        raise InputError("--rows", expected=f"some of {','.join(known)}", got=",".join(sorted(unknown)))
    check_option(16 <= options.size <= 4096, "--size", "16 to 4096", options.size)
    rows_of(options.json)  # refuses another file before hours of work
    temporary = temporary_folder() if options.work is None else nullcontext(options.work)
    with temporary as work:
        work.mkdir(parents=True, exist_ok=True)
        subject = _subject(options, work)

        def keep(name: str, failure: str, on: str, figures: Sequence[Figure], images: Any = None) -> None:
            store(options.json, {"id": name, "failure": failure} | measured_on(on, subject), figures, images)
            for figure in figures:
                show(line_of(name, figure))

        for row in (*ROWS, TIMES):
            if row.id in wanted:
                keep(row.id, row.failure, row.on, *row.measure(subject))
        for name, failure, on, figures in _long_runs(options, subject):
            keep(name, failure, on, figures)


def _subject(options: Stability, work: Path) -> Subject:
    """The avatar of the checkpoint, or one trained in minutes on the capture."""
    from rnd_bench.scenes.subject import Subject
    from rnd_runtime.capture.capture import load_capture

    from .processes import export, run_commands
    from .small import train_small

    capture, checkpoint = load_capture(options.capture), options.checkpoint
    if checkpoint is None:
        checkpoint = train_small(work / "run", capture, SMALL_STEPS, 30_000)
    checkpoint, avatar = checkpoint.resolve(), (work / "avatar.onnx").resolve()
    done = run_commands(work, [export(checkpoint, avatar)])[0]
    if done.code != 0:
        raise InputError("the checkpoint cannot be exported", got=done.errors.strip()[-200:], file=checkpoint)
    return Subject(avatar, checkpoint, capture, work.resolve(), small=False, size=options.size)


def measured_on(on: str, subject: Subject) -> dict[str, Any]:
    """Machine and subject of a row."""
    from numba import get_num_threads

    from rnd_runtime.playback.doctor import machine

    from .rows import AVATAR

    about: dict[str, Any] = {"on": on, "threads": get_num_threads(), "machine": machine()}
    if on == AVATAR:
        about |= {"gaussians": subject.avatar.gaussians, "size": subject.size}
        about["checkpoint_sha256"] = sha256_of(subject.checkpoint)
    return about


def _long_runs(options: Stability, subject: Subject) -> Iterable[tuple[str, str, str, Sequence[Figure]]]:
    """The runs of --fuzz, --soak, --view, --kill and --determinism: id, failure, subject, figures."""
    from .rows import AVATAR, SHORT

    if options.fuzz:
        yield "F", "hostile files", "small files", _fuzz(options, subject)
    if options.soak:
        from .soak import soak_playback, soak_training

        state = subject.work / "soak.json"
        yield "S1", "soak, playback", AVATAR, soak_playback(subject, options.soak, state)
        yield "S2", "soak, training", SHORT, soak_training(subject, options.soak // 10, state)
    if options.view:
        from .soak_view import soak_view

        yield "S3", "soak, rnd-view", AVATAR, soak_view(subject, options.view)
    if options.kill:
        from .kill import kill_all

        yield "K", "kill -9", "the avatar; trainings of 400 Gaussians", kill_all(subject, options.kill)
    if options.determinism:
        from .determinism import same_bytes

        yield "D", "determinism", AVATAR, same_bytes(subject).figures


def _fuzz(options: Stability, subject: Subject) -> Sequence[Figure]:
    from rnd_runtime.cli.progress import Progress

    from .fuzzing.honest import COMPLETE, write_files
    from .fuzzing.readers import READERS
    from .fuzzing.run import batches, figures_of, fuzz
    from .processes import export, run_commands
    from .small import studio, train_small

    names = list(READERS) if options.readers == "all" else options.readers.split(",")
    if unknown := set(names) - set(READERS):
        raise InputError("--readers", expected=f"some of {','.join(READERS)}", got=",".join(sorted(unknown)))
    folder = subject.work / "fuzz"
    if not (folder / "files" / COMPLETE).exists():
        capture = studio(subject)
        small = train_small(folder / "run", capture, 12, 200)
        run_commands(folder, [export(small, folder / "small.onnx")])
        write_files(folder / "files", folder / "small.onnx", small, capture.folder)
    done = count()
    with Progress() as progress:
        progress.phase("broken files", len(names) * batches(options.fuzz))
        record = fuzz(folder / "files", options.fuzz, names, lambda: progress.update(next(done) + 1))
    file = options.json.with_name("stability_fuzz.json")
    if file.exists():  # other readers stay
        record = json.loads(file.read_text(encoding="utf-8")) | record
    write_json(file, record)
    return figures_of(record)
