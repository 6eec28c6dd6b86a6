"""What the web player shares with Python is what Python has."""

import runpy

from support.paths import ROOT


def test_the_generated_constants_are_current():
    constants = runpy.run_path(str(ROOT / "viewer/web/constants.py"))
    assert constants["FILE"].read_text() == constants["source"](), "python viewer/web/constants.py writes it"
