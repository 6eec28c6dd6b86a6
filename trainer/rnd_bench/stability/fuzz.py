"""Fuzzing of every reader with broken copies of a valid file, each batch in a process of its own."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from rnd_bench.scenes.avatars import content_key, sources
from rnd_runtime.core.files import write_json

from .figures import Figure, at_most, holds
from .hostile import READERS, target_of
from .processes import environment

WAIT_S = 3600.0  # for a batch
BATCH = 2000  # inputs in one process: what a crash loses
MEMORY_FACTOR = 2.0


def fuzz(
    folder: Path, count: int, only: tuple[str, ...] = (), on_batch: Callable[[], object] = lambda: None
) -> tuple[list[Figure], dict[str, Any]]:
    """Feed ``count`` inputs to every reader, one reader per core; figures and the record.

    Each reader has a copy of ``folder``, in which results of batches are stored, so that an interrupted run resumes.
    """
    names = only or READERS
    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        totals = list(pool.map(lambda name: _all_batches(_own_copy(folder, name), name, count, on_batch), names))
    figures = []
    for name, total in zip(names, totals):
        faults = [f"{len(total['died'])} processes died"] * bool(total["died"])
        faults += list(total["escaped"]) + total["audit"]
        figures += [
            holds(f"{name}: {total['inputs']} inputs, {total['refused']} refused: crashes, hangs, escapes", faults),
            at_most(f"{name}: peak memory over that of the honest file", total["memory"], MEMORY_FACTOR, "×"),
        ]
    return figures, dict(zip(names, totals))


def batches(count: int) -> int:
    return -(-count // BATCH)


def _own_copy(folder: Path, name: str) -> Path:
    own = folder / "readers" / name
    if not own.exists():
        half = own.with_name(f".{name}")
        shutil.rmtree(half, ignore_errors=True)
        shutil.copytree(folder, half, ignore=shutil.ignore_patterns("readers"))
        half.rename(own)
    return own


def _all_batches(folder: Path, name: str, count: int, on_batch: Callable[[], object]) -> dict[str, Any]:
    counts = {"inputs": 0, "refused": 0, "read": 0}
    total: dict[str, Any] = {**counts, "died": [], "escaped": {}, "audit": [], "memory": 0.0}
    key = content_key(*sources("rnd_runtime"), *sources("rnd_trainer"))
    for seed in range(batches(count)):
        size = min(BATCH, count - seed * BATCH)
        stored = folder / f"batch_{seed}_{size}_{key}.json"
        if not stored.exists():
            write_json(stored, _batch(folder, name, seed, size))
        batch = json.loads(stored.read_text(encoding="utf-8"))
        on_batch()
        if "died" in batch:
            total["died"].append(batch["died"])
            continue
        for what in counts:
            total[what] += batch[what]
        total["escaped"] |= batch["escaped"]
        total["audit"] += batch["audit"]
        total["memory"] = max(total["memory"], batch["peak_bytes"] / batch["honest_bytes"])
    return total


def _batch(folder: Path, name: str, seed: int, size: int) -> dict[str, Any]:
    """The report of ``hostile.feed`` from a process of its own; if it died, how, and its last input is kept."""
    line = [sys.executable, "-m", "rnd_bench.stability.hostile", name, str(size), str(seed), str(folder)]
    code: int | str
    try:
        child = subprocess.run(
            line, cwd=folder, env=environment(), capture_output=True, text=True, check=False, timeout=WAIT_S
        )
        code, lines, errors = child.returncode, child.stdout.strip().splitlines(), child.stderr.strip()
    except subprocess.TimeoutExpired:
        code, lines, errors = "no end", [], ""
    if code == 0 and lines:
        report: dict[str, Any] = json.loads(lines[-1])
        return report
    broken = target_of(name, folder).broken
    if broken.exists():
        shutil.copyfile(broken, folder / f"killer_{name}_{seed}{broken.suffix}")
    return {"died": {"seed": seed, "code": code, "said": errors[-300:]}}
