"""A run split into parts for the workers of ``--on``."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TypeVar

from rnd_runtime.cli.jobs import run_jobs, worker_count, workers
from rnd_viewer.inputs.options import PlayOptions

Result = TypeVar("Result")
PARTS_EACH, MIN_PART = 3, 8
"""parts for each worker, of so many frames at least: loading an avatar takes as long as some frames"""


def in_parts(
    render: Callable[[PlayOptions], Result],
    options: PlayOptions,
    formats: Sequence[str],
    frames: range,
    missing: Callable[[range], Sequence[int]],
) -> list[Result]:
    """Call ``render`` on workers with the options of each part of ``frames`` of which any are ``missing``."""
    assert options.on is not None
    with workers(options.on) as client:
        length = max(math.ceil(len(frames) / (PARTS_EACH * worker_count(client))), MIN_PART)
        parts = [frames[k : k + length] for k in range(0, len(frames), length)]
        parts = [part for part in parts if missing(part)]
        common = replace(options, format=",".join(formats))
        jobs = [(replace(common, frames=f"{part.start}:{part.stop}"),) for part in parts]
        return run_jobs(client, render, jobs, name="rendering", sizes=[len(part) for part in parts])
