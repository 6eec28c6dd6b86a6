"""Every row of the stability list on a small avatar, with the number it measured."""

from __future__ import annotations

import pytest

from rnd_bench.stability.rows import ROWS
from support.stash import MEASURED

pytestmark = pytest.mark.slow

# What the design does not pass: the figures, by how they begin, and why.
KNOWN: dict[str, tuple[tuple[str, ...], str]] = {
    "L8": (("albedo 0:",), "what GGX scatters twice is lost, as in the paper")
}


class KnownLimit(AssertionError):
    """Exactly the figures that are known to fail did."""


def _parameter(row):
    if row.id not in KNOWN:
        return pytest.param(row, id=row.id)
    mark = pytest.mark.xfail(raises=KnownLimit, strict=True, reason=KNOWN[row.id][1])
    return pytest.param(row, id=row.id, marks=mark)


@pytest.mark.parametrize("row", [_parameter(row) for row in ROWS])
def test_row(row, subject, record_property, request):
    result = row.measure(subject)
    for figure in result.figures:
        measured = "not measured" if figure.measured is None else f"{figure.measured:.6g} {figure.unit}"
        record_property(figure.what, f"{measured} ({figure.line or 'reported'})")
        request.config.stash.setdefault(MEASURED, []).append((row.id, figure))
    failing = [figure.what for figure in result.figures if not (figure.passes or figure.timing)]
    expected, why = KNOWN.get(row.id, ((), ""))
    surprising = [what for what in failing if not what.startswith(expected or "\0")]
    assert not surprising, surprising
    if failing:
        raise KnownLimit(f"{why}: {failing}")
