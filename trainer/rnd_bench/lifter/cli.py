"""``rnd-bench study lifter``."""

from __future__ import annotations

from collections.abc import Iterator

from rich.console import Console
from rich.table import Table

from rnd_runtime.cli.command import log
from rnd_runtime.cli.progress import Progress
from rnd_runtime.core.files import output_file, output_folder, sha256_of, write_json
from rnd_runtime.playback.doctor import machine

from .errors import fit_errors, load_windows
from .figures import Lifts, of_windows, rows_of, synthetic
from .filmed import film_windows
from .motions import load_clips
from .network import export
from .options import Lifter
from .pose2sim import figures_of_cameras, observed_cameras
from .training import train

TESTED = 20
"""filmed windows of each held-out part"""
COLUMNS = (
    "limbs_deg",
    "limbs_deg_landmarks",
    "root_relative_mm",
    "root_relative_mm_landmarks",
    "pa_mm",
    "pa_mm_landmarks",
)


def run(options: Lifter) -> None:
    """Film, fit, train, score; print the table, write the rows."""
    options.check()
    out = output_folder(options.out)
    if options.json is not None:
        output_file(options.json)
    clips = load_clips(options.motions)
    counts = {"train": options.windows, "validation": TESTED, "test": TESTED}
    with Progress() as progress:
        for part, count in counts.items():
            progress.phase(f"filming, {part}", count)
            film_windows(clips[part], options.characters, options.probes, out / part, count, progress.update)
        progress.phase("fitting errors")
        windows = {part: load_windows(out / part) for part in counts}
        errors = fit_errors(windows["train"])
        errors.save(out / "errors.npz")
        progress.phase("training", options.steps)
        network = train(clips["train"], errors, out, options.steps, lambda step, loss: progress.update(step, loss=loss))
        export(network, out / "lifter.onnx")
        log(f"{out / 'lifter.onnx'}: {sha256_of(out / 'lifter.onnx')[:12]}")

        def scored() -> Iterator[tuple[str, Lifts]]:
            for part in ("validation", "test"):
                progress.phase(f"scoring, {part}")
                yield f"synthetic, {part}", synthetic(clips[part], errors, out / "lifter.onnx")
                yield f"filmed, {part}", of_windows(windows[part], out / "lifter.onnx")

        rows = rows_of(scored())
        if options.real is not None:
            progress.phase("scoring, real cameras")
            rows += figures_of_cameras(options.real, observed_cameras(options.real, out), out / "lifter.onnx")
    if options.json is not None:
        write_json(
            options.json, {"steps": options.steps, "windows": len(windows["train"]), "machine": machine(), "rows": rows}
        )
    table = Table("set", "frames", *COLUMNS, title="lifter beside the landmark network's own 3D")
    for row in rows:
        table.add_row(row["set"], str(row["frames"]), *(f"{row[name]:.1f}" for name in COLUMNS))
    Console(width=140, soft_wrap=True).print(table)
