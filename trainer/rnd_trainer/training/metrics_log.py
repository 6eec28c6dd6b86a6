"""metrics.jsonl, a line of JSON for each step: how one of its rows is read back."""

from __future__ import annotations

import json
from typing import Any


def row_of(line: str | bytes) -> dict[str, Any] | None:
    """The row in ``line``; None for a line that is cut, or no row at all."""
    try:
        row = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return row if isinstance(row, dict) and isinstance(row.get("step"), int) else None
