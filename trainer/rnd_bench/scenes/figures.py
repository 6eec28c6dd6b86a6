"""What a row of the suite measures, and the few measures that rows share."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.images import linear_to_srgb

if TYPE_CHECKING:
    from .subject import Subject

Floats = NDArray[np.float64]
Bytes = NDArray[np.uint8]

AVATAR = "the avatar"
"""what most rows are measured on"""
IDENTICAL_DB = 200.0
"""what equal pictures count as: JSON has no infinity"""


@dataclass(frozen=True)
class Figure:
    """One measured number and the line it must keep.

    Attributes:
        what: what was measured, in words.
        measured: the number, None where there was nothing to measure by. NaN never passes.
        line: such as "< 3"; empty where the number is only reported.
        passes: whether it does.
        baseline, baseline_name: the same number of the plain method, where there is one.
        timing: the number depends on how busy the machine is; tests do not judge it.
    """

    what: str
    measured: float | None
    unit: str
    line: str
    passes: bool
    baseline: float | None = None
    baseline_name: str = ""
    timing: bool = False


class Result(NamedTuple):
    """A row's figures, and for pictures the worst frame (ours, then its reference), 8-bit sRGB [H, W, 3]."""

    figures: tuple[Figure, ...]
    pictures: tuple[Bytes, Bytes] | None = None


class Row(NamedTuple):
    """One way to fail: its number in the list, its name and what measures it.

    ``on`` what, where that is not the avatar: it would take too long, or does not matter.
    """

    id: str
    failure: str
    measure: Callable[[Subject], Result]
    on: str = AVATAR


def below(
    what: str, measured: float, limit: float, unit: str = "", *, baseline: tuple[str, float] | None = None
) -> Figure:
    """A figure that must be less than ``limit``."""
    return _figure(what, measured, unit, f"< {limit:g}", measured < limit, baseline)


def at_most(
    what: str, measured: float, limit: float, unit: str = "", *, baseline: tuple[str, float] | None = None
) -> Figure:
    """A figure that must not exceed ``limit``."""
    return _figure(what, measured, unit, f"≤ {limit:g}", measured <= limit, baseline)


def at_least(what: str, measured: float, limit: float, unit: str = "") -> Figure:
    """A figure that must not fall short of ``limit``."""
    return _figure(what, measured, unit, f"≥ {limit:g}", measured >= limit, None)


def above(
    what: str, measured: float, limit: float, unit: str = "", *, baseline: tuple[str, float] | None = None
) -> Figure:
    """A figure that must be more than ``limit``."""
    return _figure(what, measured, unit, f"> {limit:g}", measured > limit, baseline)


def stated(what: str, measured: float, unit: str = "", *, baseline: tuple[str, float] | None = None) -> Figure:
    """A figure that is reported and judged by nobody, as long as it is a number."""
    return _figure(what, measured, unit, "", math.isfinite(measured), baseline)


def not_measured(what: str, why: str = "not in this capture") -> Figure:
    """A figure that there is nothing to measure by, and ``why``. It is judged by no line, and does not pass."""
    return Figure(f"{what} ({why})", None, "", "", False)


def amount(number: float | None, unit: str) -> str:
    """A figure with its unit, in words where nothing was measured."""
    return "not measured" if number is None else f"{number:.4g} {unit}".rstrip()


def holds(what: str, wrong: list[str]) -> Figure:
    """How many cases went wrong; their names stand in ``what``."""
    said = f"{what}: {'; '.join(wrong)}" if wrong else what
    return _figure(said, len(wrong), "cases wrong", "= 0", not wrong, None)


def _figure(
    what: str, measured: float, unit: str, line: str, passes: bool, baseline: tuple[str, float] | None
) -> Figure:
    name, value = baseline or ("", None)
    number = float(np.clip(measured, -1e300, 1e300))  # JSON has no infinity
    return Figure(what, number, unit, line, bool(passes), None if value is None else float(value), name)


def refusal(call: Callable[[], object], *said: str) -> str | None:
    """What is wrong with how ``call`` refuses bad input; None when it raises one line that says all of ``said``."""
    try:
        call()
    except InputError as error:
        line = str(error)
        missing = [word for word in said if word not in line]
        if "\n" in line:
            return "more than one line"
        return f"does not say {missing[0]!r}: {line[:80]}" if missing else None
    except Exception as error:  # any other exception is the failure that is looked for
        return f"{type(error).__name__}: {str(error)[:60]}"
    return "accepted"


def decibels(ours: ArrayLike, theirs: ArrayLike) -> float:
    """PSNR of values in 0…1; NaN where any of them is, which no line lets pass."""
    error = float(np.mean((np.asarray(ours, np.float64) - np.asarray(theirs, np.float64)) ** 2))
    if math.isnan(error):
        return math.nan
    return min(IDENTICAL_DB, -10 * math.log10(error)) if error > 0 else IDENTICAL_DB


def coded(linear: ArrayLike) -> Floats:
    """Linear radiance as sRGB in 0…1, not rounded, so that differences below a byte are seen."""
    return np.asarray(np.clip(linear_to_srgb(np.asarray(linear, np.float64)), 0, 1))
