"""rnd-bench --stability: its options, its table, and that a row replaces itself."""

from __future__ import annotations

import json

import numpy as np

from rnd_trainer.bench_stability import StabilityOptions, _keep, stability_main
from rnd_trainer.stability.figures import Result, above, below, holds, stated
from rnd_trainer.stability.rows import ROWS


def test_every_row_of_the_list_is_there_once():
    ids = [row.id for row in ROWS]
    expected = {
        "P": (1, 2, 3, 4, 7, 8, 9, 10, 11, 13, 14, 15, 16, 17),
        "G": (1, 2, 3, 5, 6, 7, 9, 10),
        "L": (1, 2, 3, 4, 5, 7, 8, 9, 10, 11, 12, 13, 15),
        "R": (1, 2, 3, 4, 5, 6, 9, 10, 11, 12),
    }
    assert ids == [f"{letter}{number}" for letter, numbers in expected.items() for number in numbers]


def test_unknown_rows_are_refused(capsys):
    assert stability_main(["--rows", "P1,Q9"]) == 2
    assert "--rows: expected some of P1,P2" in capsys.readouterr().err


def test_another_file_is_refused_before_anything_is_measured(tmp_path, capsys):
    kept = tmp_path / "rows.json"
    kept.write_text('[{"fps": 60}]')
    assert stability_main(["--rows", "P1", "--json", str(kept)]) == 2
    assert "--json: expected rows of rnd-bench --stability, got another file" in capsys.readouterr().err
    assert kept.read_text() == '[{"fps": 60}]'


def test_the_table_keeps_other_rows_and_replaces_its_own(tmp_path):
    options = StabilityOptions(json=tmp_path / "table.json")
    picture = np.full((4, 6, 3), 9, np.uint8)
    _keep(options, "L1", "suns", (below("energy", 0.2, 1, "%", baseline=("bilinear", 39.0)),), None)
    for measured in (1.0, 5.0):
        result = Result((above("edges", measured, 3, "×"), stated("length", 2.0, "m")), (picture, picture))
        _keep(options, "P1", "poses", result.figures, result)
    rows = json.loads(options.json.read_text())
    assert [(row["id"], row["measured"], row["verdict"]) for row in rows] == [
        ("P1", 5.0, "pass"), ("P1", 2.0, "reported"), ("L1", 0.2, "pass"),
    ]  # fmt: skip
    assert rows[2]["baseline"] == 39.0 and rows[2]["line"] == "< 1"
    assert "| L1 | suns | energy | 0.2 % | < 1 | ✓ | bilinear: 39 % |" in (tmp_path / "table.md").read_text()
    assert (tmp_path / "table" / "P1.png").exists()


def test_a_number_that_is_none_never_passes():
    nan = float("nan")
    assert not below("x", nan, 1).passes and not above("x", nan, 1).passes and not stated("x", nan).passes
    assert holds("x", []).passes and not holds("x", ["one"]).passes
