"""Feeds broken files to readers, each batch in a process of its own."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from rnd_bench.scenes.avatars import content_key, sources
from rnd_bench.stability.figures import Figure, at_most, holds, reported
from rnd_bench.stability.processes import environment
from rnd_runtime.core.files import write_json

from .readers import READERS

WAIT_S = 7200.0  # for a batch
BATCH = 10_000  # inputs in one process: what a crash loses
MEMORY_MB = 512.0
"""above the honest file: twice what a file may expand to by default"""
SLOW_S = 5.0


def fuzz(
    folder: Path, count: int, names: Sequence[str] = tuple(READERS), on_batch: Callable[[], object] = lambda: None
) -> dict[str, Any]:
    """Feed ``count`` damaged files to each of the readers ``names``; the record by reader.

    ``folder`` has the valid files. Results of batches are stored beside it, so that an interrupted run resumes.
    """
    return {name: _all_batches(folder, name, count, on_batch) for name in names}


def figures_of(record: Mapping[str, Any]) -> list[Figure]:
    """Figures of a ``record`` of ``fuzz``."""
    figures = []
    for name, total in record.items():
        faults = [f"{len(total['died'])} processes died"] * bool(total["died"])
        faults += list(total["escaped"]) + total["audit"]
        what = f"{name}: {total['inputs']} inputs, {total['refused']} refused"
        figures += [
            holds(f"{what}: crashes, escapes, writes elsewhere", faults),
            at_most(f"{name}: slowest input", total["slowest_s"], SLOW_S, "s of processor time"),
            at_most(f"{name}: peak memory above that of the valid file", total["grown_bytes"] / 2**20, MEMORY_MB, "MB"),
        ]
        if seconds := total.get("seconds"):
            figures.append(reported(f"{name}: inputs a second of processor time", total["inputs"] / seconds))
    return figures


def batches(count: int) -> int:
    return -(-count // BATCH)


def _all_batches(folder: Path, name: str, count: int, on_batch: Callable[[], object]) -> dict[str, Any]:
    counts, largest = ("inputs", "refused", "read", "seconds"), ("slowest_s", "grown_bytes")
    total: dict[str, Any] = {**dict.fromkeys((*counts, *largest), 0), "died": [], "escaped": {}, "audit": []}
    key = content_key(*sources("rnd_runtime"), *sources("rnd_trainer"))
    results = folder.with_name("results")
    results.mkdir(exist_ok=True)
    for seed in range(batches(count)):
        size = min(BATCH, count - seed * BATCH)
        stored = results / f"{name.replace(' ', '_')}_{seed}_{size}_{key}.json"
        if not stored.exists():
            write_json(stored, _batch(folder, name, seed, size))
        batch = json.loads(stored.read_text(encoding="utf-8"))
        on_batch()
        if "died" in batch:
            total["died"].append(batch["died"])
            continue
        for what in counts:
            total[what] += batch.get(what, 0)  # older batches lack the seconds
        for what in largest:
            total[what] = max(total[what], batch[what])
        total["escaped"] |= batch["escaped"]
        total["audit"] += batch["audit"]
    return total


def _batch(folder: Path, name: str, seed: int, size: int) -> dict[str, Any]:
    """The report of ``process.feed`` from a process of its own; if it died, how, and its last input is kept."""
    own = folder.with_name("own") / name.replace(" ", "_")
    shutil.rmtree(own, ignore_errors=True)
    shutil.copytree(folder, own)
    line = [sys.executable, "-m", f"{__package__}.process", name, str(size), str(seed), str(folder), str(own)]
    code: int | str
    try:
        child = subprocess.run(
            line, cwd=own, env=environment(), capture_output=True, text=True, check=False, timeout=WAIT_S
        )
        code, lines, errors = child.returncode, child.stdout.strip().splitlines(), child.stderr.strip()
    except subprocess.TimeoutExpired:
        code, lines, errors = "no end", [], ""
    kept = folder.with_name("results")
    for escape in own.rglob("escape_*"):
        shutil.copyfile(escape, kept / f"{own.name}_{seed}_{escape.name}")
    if code == 0 and lines:
        report: dict[str, Any] = json.loads(lines[-1])
        return report
    broken = own / READERS[name].file
    shutil.copyfile(broken, kept / f"{own.name}_{seed}_killer{broken.suffix}")
    return {"died": {"seed": seed, "code": code, "said": errors[-300:]}}
