"""What each factor of the grid does to the time of a frame, and whether any combination beats the chart's front.

python scripts/bench_effects.py SAMPLED.json CROSSED.json OUT.json

SAMPLED holds points drawn at random from all combinations (``rnd-bench grid --sample``), CROSSED all combinations of
the chart's factors (``--cross n,size,shade,encoder``).
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

from rnd_bench.speed.grid import FACTORS
from rnd_runtime.core.files import write_json
from rnd_runtime.playback.doctor import machine

NOISE = 1.2
"""times as long as usual a frame may take by what else the host does"""
Row = dict[str, Any]


def effects(rows: list[Row], factors: dict[str, tuple[Any, ...]]) -> dict[tuple[str, str], tuple[float, float, float]]:
    """(factor, value) → what it multiplies the time by, all else alike, and twice the standard error below and above.

    Least squares of log ms, beside the first value of each factor.
    """
    columns = [(name, value) for name, values in factors.items() for value in values[1:]]
    design = np.array([[1.0, *(row[name] == value for name, value in columns)] for row in rows])
    times = np.log([row["ms_median"] for row in rows])
    found = np.linalg.lstsq(design, times, rcond=None)[0]
    left = times - design @ found
    variance = float(left @ left) / (len(rows) - design.shape[1])
    errors = np.sqrt(variance * np.diag(np.linalg.inv(design.T @ design)))
    return {
        (name, _said(value)): tuple(np.exp(effect + 2 * error * np.array([0, -1, 1])).tolist())
        for (name, value), effect, error in zip(columns, found[1:], errors[1:])
    }


def table(rows: list[Row]) -> list[Row]:
    """What each value does where the CPU draws and where OpenGL does, a row each; and last what OpenGL does."""
    others = {name: values for name, values in FACTORS.items() if name != "raster"}
    cpu = effects([row for row in rows if row["raster"] == "cpu"], others)
    gl = effects([row for row in rows if row["raster"] != "cpu"], others)
    alike = {"of": len(rows), "machine": machine()}
    lines = [
        {
            "factor": name,
            "value": value,
            "instead_of": _said(FACTORS[name][0]),
            "cpu": _stated(cpu[name, value]),
            "opengl": _stated(gl[name, value]),
            **alike,
        }
        for name, value in cpu
    ]
    whole = effects(rows, FACTORS)
    return lines + [
        {"factor": name, "value": value, "instead_of": "cpu", "opengl": _stated(whole[name, value]), **alike}
        for name, value in whole
        if name == "raster"
    ]


def _stated(effect: tuple[float, float, float]) -> str:
    times, low, high = effect
    return f"{times:.2f} ({low:.2f} to {high:.2f})"


def beyond(sampled: list[Row], crossed: list[Row]) -> list[Row]:
    """Points that none of ``crossed`` of as many Gaussians and pixels equals in picture within NOISE of their time."""
    return [
        row
        for row in sampled
        if not any(
            other["psnr_db"] >= row["psnr_db"] - 0.05 and other["ms_median"] <= NOISE * row["ms_median"]
            for other in crossed
            if (other["n"], other["size"]) == (row["n"], row["size"])
        )
    ]


def _said(value: object) -> str:
    return "none" if value is None else str(value)


def main(sampled: Path, crossed: Path, out: Path) -> None:
    """Write both answers."""
    rows, others = (
        [row for row in json.loads(path.read_text("utf-8")) if "psnr_db" in row] for path in (sampled, crossed)
    )
    write_json(out, {"effects": table(rows), "beyond": beyond(rows, others), "sampled": len(rows)})


if __name__ == "__main__":
    if len(sys.argv) != 4:
        sys.exit("usage: bench_effects.py SAMPLED.json CROSSED.json OUT.json")
    main(*map(Path, sys.argv[1:]))
