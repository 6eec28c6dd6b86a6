"""How many threads the compiled kernels may take."""

from __future__ import annotations

import numba

from .errors import check_option


def check_threads(threads: int) -> None:
    """Raise :class:`rnd_runtime.errors.InputError` unless the compiled kernels can run on so many."""
    most = numba.config.NUMBA_NUM_THREADS
    check_option(1 <= threads <= most, "--threads", f"1 to {most}", threads)


def set_threads(threads: int | None) -> None:
    """Run the compiled kernels on ``threads``; None leaves all. Raises as :func:`check_threads`."""
    if threads is not None:
        check_threads(threads)
        numba.set_num_threads(threads)
