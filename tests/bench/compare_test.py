"""rnd-bench compare: two checkouts of this project, alternating."""

from __future__ import annotations

import json

import pytest

from rnd_bench.cli import main
from support.paths import ASSETS, ROOT

FILES = [
    "--avatar",
    str(ASSETS / "avatar.onnx"),
    "--motion",
    str(ASSETS / "walk.npz"),
    "--hdr",
    str(ASSETS / "sky.exr"),
]


@pytest.mark.slow
def test_a_checkout_is_compared_with_itself(tmp_path) -> None:
    out = tmp_path / "pairs.json"
    more = ["--pairs", "2", "--threads", "1", "--size", "64", "--json", str(out)]
    assert main(["compare", str(ROOT), str(ROOT), *FILES, *more]) == 0
    rows = json.loads(out.read_text("utf-8"))
    assert [row["stage"] for row in rows][:3] == ["frame", "motion", "encoders"]
    assert all(row["ratio"] > 0 and row["ratio_se"] >= 0 and row["before"] == row["after"] for row in rows)


def test_a_folder_without_a_player_is_refused(tmp_path, capsys) -> None:
    out = tmp_path / "pairs.json"
    assert main(["compare", str(ROOT), str(tmp_path), *FILES, "--json", str(out)]) == 2
    assert "frame.py: checkout's player not found" in capsys.readouterr().err and not out.exists()
