"""What rows say of many times."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def summary(taken: Sequence[float]) -> dict[str, float]:
    """Median, 95th percentile and minimum of milliseconds, as rows name them."""
    return {
        "ms_median": float(np.median(taken)),
        "ms_p95": float(np.percentile(taken, 95)),
        "ms_min": float(np.min(taken)),
    }
