"""Means and gains of a study's rows over their seeds."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Sequence
from typing import Any

from .variants import StudyRow

MEANS = ("psnr", "ssim", "lpips", "psnr_n")


def summarise(rows: Sequence[dict[str, Any]], variants: Sequence[StudyRow]) -> list[dict[str, Any]]:
    """One row for each variant: mean and standard deviation of the PSNR over seeds, on every split.

    ``gain`` is the mean of the paired differences to the variant ``beside``; ``shows`` is whether it exceeds their
    standard deviation (None for one seed). The means of ``MEANS`` are added.
    """
    by_key = {(row["method"], row["split"], row["seed"]): row for row in rows}
    splits = list(dict.fromkeys(row["split"] for row in rows))
    seeds = sorted({row["seed"] for row in rows})
    table = []
    for variant in variants:
        cells: dict[str, Any] = {"method": variant.name, "what": variant.what, "beside": variant.beside}
        for split in splits:
            own = {s: by_key[variant.name, split, s]["psnr"] for s in seeds if (variant.name, split, s) in by_key}
            if not own:
                continue
            cells[split] = {"mean": statistics.fmean(own.values()), "spread": _spread(list(own.values()))}
            scored = [by_key[variant.name, split, s] for s in own]
            cells[split] |= _means(scored, MEANS[1:])
            gains = [
                value - by_key[variant.beside, split, s]["psnr"]
                for s, value in own.items()
                if variant.beside and (variant.beside, split, s) in by_key
            ]
            if gains:
                spread = _spread(gains)
                gain = statistics.fmean(gains)
                cells[split] |= {"gain": gain, "gain_spread": spread}
                cells[split] |= {"shows": None if spread is None else abs(gain) > spread}
        costs = [row for row in rows if row["method"] == variant.name]
        if costs:
            cells["encoder_gflop"] = costs[0]["encoder_gflop"]
            cells["encoder_ms"] = statistics.median(row["encoder_ms"] for row in costs)
            cells |= _means(costs, ("minutes", "pose_error_before_deg", "pose_error_after_deg"))
        table.append(cells)
    return table


def _means(rows: Sequence[dict[str, Any]], names: Iterable[str]) -> dict[str, float]:
    """Means of the columns that are numbers in all ``rows``."""
    return {
        name: statistics.fmean(row[name] for row in rows)
        for name in names
        if all(row.get(name) is not None for row in rows)
    }


def _spread(values: list[float]) -> float | None:
    """Standard deviation; None for a single value."""
    return statistics.stdev(values) if len(values) > 1 else None
