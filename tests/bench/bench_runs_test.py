"""The script that sums up many runs of a point."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from support.paths import ROOT

SCRIPT = ROOT / "scripts/bench_runs.py"
POINT = {"machine": "M", "n": 9, "size": 64, "shade": "table", "cull": None, "threads": 2}


def _run(tmp_path: Path, *runs: dict[str, object]) -> subprocess.CompletedProcess[str]:
    rows = [{**POINT, "psnr_db": 46.0, "psnr_db_worst": 45.0, **run} for run in runs]
    (tmp_path / "runs.json").write_text(json.dumps(rows), encoding="utf-8")
    line = [sys.executable, SCRIPT, tmp_path / "out.json", tmp_path / "runs.json"]
    return subprocess.run(line, capture_output=True, text=True, check=False)


def test_runs_of_a_point_become_one_row(tmp_path) -> None:
    done = _run(
        tmp_path,
        {"ms_median": 8.0, "ms_p95": 17.0, "cold_start_ms": 900.0},
        {"ms_median": 7.0, "ms_p95": 12.0, "cold_start_ms": 1600.0},
        {"ms_median": 20.0, "ms_p95": 30.0, "cold_start_ms": 1000.0},
    )
    assert done.returncode == 0, done.stderr
    (row,) = json.loads((tmp_path / "out.json").read_text("utf-8"))
    assert row["runs"] == 3 and row["ms_median"] == [7.0, 8.0, 20.0] and row["ms_p95"] == [12.0, 17.0, 30.0]
    assert (row["median_in_time"], row["p95_in_time"], row["start_in_time"]) == (2, 1, 2)


def test_runs_of_several_points_are_refused(tmp_path) -> None:
    times = {"ms_median": 8.0, "ms_p95": 9.0, "cold_start_ms": 900.0}
    done = _run(tmp_path, times, {**times, "n": 10})
    assert done.returncode == 1 and "rows of different points" in done.stderr
    assert not (tmp_path / "out.json").exists()
