"""How many threads a process takes: by default one for each core that it may use."""

from __future__ import annotations

import os

from .errors import InputError


def cores() -> int:
    """Cores that this process may use, at most NUMBA_NUM_THREADS; ``InputError`` where that is no number of threads."""
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    wanted = os.environ.get("NUMBA_NUM_THREADS", "").strip() or str(count)
    number = int(wanted[:9]) if wanted.isdecimal() else 0
    if number < 1:
        raise InputError("NUMBA_NUM_THREADS", expected="a whole number of at least 1", got=wanted)
    return min(count, number)


def max_threads() -> int:
    """Threads that compiled kernels may take: one per core, or NUMBA_NUM_THREADS."""
    import numba

    return int(numba.config.NUMBA_NUM_THREADS)


def check_threads(threads: int) -> None:
    """Raise ``InputError`` unless the compiled kernels can run on ``threads``."""
    maximum = max_threads()
    if not 1 <= threads <= maximum:
        raise InputError("--threads", expected=f"1 to {maximum}", got=threads)


def set_threads(threads: int | None) -> None:
    """Run this thread's kernels on ``threads``; None leaves all. Raises as ``check_threads``."""
    if threads is not None:
        import numba

        check_threads(threads)
        numba.set_num_threads(threads)
