"""rnd-bench stability: its table, that a row replaces itself, and what a capture lacks."""

from __future__ import annotations

import dataclasses
import json

import msgspec
import numpy as np
import pytest

from rnd_bench.scenes.psnr import IDENTICAL_DB, decibels
from rnd_bench.scenes.subject import Subject
from rnd_bench.stability import soak
from rnd_bench.stability.figures import Figure, above, below, holds, not_measured, reported
from rnd_bench.stability.measures import captures, materials, poses, stress
from rnd_bench.stability.rows import AVATAR
from rnd_bench.stability.table import line_of, rows_of, store
from rnd_runtime.core.errors import InputError

pytestmark = pytest.mark.slow


def _about(name: str, failure: str) -> dict:
    return {"id": name, "failure": failure, "on": AVATAR, "machine": "this one"}


def test_the_table_holds_other_rows_and_replaces_its_own(tmp_path):
    file = tmp_path / "table.json"
    image = np.full((4, 6, 3), 9, np.uint8)
    store(file, _about("L1", "suns"), (below("energy", 0.2, 1, "%", baseline=("bilinear", 39.0)),))
    for measured in (1.0, 5.0):
        store(
            file,
            _about("P1", "poses"),
            (above("edges", measured, 3, "×"), reported("length", 2.0, "m")),
            (image, image),
        )
    rows = rows_of(file)
    verdicts = [("P1", 5.0, "pass"), ("P1", 2.0, "reported"), ("L1", 0.2, "pass")]
    assert [(row["id"], row["measured"], row["verdict"]) for row in rows] == verdicts
    assert rows[2]["baseline"] == 39.0 and rows[2]["line"] == "< 1" and rows[2]["machine"] == "this one"
    assert "| L1 | suns | energy | 0.2 % | < 1 | ✓ | bilinear: 39 % |" in (tmp_path / "table.md").read_text()
    assert (tmp_path / "table" / "P1.png").exists()
    file.write_text('[{"fps": 60}]')
    with pytest.raises(InputError, match="expected rows of rnd-bench stability, got another file"):
        rows_of(file)


def test_the_worst_cases_are_timed_and_compared(bare):
    measured = {figure.what: figure.measured for figure in stress.worst_cases(bare).figures}
    for scene in ("an ordinary frame", "camera inside the body", "squat", "light of 1e6"):
        assert 0 < measured[f"{scene}: frame time, median"] <= measured[f"{scene}: frame time, p95"]
        assert 20 < measured[f"{scene}: PSNR to the full reference"] < 120


def test_missing_figures_and_nan_never_pass(tmp_path):
    file, nan = tmp_path / "table.json", float("nan")
    figures = (not_measured("scale"), below("pace", nan, 1, "×", baseline=("plain", nan)), reported("lost", nan, "dB"))
    assert not any(figure.passes for figure in figures) and not holds("x", ["one"]).passes and holds("x", []).passes
    store(file, _about("L11", "scale"), figures)
    store(file, _about("P1", "poses"), (reported("length", 2.0, "m"),))
    verdicts = [(2.0, "reported"), (None, "not measured"), (None, "fail"), (None, "fail")]
    assert [(row["measured"], row["verdict"]) for row in json.loads(file.read_text())] == verdicts
    table = (tmp_path / "table.md").read_text()
    assert "| L11 | scale | scale (not in this capture) | not measured |  |  |  |" in table
    assert "| L11 | scale | pace | nan × | < 1 | **✗** | plain: nan × |" in table
    assert line_of("L11", figures[1]) == "✗ L11  pace: nan × < 1  (plain: nan)"


def test_a_leak_is_growth_and_no_single_allocation():
    """Readings every twenty steps from the 200th on; the second kind begins with step 800."""
    once, leak = [0] * 30 + [10**6] * 60, [2_000 * 20 * k for k in range(90)]
    for memory, passes in ((once, True), (leak, False)):
        segment = {"frames": 2000, "memory": memory, "seconds": [], "loads": [], "wrong": 0}
        figures = soak._figures("training", [segment], False, (800, 2000))
        assert [figure.what.partition(": ")[2] for figure in figures] == [
            "memory a frame",
            "memory a frame, within each kind of step",
        ]
        assert figures[1].passes is passes


@pytest.fixture(scope="module")
def bare(tiny_avatar, tiny_checkpoint, tiny_capture, tmp_path_factory) -> Subject:
    """A capture of five images to train on: no other lights or poses, no albedo, no normals."""
    frames = tuple(msgspec.structs.replace(frame, normal=None) for frame in tiny_capture.frames if frame.frame < 5)
    capture, work = dataclasses.replace(tiny_capture, frames=frames), tmp_path_factory.mktemp("bare")
    return Subject(tiny_avatar, tiny_checkpoint, capture, work, small=True, size=24)


def _missing(figures: tuple[Figure, ...]) -> list[str]:
    """What was not measured; the others are numbers."""
    missing = [figure for figure in figures if figure.measured is None]
    assert not any(np.isnan(figure.measured) for figure in figures if figure not in missing)
    assert all(not figure.line and not figure.passes and "this capture)" in figure.what for figure in missing)
    return [figure.what.split(" (")[0] for figure in missing]


def test_what_a_capture_lacks_is_not_measured(bare):
    assert len(_missing(materials.relit_scale(bare).figures)) == 4
    assert _missing(materials.baked_light(bare).figures) == ["|correlation| of albedo error and irradiance"]
    assert _missing((materials.lost_to_exact(bare),)) == ["PSNR lost to exact visibility on held-out poses"]
    assert _missing((poses.held_out_poses(bare)[0],)) == ["PSNR over template LBS on held-out poses, mean"]
    assert len(_missing(captures.broken_captures(bare).figures)) == 1
    assert len(_missing(captures.bad_masks(bare).figures)) == 2


def test_an_image_that_is_not_finite_is_not_identical():
    spoilt = np.full((2, 2), np.nan)
    assert np.isnan(decibels(spoilt, np.ones((2, 2)))) and decibels(np.ones(3), np.ones(3)) == IDENTICAL_DB
    assert not above("PSNR", decibels(spoilt, spoilt), 45, "dB").passes
