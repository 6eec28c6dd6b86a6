"""What is missing of an extra is named, and what installs it."""

from __future__ import annotations

import sys

import pytest

from rnd_runtime.cli.extras import need_packages
from rnd_runtime.core.errors import InputError

HINT = r" \(pip install 'rnd-avatar\[mesh\]', in a clone pip install -e \"\.\[mesh\]\"; or none\)$"


@pytest.mark.parametrize(
    ("missing", "said"),
    [
        (["PIL"], "Pillow is not installed"),
        (["json", "PIL"], "json and Pillow are not installed"),
        (["av", "json", "PIL"], "PyAV, json and Pillow are not installed"),
    ],
)
def test_the_missing_packages_alone_are_named(missing, said, monkeypatch) -> None:
    for module in missing:
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(InputError, match=f"^{said}{HINT}"):
        need_packages("mesh", "numpy", *missing, otherwise="; or none")


def test_what_needs_them_is_named(monkeypatch) -> None:
    need_packages("mesh", "numpy", what="meshes need")
    monkeypatch.setitem(sys.modules, "numpy", None)
    with pytest.raises(InputError, match=r"^meshes need numpy, which is not installed \("):
        need_packages("mesh", "json", "numpy", what="meshes need")
