"""A clock that compiled code can read, so that the stages of one compiled pass can be told apart."""

from __future__ import annotations

import time

import numpy as np
from numba import njit, types

_MONOTONIC = getattr(time, "CLOCK_MONOTONIC", None)  # POSIX's; Windows has none
_clock_gettime = types.ExternalFunction("clock_gettime", types.int32(types.int32, types.voidptr))

if _MONOTONIC is None:

    @njit(nogil=True)
    def now():  # type: ignore[no-untyped-def]
        """No clock: what it is asked of seems to take no time."""
        return 0.0

else:

    @njit(nogil=True)
    def now():  # type: ignore[no-untyped-def]
        """Seconds since some moment; reading it takes 0.1 µs."""
        seconds_nanoseconds = np.empty(2, np.int64)
        _clock_gettime(_MONOTONIC, seconds_nanoseconds.ctypes)
        return seconds_nanoseconds[0] + 1e-9 * seconds_nanoseconds[1]
