"""The house's rules that neither ruff nor import-linter checks."""

from __future__ import annotations

from collections import Counter

import pytest

from support.paths import ROOT

PACKAGES = ("runtime", "trainer", "export", "viewer")
SOURCES = [file for package in PACKAGES for file in (ROOT / package).glob("rnd_*/**/*.py")]
MAX_FILES = 14
MAX_LINES = 400


def test_the_formatter_has_no_exceptions():
    files = [*SOURCES, *(ROOT / "tests").rglob("*.py")]
    exempt = "fmt: " + "skip"
    assert not [file for file in files if exempt in file.read_text(encoding="utf-8")]


def test_folders_are_small():
    product = (file for file in SOURCES if "rnd_bench" not in file.parts and "rnd_stage" not in file.parts)
    modules = Counter(file.parent.relative_to(ROOT) for file in product if file.name != "__init__.py")
    assert not {str(folder): count for folder, count in modules.items() if count > MAX_FILES}


def test_modules_are_short():
    lines = {str(file.relative_to(ROOT)): len(file.read_text(encoding="utf-8").splitlines()) for file in SOURCES}
    assert not {name: count for name, count in lines.items() if count > MAX_LINES}


@pytest.mark.parametrize("package", [folder.parent for folder in sorted(ROOT.glob("*/rnd_*/__init__.py"))], ids=str)
def test_packages_are_typed(package):
    assert (package / "py.typed").is_file()
