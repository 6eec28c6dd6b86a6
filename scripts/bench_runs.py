"""What many runs of a point came to: python scripts/bench_runs.py OUT.json FILE.json…

Each FILE holds the rows of ``rnd-bench frame --runs``; OUT gets a row for each, with the least, the middle one and the
greatest of what its runs took, and in how many of them 60 frames a second and a cold start of 1.5 s were kept.
"""

from __future__ import annotations

import statistics
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rnd_bench.speed.chart import BUDGET_MS
from rnd_runtime.core.files import earlier_rows, write_json

COLD_START_MS = 1500.0
TIMES = ("ms_median", "ms_p95", "cold_start_ms")
SAME = ("machine", "n", "size", "shade", "cull", "threads")
Row = dict[str, Any]


def together(rows: Sequence[Row]) -> Row:
    """One row for ``rows`` of the same point on the same machine."""
    first = rows[0]
    if any(row[name] != first[name] for row in rows for name in SAME):
        raise SystemExit(f"bench_runs: rows of different points, {', '.join(SAME)} must agree")
    taken = {name: sorted(row[name] for row in rows) for name in TIMES}
    return {
        **{name: first[name] for name in SAME},
        "runs": len(rows),
        **{name: [values[0], statistics.median(values), values[-1]] for name, values in taken.items()},
        "median_in_time": sum(ms <= BUDGET_MS for ms in taken["ms_median"]),
        "p95_in_time": sum(ms <= BUDGET_MS for ms in taken["ms_p95"]),
        "start_in_time": sum(ms <= COLD_START_MS for ms in taken["cold_start_ms"]),
        "psnr_db": first["psnr_db"],
        "psnr_db_worst": first["psnr_db_worst"],
    }


if __name__ == "__main__":
    if len(sys.argv) < 3:
        raise SystemExit(__doc__)
    out, *files = map(Path, sys.argv[1:])
    write_json(out, [together(earlier_rows(file, what="rows of rnd-bench frame --runs", names=SAME)) for file in files])
