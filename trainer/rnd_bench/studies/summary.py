"""Means and gains of a study's rows over their seeds."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Sequence
from typing import Any

from .variants import StudyRow

MEANS = ("psnr", "ssim", "lpips", "psnr_n")  # figures whose means a summary has


def summarise(
    rows: Sequence[dict[str, Any]], variants: Sequence[StudyRow], figure: str = "psnr"
) -> list[dict[str, Any]]:
    """One row for each variant: mean and spread (standard deviation) over seeds of ``figure`` on every split.

    ``gain`` is the mean over seeds of the difference to the variant ``beside``, seed by seed; ``shows`` is whether it
    exceeds the spread of those differences (None of one seed). The means of ``MEANS`` are added.
    """
    by_key = {(row["method"], row["split"], row["seed"]): row for row in rows}
    splits = list(dict.fromkeys(row["split"] for row in rows))
    seeds = sorted({row["seed"] for row in rows})
    table = []
    for variant in variants:
        cells: dict[str, Any] = {"method": variant.name, "what": variant.what, "beside": variant.beside}
        for split in splits:
            own = {s: by_key[variant.name, split, s][figure] for s in seeds if (variant.name, split, s) in by_key}
            if not own:
                continue
            cells[split] = {"mean": statistics.fmean(own.values()), "spread": _spread(list(own.values()))}
            scored = [by_key[variant.name, split, s] for s in own]
            cells[split] |= _means(scored, (name for name in MEANS if name != figure))
            gains = [
                value - by_key[variant.beside, split, s][figure]
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
    """Of the columns ``names`` that all ``rows`` have a number in."""
    return {
        name: statistics.fmean(row[name] for row in rows)
        for name in names
        if all(row.get(name) is not None for row in rows)
    }


def _spread(values: list[float]) -> float | None:
    """None of a single value: JSON has no NaN."""
    return statistics.stdev(values) if len(values) > 1 else None
