"""What a row measures: figures with their limits."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from rnd_bench.scenes.psnr import Bytes
from rnd_runtime.core.errors import InputError

Baseline = tuple[str, float] | None  # name and figure of the plain method


@dataclass(frozen=True)
class Figure:
    """One measured number and its limit.

    Attributes:
        measured: None where the capture lacks the data. NaN never passes.
        line: the limit, such as "< 3"; empty where the number is only reported.
        baseline, baseline_name: the same number of the plain method, where there is one.
        timing: the number depends on the machine's load; tests do not assert it.
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
    """A row's figures; optionally its worst image and that image's reference, 8-bit sRGB [H, W, 3]."""

    figures: tuple[Figure, ...]
    images: tuple[Bytes, Bytes] | None = None


def result(*figures: Figure, images: tuple[Bytes, Bytes] | None = None) -> Result:
    return Result(figures, images)


def below(what: str, measured: float, limit: float, unit: str = "", *, baseline: Baseline = None) -> Figure:
    return _figure(what, measured, unit, f"< {limit:g}", measured < limit, baseline)


def at_most(what: str, measured: float, limit: float, unit: str = "", *, baseline: Baseline = None) -> Figure:
    return _figure(what, measured, unit, f"≤ {limit:g}", measured <= limit, baseline)


def at_least(what: str, measured: float, limit: float, unit: str = "") -> Figure:
    return _figure(what, measured, unit, f"≥ {limit:g}", measured >= limit, None)


def above(what: str, measured: float, limit: float, unit: str = "", *, baseline: Baseline = None) -> Figure:
    return _figure(what, measured, unit, f"> {limit:g}", measured > limit, baseline)


def reported(what: str, measured: float, unit: str = "", *, baseline: Baseline = None) -> Figure:
    """A figure without a limit, which passes as long as it is finite."""
    return _figure(what, measured, unit, "", math.isfinite(measured), baseline)


def holds(what: str, wrong: list[str]) -> Figure:
    """The number of failed cases, named in ``what``."""
    return _figure(f"{what}: {'; '.join(wrong)}" if wrong else what, len(wrong), "cases wrong", "= 0", not wrong, None)


def not_measured(what: str, why: str = "not in this capture") -> Figure:
    """A figure for which the capture has no data; it does not pass."""
    return Figure(f"{what} ({why})", None, "", "", False)


def amount(number: float | None, unit: str) -> str:
    return "not measured" if number is None else f"{number:.4g} {unit}".rstrip()


def _figure(what: str, measured: float, unit: str, line: str, passes: bool, baseline: Baseline) -> Figure:
    name, value = baseline or ("", None)
    number = float(np.clip(measured, -1e300, 1e300))  # JSON has no infinity
    return Figure(what, number, unit, line, bool(passes), None if value is None else float(value), name)


def refusal(name: str, call: Callable[..., object], *arguments: Any, words: tuple[str, ...] = ()) -> list[str]:
    """Faults of how ``call(*arguments)`` refuses bad input: none if it raises one line that contains all ``words``."""
    try:
        call(*arguments)
    except InputError as error:
        line = str(error)
        missing = [word for word in words if word not in line]
        if "\n" in line:
            return [f"{name}: more than one line"]
        return [f"{name}: does not say {missing[0]!r}: {line[:80]}"] if missing else []
    except Exception as error:  # any other exception is a fault
        return [f"{name}: {type(error).__name__}: {str(error)[:60]}"]
    return [f"{name}: accepted"]
