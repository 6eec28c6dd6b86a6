"""rnd-bench: what it measures is what it says, and it does not measure twice."""

from __future__ import annotations

import dataclasses
import itertools
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch

from rnd_bench import cli as bench_cli
from rnd_bench.scenes import avatars as bench_avatars
from rnd_bench.scenes.avatars import Encoders, exported, seeded_checkpoint
from rnd_bench.scenes.scenes import HARDEST, INSIDE, SQUAT, SUN, USUAL, Scene, bench_camera, scene
from rnd_bench.speed import chart as bench_chart
from rnd_bench.speed import clock as bench_clock
from rnd_bench.speed import frame as bench_frame
from rnd_bench.speed import grid as bench_grid
from rnd_bench.speed import growth as bench_growth
from rnd_bench.speed import peers as bench_peers
from rnd_bench.speed import point as bench_point
from rnd_bench.speed import reference as bench_reference
from rnd_bench.speed import shards as bench_shards
from rnd_bench.speed.chart import draw_chart
from rnd_bench.speed.frame import COMPARED, STEP_S, TURN, Drawn, Point
from rnd_bench.speed.grid import grid, pareto, settings
from rnd_bench.speed.hidden import showing
from rnd_bench.speed.point import Inputs, Setting, measured
from rnd_bench.speed.raster import body_scene
from rnd_bench.speed.reference import MOST_DB, Reference, errors, reference
from rnd_export.build.networks import LANES
from rnd_export.export import export
from rnd_export.reduce.variant import Variant
from rnd_runtime.avatar.avatar import Avatar
from rnd_runtime.capture.body import Body
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.rotations import matrix_to_axis_angle
from rnd_runtime.motion.motion import load_motion
from rnd_runtime.playback.frame import FrameRenderer
from rnd_runtime.raster import cpu as raster_cpu
from rnd_runtime.shading.light import load_light
from rnd_trainer.model.checkpoint import load_checkpoint
from support.tiny import ASSETS

WALK, SKY = ASSETS / "walk.npz", ASSETS / "sky.exr"
HERE = {"machine": "this one", "ms_median": 1.0}
LAST_BITS = 1e-5
"""of radiance in float32: a kernel that a process compiled itself and the same out of numba's cache differ by an ulp"""
BRUTE_DB = 65.0
"""the fastest exact path against the reference: float32 against float64, numba against numpy"""
SUNS_DB = 50.0
"""tables, and suns by their middle and spread; 56.4 measured"""


def _played(avatar_file, shade) -> Drawn:
    """The compared frames as a player draws them, 64 pixels wide."""
    avatar = Avatar.load(avatar_file)
    motion = load_motion(WALK, avatar.skeleton)
    renderer = FrameRenderer(avatar, load_light(SKY), bench_camera(64), shade=shade)
    pictures = []
    for number in COMPARED:
        renderer.turn(TURN * number)
        pictures.append(renderer.render(motion, STEP_S * number).radiance)
    means = np.array([avatar.pose(motion, STEP_S * number).means for number in COMPARED])
    return Drawn({}, np.array(pictures), means)


def test_table_sun_approaches_the_sum_behind_its_own_shadows(tiny_avatar, tmp_path) -> None:
    usual, with_suns = (
        errors(
            _played(tiny_avatar, "table+sun"),
            reference(tiny_avatar, Scene(WALK, SKY, USUAL), 64, tmp_path, with_suns=suns),
        )["psnr_db"]
        for suns in (False, True)
    )
    assert with_suns > SUNS_DB and usual < with_suns - 10


def test_the_reference_is_what_the_slowest_mode_approaches(tiny_avatar, tmp_path) -> None:
    truth = reference(tiny_avatar, Scene(WALK, SKY, USUAL), 64, tmp_path)
    decibels = {}
    for mode in ("brute", "ao"):
        found = errors(_played(tiny_avatar, mode), truth)
        decibels[mode] = found["psnr_db"]
        assert found["position_mm"] < 0.01
    assert decibels["brute"] > BRUTE_DB and decibels["ao"] < decibels["brute"] - 20
    assert truth.radiance.max() > 0.01
    kept = reference(tiny_avatar, Scene(WALK, SKY, USUAL), 64, tmp_path)  # the second time from the folder
    assert (kept.radiance == truth.radiance).all()


def test_errors_are_those_of_the_definition() -> None:
    grey = np.full((2, 4, 4, 3), 0.5)
    truth = Reference(grey, np.zeros((2, 5, 3)))
    assert errors(Drawn({}, grey, truth.means), truth)["psnr_db"] == MOST_DB
    other = grey.copy()
    other[1] = 1.0  # coded 0.7354 and 1: a difference of 0.2646
    means = np.zeros((2, 5, 3))
    means[1, 2, 0] = 0.003
    found = errors(Drawn({}, other, means), truth)
    assert found["psnr_db_worst"] == pytest.approx(-20 * np.log10(1 - 0.7353569), abs=1e-3)
    assert found["psnr_db"] == pytest.approx(found["psnr_db_worst"] + 10 * np.log10(2), abs=1e-6)
    assert found["position_mm"] == pytest.approx(3.0) and found["worst_frame"] == COMPARED[1]
    assert errors(Drawn({}, grey, np.zeros((2, 4, 3))), truth)["position_mm"] is None


def test_a_point_is_measured_in_a_process_of_its_own(tiny_avatar) -> None:
    drawn = bench_frame.measure(
        Point(str(tiny_avatar), str(WALK), str(SKY), size=48, shade="table", threads=1, frames=6)
    )
    row = drawn.row
    assert 0 < row["ms_min"] <= row["ms_median"] <= row["ms_p95"] and row["frames"] == 6
    assert {"encoders", "shading", "raster"} <= set(row["stages"])
    assert sum(row["stages"].values()) < 1.5 * row["ms_p95"]
    assert 50 < row["peak_mb"] < 2000 and row["file_mb"] == tiny_avatar.stat().st_size / 1e6
    assert drawn.radiance.shape == (len(COMPARED), 48, 48, 3) and drawn.radiance.max() > 0
    with pytest.raises(InputError, match="optix, table"):
        bench_frame.measure(Point(str(tiny_avatar), str(WALK), str(SKY), 48, "table", "optix", 1, 1))


def test_the_hardest_scenes_are_what_they_say(tiny_avatar, tmp_path) -> None:
    body = ASSETS / "body.npz"
    scenes = {name: scene(name, body, WALK, SKY, tmp_path, "key") for name in (USUAL, *HARDEST)}
    assert scenes[USUAL] == Scene(WALK, SKY, USUAL) and scenes[INSIDE] == Scene(WALK, SKY, INSIDE)
    assert load_light(scenes[SUN].hdr).radiance.max() > 0.5e6 and scenes[SUN].motion == WALK
    skeleton = Avatar.load(tiny_avatar).skeleton
    walking, squatting = (load_motion(scenes[name].motion, skeleton) for name in (USUAL, SQUAT))
    angles = matrix_to_axis_angle(squatting.rotations[:, squatting.joint_names.index("left_knee")])
    assert np.allclose(angles, [2.2, 0, 0], atol=1e-6) and squatting.frame_count == walking.frame_count
    neck = walking.joint_names.index("neck")
    assert np.allclose(walking.rotations[:, neck], squatting.rotations[:, neck], atol=1e-6)
    gaussians = Avatar.load(tiny_avatar).pose(walking, 0.0)
    low, high = gaussians.means.min(0), gaussians.means.max(0)
    inside, outside = (bench_camera(64, view).position for view in (INSIDE, USUAL))
    assert (low < inside).all() and (inside < high).all() and outside[2] > high[2] + 1
    for hard in scenes.values():
        truth = reference(tiny_avatar, hard, 32, tmp_path)
        assert np.isfinite(truth.radiance).all() and (truth.radiance > 0.01).mean() > 0.05


def test_those_that_show_nearly_make_the_picture_alone() -> None:
    scene, camera = body_scene(2000), bench_camera(64)
    kept = showing(*scene, camera)
    assert 0.5 < kept.mean() < 0.9  # a body hides its own back
    whole = raster_cpu.rasterize(*scene, camera, depth=False)
    alone = raster_cpu.rasterize(*(array[kept] for array in scene), camera, depth=False)
    assert 0 < np.mean((alone.image - whole.image) ** 2) < 1e-6
    assert np.abs(alone.image - whole.image).max() < 0.1


@pytest.mark.parametrize("raster", ["gl-egl", "gl-osmesa"])
def test_a_point_in_gl_has_the_cpus_pictures(tiny_avatar, raster) -> None:
    cpu, gl = (
        bench_frame.measure(Point(str(tiny_avatar), str(WALK), str(SKY), 48, "table+sun", kind, 1, 2))
        for kind in ("cpu", raster)
    )
    assert {"encoders", "shading", "raster", "read-back"} <= set(gl.row["stages"])
    assert errors(gl, Reference(cpu.radiance, cpu.means))["psnr_db"] > 50


def test_a_point_may_leave_the_back_out(tiny_avatar) -> None:
    """Measured as the renderer draws it; a cosine as high as this one leaves front out too."""
    point = Point(str(tiny_avatar), str(WALK), str(SKY), 48, "table", threads=1, frames=1)
    whole, culled = (bench_frame.measure(dataclasses.replace(point, cull=cull)).radiance for cull in (None, 0.5))
    avatar = Avatar.load(tiny_avatar, threads=1)
    renderer = FrameRenderer(avatar, load_light(SKY), bench_camera(48), shade="table", cull=0.5)
    renderer.turn(TURN * COMPARED[0])
    drawn = renderer.render(load_motion(WALK, avatar.skeleton), STEP_S * COMPARED[0]).radiance
    assert np.abs(culled[0] - drawn).max() < LAST_BITS and np.abs(culled - whole).max() > 0.01


def test_the_grid_varies_one_factor_at_a_time_and_a_crossed_core() -> None:
    points = settings()
    assert len(points) == len(set(points)) and points[0] == Setting()
    values = {name: {getattr(p, name) for p in points} for name in dataclasses.asdict(Setting())}
    assert values["n"] == {4_000, 8_000, 15_000, 30_000, 60_000} and values["size"] == {256, 512, 1024}
    assert values["raster"] == {"cpu", "gl-egl", "gl-osmesa"} and values["threads"] == {1, 2}
    assert values["cull"] == {None, *bench_grid.CULLS}
    assert values["encoder"] == {"full", "rates", "coarse", "static"} and values["precision"] == {"f32", "f16", "int8"}
    assert {"ao", "table", "table+sun", "brute"} < values["shade"] and len(values["window"]) == 3
    assert len(settings(quick=True)) < len(points) / 2


def test_factors_that_are_crossed_come_in_all_combinations() -> None:
    points = settings(cross=("n", "size", "shade", "encoder"))
    assert points[0] == Setting() and len(points) == len(set(points)) == 5 * 3 * 5 * 4
    assert Setting(n=60_000, size=1024, shade="brute", encoder="static") in points
    windows = settings(cross=("encoder", "window"))
    assert [(p.encoder, p.window) for p in windows].count(("static", None)) == 1
    assert {p.window for p in windows if p.encoder == "static"} == {None} and len(windows) == 10
    with pytest.raises(InputError, match=r"--cross: expected of n, size, .*cull, got colour"):
        settings(cross=("n", "colour"))


def test_a_factor_is_crossed_once() -> None:
    with pytest.raises(InputError, match="--cross: expected each factor once, got n,n"):
        settings(cross=("n", "n"), sample=3)


def test_a_sample_of_all_combinations_has_each_value_about_as_often_and_grows() -> None:
    few, many = settings(sample=60), settings(sample=180)
    assert many[: len(few)] == few and few[0] == Setting() and len(set(many)) == len(many) == 181
    for name, values in bench_grid.FACTORS.items():
        if name != "window":  # template skinning has none
            counts = [sum(getattr(point, name) == value for point in few[1:]) for value in values]
            assert max(counts) - min(counts) <= 1
    assert all(point.window is None for point in many if point.encoder == "static")
    alone = settings(cross=("threads", "shade"), sample=9)
    assert set(alone) == set(settings(cross=("threads", "shade")))
    quick = settings(True, cross=("n",), sample=4)  # the quick grid's usual point is another one
    assert len(set(quick)) == 5 and {point.size for point in quick} == {256}
    for count in (0, 10):
        with pytest.raises(InputError, match="--sample: expected 1 to 9 points"):
            settings(cross=("threads", "shade"), sample=count)


def test_a_crossed_grid_says_how_far_it_is(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(bench_grid, "measured", lambda setting, inputs, **_: dataclasses.asdict(setting) | HERE)
    monkeypatch.setattr(bench_grid, "machine", lambda: HERE["machine"])
    monkeypatch.setattr(bench_chart, "draw_chart", lambda rows, files: None)
    monkeypatch.setattr(bench_cli, "_line", lambda row: "")
    moments = itertools.count(0.0, 60.0)  # a minute between two looks at the clock
    monkeypatch.setattr(bench_cli, "perf_counter", lambda: next(moments))
    words = ["rnd-bench", "grid", "--cross", "threads, shade", "--work", str(tmp_path / "work")]

    def said(*more: str) -> tuple[int, list[str]]:
        monkeypatch.setattr(sys, "argv", [*words, *more])
        with pytest.raises(SystemExit) as ended:
            bench_cli.main()
        out, err = capsys.readouterr()
        return int(ended.value.code or 0), (out + err).splitlines()

    files = ["--json", str(tmp_path / "grid[a].json"), "--chart", str(tmp_path / "grid[/a].svg")]
    code, lines = said(*files)
    assert code == 0 and [line.strip() for line in lines[:10:4]] == [
        "(9 left)",
        "(5 left, about 5 min)",
        "(1 left, about 1 min)",
    ]
    assert lines[-1] == f"{files[1]}, {files[3]}"
    rows = json.loads((tmp_path / "grid[a].json").read_text())
    (tmp_path / "grid[a].json").write_text(json.dumps(rows[:7]))
    lines = said(*files)[1]
    assert [line.strip() for line in lines[5:10]] == [
        "(kept)",
        "(kept)",
        "(2 left)",
        "(1 left, about 1 min)",
        "(0 left, about 0 min)",
    ]


def test_an_interrupted_grid_goes_on_where_it_stopped(tmp_path, monkeypatch) -> None:
    calls: list[Setting] = []

    def pretend(setting: Setting, inputs: Inputs, **_: object) -> dict:
        if len(calls) == 3:
            raise KeyboardInterrupt
        calls.append(setting)
        if setting.raster == "gl-egl":
            raise InputError("no OpenGL here")
        return {**dataclasses.asdict(setting), "machine": "this one", "ms_median": 1.0}

    monkeypatch.setattr(bench_grid, "measured", pretend)
    monkeypatch.setattr(bench_grid, "machine", lambda: "this one")
    inputs = Inputs(ASSETS / "body.npz", WALK, SKY, tmp_path / "work")
    out = tmp_path / "grid.json"
    seen: list[bool] = []
    with pytest.raises(KeyboardInterrupt):
        grid(inputs, out, quick=True, on_row=lambda row, new, left: seen.append(new))
    assert len(json.loads(out.read_text())) == 3 == len(seen)
    calls.clear()
    monkeypatch.setattr(bench_grid, "measured", lambda s, i, **k: pretend(s, i) if calls.clear() is None else {})
    rows = grid(inputs, out, quick=True, on_row=lambda row, new, left: seen.append(new))
    assert seen == [True] * 3 + [False] * 3 + [True] * (len(settings(True)) - 3)
    assert [row for row in rows if "failed" in row] == [next(r for r in rows if r["raster"] == "gl-egl")]
    seen.clear()
    kept = ("reference_0a_lit.npz", "reference_0a_512.npz", "seeded_8000_0a.ckpt", "exported_0a_full_f32.onnx")
    mine = ("walk.npz", "avatar.ckpt", "avatar.onnx")
    for name in (*kept, *mine):
        (tmp_path / "work" / name).touch()
    grid(inputs, out, quick=True, fresh=True, on_row=lambda row, new, left: seen.append(new))
    assert all(seen) and len(seen) == len(settings(True))
    assert {file.name for file in (tmp_path / "work").iterdir()} == set(mine)
    assert {json.dumps(row, sort_keys=True) for row in json.loads(out.read_text())} == {
        json.dumps(row, sort_keys=True) for row in rows
    }


def test_rows_of_other_files_are_measured_again(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(bench_grid, "measured", lambda setting, inputs, **_: dataclasses.asdict(setting) | HERE)
    monkeypatch.setattr(bench_grid, "machine", lambda: "this one")
    body, out = tmp_path / "body.npz", tmp_path / "grid.json"
    inputs = Inputs(body, WALK, SKY, tmp_path / "work")

    def new_rows(given: Inputs = inputs) -> set[bool]:
        seen: set[bool] = set()
        grid(given, out, quick=True, on_row=lambda row, new, left: seen.add(new))
        return seen

    body.write_bytes(b"one")
    assert [new_rows(), new_rows()] == [{True}, {False}]
    body.write_bytes(b"another")
    assert [new_rows(), new_rows()] == [{True}, {False}]
    monkeypatch.setattr(bench_point, "checkpoint_model", lambda file: {"gaussians": len(file.read_bytes())})
    (tmp_path / "avatar.ckpt").write_bytes(b"trained")
    trained = dataclasses.replace(inputs, checkpoints=(tmp_path / "avatar.ckpt",))
    assert [new_rows(trained), new_rows(trained)] == [{True}, {False}]
    with pytest.raises(InputError, match="checkpoint not found"):
        new_rows(dataclasses.replace(inputs, checkpoints=(tmp_path / "nowhere.ckpt",)))
    (tmp_path / "other.ckpt").write_bytes(b"trained")
    both = dataclasses.replace(inputs, checkpoints=(tmp_path / "avatar.ckpt", tmp_path / "other.ckpt"))
    with pytest.raises(InputError, match="one avatar of 7 Gaussians"):
        new_rows(both)
    (tmp_path / "other.ckpt").write_bytes(b"a smaller one")
    assert both.source(7)[0].name == "avatar.ckpt" and both.source(13) == (tmp_path / "other.ckpt", "trained")
    assert [new_rows(both), new_rows(both)] == [{True}, {False}]
    monkeypatch.setattr(bench_point, "sources", lambda package: [body])  # other code is measured again
    assert [new_rows(both), new_rows(both)] == [{True}, {False}]


def test_what_is_kept_is_kept_by_what_its_sources_hold(tiny_avatar, tmp_path, monkeypatch) -> None:
    """Another body, motion, light, checkpoint or exporter under an old name is not taken for the old one."""
    made: list[list[str]] = []

    def pretend(line: list[str], **_: object) -> subprocess.CompletedProcess[str]:
        made.append(line)
        Path(line[line.index("--out") + 1]).touch()
        return subprocess.CompletedProcess(line, 0)

    monkeypatch.setattr(bench_avatars.subprocess, "run", pretend)
    assert "export.py" in {file.name for file in bench_avatars.sources("rnd_export")}
    checkpoint, code = tmp_path / "avatar.ckpt", tmp_path / "export.py"
    monkeypatch.setattr(bench_avatars, "sources", lambda package: [code])
    checkpoint.write_bytes(b"one")
    code.write_bytes(b"old")
    assert exported(checkpoint, Encoders(), tmp_path) == exported(checkpoint, Encoders(), tmp_path)
    assert len(made) == 1
    code.write_bytes(b"new")
    exported(checkpoint, Encoders(), tmp_path)
    monkeypatch.setattr(bench_avatars, "__version__", "9.9")
    exported(checkpoint, Encoders(), tmp_path)
    checkpoint.write_bytes(b"two")
    exported(checkpoint, Encoders(), tmp_path)
    assert len(made) == len({line[line.index("--out") + 1] for line in made}) == 4

    lit: list[Path] = []

    def shine(avatar: Path, scene: Scene, with_suns: bool) -> dict[str, np.ndarray]:
        lit.append(scene.motion)
        return {"means": np.zeros((0, 0, 3))}

    monkeypatch.setattr(bench_reference, "_lit", shine)
    monkeypatch.setattr(bench_reference, "COMPARED", ())
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "walk.npz").write_text(folder)
    for folder in ("a", "b", "a"):
        reference(tiny_avatar, Scene(tmp_path / folder / "walk.npz", SKY, USUAL), 8, tmp_path)
    assert lit == [tmp_path / "a" / "walk.npz", tmp_path / "b" / "walk.npz"]
    monkeypatch.setattr(bench_reference, "sources", lambda package: [code])
    reference(tiny_avatar, Scene(tmp_path / "a" / "walk.npz", SKY, USUAL), 8, tmp_path)
    assert len(lit) == 3  # by another formula
    near = bench_camera(8, INSIDE)
    monkeypatch.setattr(bench_reference, "bench_camera", lambda size, view: near)
    reference(tiny_avatar, Scene(tmp_path / "a" / "walk.npz", SKY, USUAL), 8, tmp_path)
    monkeypatch.setattr(bench_reference, "TURN", 0.5)
    reference(tiny_avatar, Scene(tmp_path / "a" / "walk.npz", SKY, USUAL), 8, tmp_path)
    assert len(lit) == 5  # from another place, and under a light that turns otherwise
    reference(tiny_avatar, Scene(tmp_path / "a" / "walk.npz", SKY, USUAL), 8, tmp_path, with_suns=True)
    assert len(lit) == 6


def test_a_seeded_avatar_stands_on_the_body_that_was_given(tmp_path) -> None:
    body = Body.load(ASSETS / "body.npz")
    body.save(tmp_path / "body.npz")
    before = seeded_checkpoint(60, tmp_path / "body.npz", tmp_path)
    assert seeded_checkpoint(60, tmp_path / "body.npz", tmp_path) == before
    dataclasses.replace(body, vertices=1.5 * body.vertices).save(tmp_path / "body.npz")
    after = seeded_checkpoint(60, tmp_path / "body.npz", tmp_path)
    heights = [np.ptp(load_checkpoint(file).model.points.numpy()[:, 1]) for file in (before, after)]
    assert heights[1] > 1.2 * heights[0]


def test_a_point_that_takes_too_long_is_one_of_those_that_fail(tiny_avatar, monkeypatch) -> None:
    monkeypatch.setattr(bench_frame, "DEADLINE_S", 0.05)
    with pytest.raises(InputError, match=r"cpu, ao: expected an answer within 0\.05 s, got none"):
        bench_frame.measure(Point(str(tiny_avatar), str(WALK), str(SKY), size=16, shade="ao"))


@pytest.mark.parametrize("words", [["--quick"], ["grid", "--quick"]])
def test_the_grid_is_what_rnd_bench_does_unless_told_otherwise(words, tmp_path, monkeypatch) -> None:
    asked = []
    monkeypatch.setattr(bench_cli, "_grid", asked.append)
    monkeypatch.setattr(sys, "argv", ["rnd-bench", *words, "--json", str(tmp_path / "grid.json")])
    with pytest.raises(SystemExit) as ended:
        bench_cli.main()
    assert not ended.value.code and asked[0].quick and asked[0].json == tmp_path / "grid.json"


def test_points_of_earlier_grids_stay_in_the_file_and_are_counted(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(bench_grid, "measured", lambda setting, inputs, **_: dataclasses.asdict(setting) | HERE)
    monkeypatch.setattr(bench_chart, "draw_chart", lambda rows, files: None)
    monkeypatch.setattr(bench_cli, "_line", lambda row: "")
    out = tmp_path / "grid.json"
    old = [dataclasses.asdict(Setting(n=n)) | HERE for n in (1, 2)]
    out.write_text(json.dumps(old))
    words = ["rnd-bench", "--quick", "--json", str(out), "--work", str(tmp_path / "work")]
    for more, kept in (([], 2), (["--fresh"], 0)):
        monkeypatch.setattr(sys, "argv", [*words, *more])
        with pytest.raises(SystemExit) as ended:
            bench_cli.main()
        said = capsys.readouterr().out
        assert not ended.value.code and len(json.loads(out.read_text())) == len(settings(True)) + kept
        assert (f"{kept} points of earlier grids" in said.replace("\n", " ")) == bool(kept)


def test_the_front_is_what_nothing_beats() -> None:
    rows = [{"ms_median": ms, "psnr_db": db} for ms, db in ((5, 30), (3, 20), (4, 20), (7, 29), (9, 40), (9, 35))]
    assert [(r["ms_median"], r["psnr_db"]) for r in pareto(rows)] == [(3, 20), (5, 30), (9, 40)]


def test_the_chart_holds_every_point_and_every_stage(tmp_path) -> None:
    rows = [
        {
            **dataclasses.asdict(Setting(n=n, encoder=encoder)),
            "ms_median": n / 1000,
            "psnr_db": 40 + n / 1e4,
            "stages": {"encoders": 3.0, "raster": n / 1e4},
            "machine": "this one",
            "avatar": "trained",
        }
        for n in (8_000, 30_000)
        for encoder in ("full", "coarse")
    ]
    files = [tmp_path / "chart.svg", tmp_path / "chart.png"]
    draw_chart(rows, files)
    svg = files[0].read_text("utf-8")
    for words in (
        "4 points on this one",
        "encoders",
        "raster",
        "30 000 Gaussians",
        "encoder coarse",
        "front of 8 000 at 512²:",
        " 1  table+sun: 8.0 ms, 40.8 dB",
    ):
        assert words in svg, words
    assert files[1].read_bytes()[:4] == b"\x89PNG"
    draw_chart(rows, [tmp_path / "again.svg"])
    assert (tmp_path / "again.svg").read_text("utf-8") == svg and "untrained" not in svg
    others = [rows[0], rows[1] | {"avatar": "seeded"}, rows[0] | {"scene": SQUAT, "ms_median": 1.0, "psnr_db": 99.0}]
    draw_chart(others, [tmp_path / "other.svg"])
    svg = (tmp_path / "other.svg").read_text("utf-8")
    assert "hollow: an untrained avatar" in svg and SQUAT in svg
    assert "99.0 dB" not in svg  # the front is of the usual scene
    with pytest.raises(InputError, match="at least one measured point"):
        draw_chart([{"failed": "x"}], files)


def test_seeded_avatars_follow_one_formula(tmp_path) -> None:
    """A larger one looks like a smaller one: the same fields at the same places, valid and not silent."""
    small, large = (load_checkpoint(seeded_checkpoint(n, ASSETS / "body.npz", tmp_path)).model for n in (300, 600))
    looks = []
    for model in (small, large):
        with torch.no_grad():
            static = model.attributes(model.encoded_nodes())
        looks.append(static.albedo.numpy())
        assert looks[-1].std() > 0.05 and float(static.opacity.mean()) > 0.9
        assert float(model.skinning.logits.weight.detach().abs().max()) > 0
    distances = np.linalg.norm(small.points.numpy()[:, None] - large.points.numpy()[None], axis=-1)
    near = distances.argmin(1)
    close = distances.min(1) < 0.01
    ours, theirs = looks[0][close], looks[1][near[close]]
    assert close.sum() > 10 and np.median(np.abs(ours - theirs)) < 0.05
    assert Encoders("coarse", "f16", 5).words(tmp_path) == [
        "--encoder",
        "coarse",
        "--precision",
        "f16",
        "--window-poses",
        "5",
    ]
    rates = Encoders("rates").words(seeded_checkpoint(800, ASSETS / "body.npz", tmp_path))
    assert rates[4:] == ["--skinning-nodes", "25", "--offset-nodes", "12"] and rates[1] == "full"


def test_peers_say_the_same(tiny_checkpoint, tiny_avatar, monkeypatch) -> None:
    monkeypatch.setattr(bench_clock, "REPEATS", 3)
    monkeypatch.setattr(bench_clock, "SECONDS", 0.0)
    monkeypatch.setattr(torch, "compile", lambda run: run)  # the compiler takes half a minute
    rows = bench_peers.encoders(tiny_checkpoint, tiny_avatar, 1)
    assert [row["peer"] for row in rows] == ["onnxruntime", "torch eager", "torch.compile"]
    assert all(row["ms_median"] > 0 and row["nodes"] == 200 for row in rows)
    orders = bench_peers.depth_order(600, 48, 1)
    assert [(row["stage"], row["peer"]) for row in orders] == [
        (f"projection+sort, {backend}", peer)
        for backend in ("egl", "osmesa")
        for peer in ("the CPU", "compute shaders")
    ]
    assert all(row["ms_median"] > 0 and "llvmpipe" in row["renderer"] for row in orders)


def test_growth_is_measured_beside_a_floor(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(bench_clock, "REPEATS", 3)
    monkeypatch.setattr(bench_clock, "SECONDS", 0.0)
    monkeypatch.setattr(bench_growth, "COPIED", 1 << 20)
    monkeypatch.setattr(bench_growth, "SECONDS", 0.2)
    inputs = Inputs(ASSETS / "body.npz", WALK, SKY, tmp_path)
    amounts = bench_growth.Amounts(gaussians=(300, 600), sides=(16, 32), lights=(2, 4), joints=(5, 24))
    grown = bench_growth.growth(inputs, amounts, 32, 1)
    assert [(row["stage"], row["of"]) for row in grown] == [
        *((stage, "Gaussians") for stage in ("encoders", "posing", "projection", "shading", "sort", "raster")),
        *((stage, "picture side") for stage in ("sort", "raster", "tone map")),
        ("shading", "lights"),
        ("posing", "joints"),
    ]
    for row in grown:
        assert len(row["ms"]) == len(row["amounts"]) == 2 and np.isfinite(row["exponent"])
        assert 0 < row["floor_ms"] < row["ms"][-1], row


def test_the_floor_counts_the_products_of_the_exported_networks(tiny_checkpoint, tiny_avatar) -> None:
    model = load_checkpoint(tiny_checkpoint).model
    nodes = len(model.encoded_nodes())
    inferred = onnx.shape_inference.infer_shapes(onnx.load(tiny_avatar), data_prop=True).graph
    shapes = {
        value.name: [axis.dim_value for axis in value.type.tensor_type.shape.dim]
        for value in (*inferred.value_info, *inferred.input, *inferred.output)
    } | {value.name: list(value.dims) for value in inferred.initializer}
    # what onnxruntime does once, when it loads the file
    constant = ("position/", "from_position", "position_part")
    counted = 0
    for node in inferred.node:
        a, b = ([*(shapes.get(name, []) for name in node.input), [], []])[:2]
        of_networks = node.output[0].startswith(("skinning/", "offsets/", "visibility/"))
        if (
            node.op_type == "MatMul"
            and a[:1] == [nodes]
            and of_networks
            and not any(c in node.output[0] for c in constant)
        ):
            counted += 2 * nodes * b[0] * b[1]
    others, filled = model.log_weights.shape[1] - 1, shapes["skinning/scores_by_head"][-1]
    assert filled % LANES == 0 and filled - others < LANES
    unneeded = 2 * nodes * 2 * model.config.width * 2 * model.config.heads * (filled - others)
    assert bench_growth.encoder_operations(model) == counted - unneeded


def test_a_file_is_measured_beside_its_own_checkpoints_whole_avatar(tiny_checkpoint, tiny_avatar, tmp_path):
    merged = tmp_path / "merged.onnx"
    checkpoint = load_checkpoint(tiny_checkpoint)
    export(checkpoint, merged, variant=Variant(encoder="coarse", nodes=40, window_poses=3), cull=-0.6)
    inputs = Inputs(ASSETS / "body.npz", WALK, SKY, tmp_path / "work", (tiny_checkpoint,)).checked()
    usual = Setting(size=32, shade="table", threads=1)
    rows = [measured(usual, inputs, seconds=0.1, file=file) for file in (tiny_avatar, merged)]
    for row, encoder, window in zip(rows, ("full", "coarse"), (None, 3)):
        assert (row["encoder"], row["window"], row["avatar"]) == (encoder, window, "exported")
        assert row["n"] == checkpoint.config.model.gaussians and "psnr_full_db" not in row
    assert rows[0]["psnr_db"] > rows[1]["psnr_db"] + 1
    # what its file advises is drawn, unless the setting says otherwise
    assert rows[1]["cull"] == -0.6
    whole = measured(dataclasses.replace(usual, cull=-1.0), inputs, seconds=0.1, file=merged)
    assert whole["cull"] == -1 and whole["psnr_db"] != rows[1]["psnr_db"]
    with pytest.raises(InputError, match="--checkpoint: expected the one that"):
        measured(usual, dataclasses.replace(inputs, checkpoints=()), file=merged)


def test_a_point_may_be_measured_again_and_again(tmp_path, monkeypatch, capsys) -> None:
    times = iter([9.0, 14.0, 10.0])

    def row(setting: Setting, *_: object, **__: object) -> dict[str, object]:
        taken = next(times)
        measures = {"ms_median": taken, "ms_p95": taken + 2, "cold_start_ms": 100 * taken}
        return dataclasses.asdict(setting) | measures | {"stages": {}, "peak_mb": 1.0, "file_mb": 1.0}

    monkeypatch.setattr(bench_point, "measured", row)
    out = tmp_path / "runs.json"
    words = ["rnd-bench", "frame", "--runs", "3", "--json", str(out), "--work", str(tmp_path / "work")]
    monkeypatch.setattr(sys, "argv", words)
    with pytest.raises(SystemExit) as ended:
        bench_cli.main()
    said = capsys.readouterr().out
    assert not ended.value.code and [r["ms_median"] for r in json.loads(out.read_text())] == [9, 14, 10]
    assert "median of 3 runs: 9.0 to 14.0 ms, in the middle 10.0" in said
    assert "p95 of 3 runs: 11.0 to 16.0 ms" in said and "cold start of 3 runs: 900.0" in said


def test_a_clip_is_spread_over_processes(tiny_avatar, monkeypatch) -> None:
    assert bench_shards.shards(10, 3) == [(0, 3), (3, 6), (6, 10)]
    assert bench_shards.ways(1) == [(1, 1)]
    monkeypatch.setattr(bench_shards, "REPEATS", 1)
    rows = list(bench_shards.bench_shards(tiny_avatar, WALK, SKY, 4, 32, 2))
    assert [(row["processes"], row["threads"]) for row in rows] == [(1, 1), (1, 2), (2, 1)]
    assert rows[0]["speed_up"] == 1 and all(row["fps"] == 4 / row["seconds"] for row in rows)
    with pytest.raises(InputError, match="rnd-play"):
        list(bench_shards.bench_shards(tiny_avatar, WALK, WALK, 4, 32, 2))
