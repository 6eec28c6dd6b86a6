"""axe-core in a page of ``browser``: rules of accessibility that it breaks."""

from __future__ import annotations

import pytest

from .browser import CHROMIUM, Page
from .paths import ROOT

AXE = ROOT / "viewer/web/node_modules/axe-core/axe.min.js"
needs_axe = pytest.mark.skipif(
    CHROMIUM is None or not AXE.is_file(), reason="needs Chromium, and axe-core of npm ci in viewer/web"
)
RUN = """axe.run().then(({ violations }) => violations.flatMap(({ id, nodes }) =>
    nodes.map(({ html, failureSummary }) => `${id}: ${html}\n${failureSummary}`)))"""


def violations(page: Page) -> list[str]:
    """One text for each element and the rule that it breaks."""
    page.run(f"{AXE.read_text(encoding='utf-8')}; 1")
    found: list[str] = page.run(RUN)
    return found
