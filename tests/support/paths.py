"""Folders that tests read from."""

from pathlib import Path

ROOT = Path(__file__).parents[2]
"""of the clone"""
ASSETS = ROOT / "assets"
CASES = ROOT / "tests" / "cases"
"""small inputs that failed, each with a README that says what is right"""
SHARED = ROOT.parent / "shared"
"""beside the clone; may be absent"""
