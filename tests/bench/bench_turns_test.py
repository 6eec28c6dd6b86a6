"""The script that draws by turns with two checkouts of this project."""

from __future__ import annotations

import json
import subprocess
import sys

from support.paths import ROOT

SCRIPT = ROOT / "scripts/bench_turns.py"


def _run(*arguments: object) -> subprocess.CompletedProcess[str]:
    line = [sys.executable, SCRIPT, *map(str, arguments)]
    return subprocess.run(line, capture_output=True, text=True, check=False)


def test_a_checkout_takes_its_turns_with_itself(tmp_path) -> None:
    out = tmp_path / "turns.json"
    done = _run(ROOT, ROOT, "--avatar", ROOT / "assets/avatar.onnx", "--turns", 2, "--threads", 1, "--json", out)
    assert done.returncode == 0, done.stderr
    rows = json.loads(out.read_text("utf-8"))
    assert [row["stage"] for row in rows][:3] == ["frame", "motion", "encoders"]
    frame, *stages = rows
    assert 0 < sum(row["after_ms"] for row in stages) < 1.5 * frame["after_ms"]
    assert all(row["ratio"] > 0 and row["ratio_se"] >= 0 and row["before"] == row["after"] for row in rows)


def test_a_folder_without_a_player_is_refused(tmp_path) -> None:
    done = _run(ROOT, tmp_path, "--avatar", ROOT / "assets/avatar.onnx", "--json", tmp_path / "turns.json")
    assert done.returncode == 2
    assert "frame.py: checkout's player not found" in done.stderr
    assert not (tmp_path / "turns.json").exists()
