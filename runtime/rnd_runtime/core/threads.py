"""How many threads the compiled kernels may take."""

from __future__ import annotations

import numba

from .errors import check_option


def most_threads() -> int:
    """One per core, or as many as NUMBA_NUM_THREADS says."""
    return int(numba.config.NUMBA_NUM_THREADS)


def check_threads(threads: int) -> None:
    """Raise ``core.errors.InputError`` unless the compiled kernels can run on so many."""
    most = most_threads()
    check_option(1 <= threads <= most, "--threads", f"1 to {most}", threads)


def set_threads(threads: int | None) -> None:
    """Run the compiled kernels on ``threads``; None leaves all. Raises as ``check_threads``."""
    if threads is not None:
        check_threads(threads)
        numba.set_num_threads(threads)
