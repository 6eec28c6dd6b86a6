"""The grid: its points, that it resumes, its chart, and the command."""

from __future__ import annotations

import dataclasses
import json

import pytest

from rnd_bench.cli import main
from rnd_bench.speed import grid as grids
from rnd_bench.speed import point
from rnd_bench.speed.chart import draw_chart
from rnd_bench.speed.grid import grid, pareto, settings
from rnd_bench.speed.point import Inputs, Setting
from rnd_runtime.core.errors import InputError
from support.tiny import ASSETS

WALK, SKY = ASSETS / "walk.npz", ASSETS / "sky.exr"
HERE = {"machine": "this one", "ms_median": 1.0}


def test_the_grid_varies_one_factor_at_a_time_and_a_crossed_core() -> None:
    points = settings()
    assert len(points) == len(set(points)) and points[0] == Setting()
    for name, values in grids.FACTORS.items():
        assert set(values) == {getattr(p, name) for p in points} - ({-0.2} if name == "window" else set())
    assert len(settings(quick=True)) < len(points) / 2


def test_factors_that_are_crossed_come_in_all_combinations() -> None:
    points = settings(cross=("n", "size", "shade", "encoder"))
    assert points[0] == Setting() and len(points) == len(set(points)) == 5 * 3 * 5 * 3
    assert Setting(n=60_000, size=1024, shade="brute", encoder="static") in points
    windows = settings(cross=("encoder", "window"))
    assert {p.window for p in windows if p.encoder == "static"} == {None} and len(windows) == 7
    with pytest.raises(InputError, match=r"--cross: expected of n, size, .*cull, got colour"):
        settings(cross=("n", "colour"))
    with pytest.raises(InputError, match="--cross: expected each factor once, got n,n"):
        settings(cross=("n", "n"))


def test_an_interrupted_grid_resumes(tmp_path, monkeypatch) -> None:
    calls: list[Setting] = []

    def pretend(setting: Setting, inputs: Inputs, **_: object) -> dict:
        if len(calls) == 3:
            raise KeyboardInterrupt
        calls.append(setting)
        if setting.raster == "gl-egl":
            raise InputError("no OpenGL here")
        return dataclasses.asdict(setting) | HERE

    monkeypatch.setattr(grids, "measured", pretend)
    monkeypatch.setattr(grids, "machine", lambda: "this one")
    inputs = Inputs(ASSETS / "body.npz", WALK, SKY, tmp_path / "work")
    out = tmp_path / "grid.json"
    seen: list[bool] = []

    def go(**more: bool) -> list:
        return grid(inputs, out, quick=True, on_row=lambda row, new, left: seen.append(new), **more)

    with pytest.raises(KeyboardInterrupt):
        go()
    assert len(json.loads(out.read_text())) == 3 == len(seen)
    monkeypatch.setattr(grids, "measured", lambda s, i, **k: pretend(s, i) if calls.clear() is None else {})
    rows = go()
    assert seen == [True] * 3 + [False] * 3 + [True] * (len(settings(True)) - 3)
    assert [row["raster"] for row in rows if "failed" in row] == ["gl-egl"]
    seen.clear()
    stored = ("reference_0a_lit.npz", "seeded_8000_0a.ckpt", "exported_0a_full_f32.onnx")
    mine = ("walk.npz", "avatar.ckpt", "avatar.onnx")
    for name in (*stored, *mine):
        (tmp_path / "work" / name).touch()
    go(fresh=True)
    assert all(seen) and len(seen) == len(settings(True))
    assert {file.name for file in (tmp_path / "work").iterdir()} == set(mine)


def test_rows_of_other_files_or_code_are_measured_again(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(grids, "measured", lambda s, i, **_: dataclasses.asdict(s) | HERE)
    monkeypatch.setattr(grids, "machine", lambda: "this one")
    monkeypatch.setattr(point, "checkpoint_model", lambda file: {"gaussians": len(file.read_bytes())})
    out, body, trained = tmp_path / "grid.json", tmp_path / "body.npz", tmp_path / "avatar.ckpt"
    body.write_bytes((ASSETS / "body.npz").read_bytes())
    trained.write_bytes(b"trained")
    seeded = Inputs(body, WALK, SKY, tmp_path / "work")
    other = dataclasses.replace(seeded, checkpoints=(trained,))

    def new_rows(inputs: Inputs) -> set[bool]:
        seen: list[bool] = []
        grid(inputs, out, quick=True, on_row=lambda row, new, left: seen.append(new))
        return set(seen)

    assert [new_rows(seeded), new_rows(seeded), new_rows(other), new_rows(other)] == [{True}, {False}] * 2
    with body.open("ab") as stream:
        stream.write(b"\0")
    assert [new_rows(other), new_rows(other)] == [{True}, {False}]
    monkeypatch.setattr(point, "sources", lambda package: [body])
    assert [new_rows(other), new_rows(other)] == [{True}, {False}]
    (tmp_path / "twice.ckpt").write_bytes(b"another")
    with pytest.raises(InputError, match="--checkpoint: expected one avatar of 7 Gaussians"):
        dataclasses.replace(other, checkpoints=(trained, tmp_path / "twice.ckpt")).checked()


def test_the_front_is_what_nothing_beats() -> None:
    rows = [{"ms_median": ms, "psnr_db": db} for ms, db in ((5, 30), (3, 20), (4, 20), (7, 29), (9, 40), (9, 35))]
    assert [(r["ms_median"], r["psnr_db"]) for r in pareto(rows)] == [(3, 20), (5, 30), (9, 40)]


def test_the_chart_names_its_machine_and_is_the_same_again(tmp_path) -> None:
    measures = {"ms_median": 8.0, "psnr_db": 40.8, "stages": {"raster": 1.0}, "machine": "this one", "avatar": "seeded"}
    rows = [dataclasses.asdict(Setting(n=n)) | measures for n in (8_000, 30_000)]
    files = [tmp_path / name for name in ("chart.svg", "again.svg", "chart.png")]
    draw_chart(rows, files[:1])
    draw_chart(rows, files[1:])
    svg = files[0].read_text("utf-8")
    assert "this one" in svg and "an untrained avatar" in svg and files[1].read_text("utf-8") == svg
    assert files[2].read_bytes()[:4] == b"\x89PNG"
    with pytest.raises(InputError, match="at least one measured point"):
        draw_chart([{"failed": "x"}], files)


def test_a_point_may_be_measured_again_and_again(tmp_path, monkeypatch, capsys) -> None:
    times = iter([9.0, 14.0, 10.0])

    def row(setting: Setting, *_: object, **__: object) -> dict[str, object]:
        taken = next(times)
        measures = {"ms_median": taken, "ms_p95": taken + 2, "cold_start_ms": 100 * taken}
        return dataclasses.asdict(setting) | measures | {"stages": {}, "peak_mb": 1.0, "file_mb": 1.0}

    monkeypatch.setattr(point, "measured", row)
    out = tmp_path / "runs.json"
    line = ["frame", str(ASSETS), "--runs", "3", "--json", str(out), "--work", str(tmp_path / "work")]
    assert main(line) == 0
    text = capsys.readouterr().out
    assert [r["ms_median"] for r in json.loads(out.read_text())] == [9, 14, 10]
    assert "median of 3 runs: 9.0 to 14.0 ms, median 10.0" in text and "p95 of 3 runs: 11.0 to 16.0 ms" in text


@pytest.mark.parametrize("words", [[], ["study"]])
def test_without_a_command_the_help_is_printed(words, capsys) -> None:
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert not ended.value.code and "usage: rnd-bench" in capsys.readouterr().out
