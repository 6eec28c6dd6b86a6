"""How many threads a process takes, by default one for each core that it may use, and work shared between them."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeVar

from .errors import InputError

Result = TypeVar("Result")


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


def ahead(function: Callable[..., Result], *items: Iterable[Any]) -> Iterator[Result]:
    """Yield what ``map`` does, in its order; a thread a core works on the next ones.

    ``items`` are taken in the caller's thread, so many at a time as there are cores; exceptions come when their turn
    does.
    """
    count = cores()
    with ThreadPoolExecutor(count) as pool:
        waiting: deque[Future[Result]] = deque()
        try:
            for arguments in zip(*items):
                waiting.append(pool.submit(function, *arguments))
                if len(waiting) > count:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()
