"""``rnd-bench study lifter``."""

from __future__ import annotations

from collections.abc import Iterator

from rich.console import Console
from rich.table import Table

from rnd_runtime.cli.command import log
from rnd_runtime.cli.progress import Progress
from rnd_runtime.core.files import output_file, output_folder, sha256_of, write_json
from rnd_runtime.playback.doctor import machine

from .captured import observed, windows_of_capture
from .errors import fit_errors
from .figures import Lifts, of_windows, rows_of, synthetic
from .motions import load_clips
from .network import STAGES, export
from .options import Lifter
from .pose2sim import figures_of_cameras
from .refining import refine
from .solving import solve

STEP = 2
"""frames of 30 a second from one of the video to the next"""
COLUMNS = (
    "limbs_deg",
    "limbs_deg_landmarks",
    "root_relative_mm",
    "root_relative_mm_landmarks",
    "pa_mm",
    "pa_mm_landmarks",
)


def run(options: Lifter) -> None:
    """Fit, solve, refine, score; print the table, write the rows."""
    options.check()
    out = output_folder(options.out)
    if options.json is not None:
        output_file(options.json)
    clips = load_clips(options.motions)
    with Progress() as progress:
        progress.phase("landmarks and their errors")
        seen = observed(options.video, out / "observations.npz")
        errors = fit_errors(windows_of_capture(options.capture, seen))
        network = out / "lifter.onnx"
        if not network.exists():
            progress.phase("solving", STAGES * options.batches)
            solved = solve(clips["train"], errors, options.batches, progress.update)
            progress.phase("refining", options.steps)

            def on_step(step: int, loss: float) -> None:
                progress.update(step, loss=loss)

            export(refine(solved, clips["train"], errors, options.steps, on_step), network)
        log(f"{network}: sha256 {sha256_of(network)[:12]}")

        def scored() -> Iterator[tuple[str, Lifts]]:
            for part in ("validation", "test"):
                progress.phase(f"scoring, {part}")
                yield f"synthetic, {part}", synthetic(clips[part], errors, network)
            yield ("rendered, fitted to", of_windows(windows_of_capture(options.capture, seen, None), network, STEP))

        rows = rows_of(scored())
        if options.real is not None:
            progress.phase("scoring, real cameras")
            rows += figures_of_cameras(options.real, network, out)
    if options.json is not None:
        write_json(
            options.json, {"batches": options.batches, "steps": options.steps, "machine": machine(), "rows": rows}
        )
    table = Table("set", "frames", *COLUMNS, title="lifter beside the landmark network's own 3D")
    for row in rows:
        table.add_row(row["set"], str(row["frames"]), *(f"{row[name]:.1f}" for name in COLUMNS))
    Console(width=140, soft_wrap=True).print(table)
