"""The search for the cheapest file: merging, dynamic skinning by need, and bounds that hold where nobody looked."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import onnx
import pytest
from numba import get_num_threads
from scipy.spatial import cKDTree

from rnd_export.bake import BakedAvatar, bake
from rnd_export.cli import main
from rnd_export.order import order_gaussians
from rnd_export.parity import random_motion
from rnd_export.reduce.merge import fitted_albedo, merge_gaussians
from rnd_export.reduce.variant import Variant, static_where
from rnd_export.reduce.views import COUNT, FIT_COUNT, views_around, views_of
from rnd_export.search import bounded
from rnd_export.search.budget import LADDERS, Bound, Plan, given_up, search
from rnd_export.search.candidates import Measured, Recipe, SearchScene, Workbench
from rnd_export.search.timing import PairedTimer
from rnd_runtime.avatar.avatar import Avatar
from rnd_runtime.avatar.file import read_metadata
from rnd_runtime.avatar.onnx_parts import OnnxFile
from rnd_runtime.capture.capture import load_capture
from rnd_runtime.core.errors import InputError
from rnd_runtime.raster.cpu import rasterize
from rnd_runtime.shading.light import Light
from rnd_trainer.config import ModelConfig
from rnd_trainer.model.checkpoint import load_checkpoint, save_checkpoint
from support.tiny import ASSETS

CONFIG = ModelConfig(nodes=7_500)  # whose formulas below have as many nodes to give up


def _clock(avatar: Avatar) -> float:
    """Costs as a machine would have them, but the same every time: by Gaussians and by nodes with attention."""
    variant = avatar.metadata.variant
    return 1e-3 * avatar.gaussians + 4e-3 * variant.dynamic_nodes + 1e-3 * variant.nodes


@pytest.fixture(scope="module")
def bench(tiny_checkpoint) -> Workbench:
    moves = random_motion(load_checkpoint(tiny_checkpoint).skeleton, frames=60, seed=5)
    light = Light(np.ones((32, 64, 3), np.float32))
    return Workbench(load_checkpoint(tiny_checkpoint), SearchScene(moves, light, size=(96, 96), shade="table"), _clock)


@pytest.mark.slow
def test_a_minimum_psnr_holds_in_held_out_views(bench) -> None:
    steps = []
    found = search(bench, Bound("psnr", 32.0), steps.append)
    again = bench.measure(found.model, bench.held_out)
    assert again.psnr == found.held_out.psnr >= 32.0
    whole = steps[0].measured
    assert found.measured.ms < 0.9 * whole.ms and whole.psnr > 100
    seen, held_out = ({view.time for view in views} for views in (bench.search, bench.held_out))
    assert not seen & held_out


@pytest.mark.slow
def test_the_command_keeps_the_bound_and_adds_a_row(
    tiny_checkpoint, tiny_avatar, tmp_path, monkeypatch, capsys
) -> None:
    def run(*options: str) -> int:
        given = [str(tiny_checkpoint), "--size", "48", "--frames", "30", *options]
        return main([*given, "--out", str(tmp_path / "small.onnx")])

    rows = tmp_path / "bounds.json"
    most = 0.7 * tiny_avatar.stat().st_size / 1e6
    for value in (2 * most, most):
        assert run("--max-mb", f"{value:.3f}", "--json", str(rows)) == 0
    first, second = json.loads(rows.read_text())
    assert first["given_up"] == "nothing" and first["steps"] == 0 and second["bound"] == f"--max-mb {most:.3f}"
    assert (tmp_path / "small.onnx").stat().st_size / 1e6 == pytest.approx(second["mb"], rel=1e-3)
    assert second["mb"] <= most and second["given_up"] in capsys.readouterr().out.replace("\n", "")
    assert (second["shots"], second["threads"]) == ("around", get_num_threads())
    assert 0 < second["ms_median"] <= second["ms_p95"]
    assert run("--max-mb", "100", "--json", str(rows), "--capture", str(ASSETS / "capture")) == 2
    assert "--frames: expected the default, got 30 (--capture has a motion of its own)" in capsys.readouterr().err
    rows.write_text('[{"fps": 60}]')
    assert run("--max-mb", "1", "--json", str(rows)) == 2
    assert "rows of an earlier search" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "refused"),
    [
        (["--json", "bounds.json"], "--json: expected the default, got bounds.json (needs --target-ms"),
        (["--max-mb", "4", "--size", "8"], "--size: expected 16 to 16384, got 8"),
        (["--max-mb", "4", "--hdr-up", "z"], "--hdr-up: expected the default, got z (needs --hdr)"),
        (["--size", "64"], "--size: expected the default, got 64 (needs --target-ms"),
        (["--max-mb", "4", "--precision", "int8"], "--precision: expected the default, got int8 (a bound finds"),
        (["--max-mb", "4", "--cull", "-0.5"], "--cull: expected the default, got -0.5 (a bound finds"),
        (["--target-ms", "0"], "--target-ms: expected more than 0, got 0"),
        (["--max-mb", "4", "--window-poses", "5"], "--window-poses: expected the default, got 5 (a bound finds"),
    ],
)
def test_options_that_would_do_nothing_are_refused(
    options, refused, tiny_checkpoint, tmp_path, monkeypatch, capsys
) -> None:
    out = tmp_path / "small.onnx"
    assert (
        main([str(tiny_checkpoint), *options, "--out", str(out)]) == 2
        and refused in capsys.readouterr().err
        and not out.exists()
    )


class _Formula:
    """A workbench whose files are their recipes and whose measures follow from them."""

    search, held_out = "search", "held out"

    def __init__(self, harder: float = 0.0) -> None:
        self.config, self._harder = CONFIG, harder

    def model(self, recipe: Recipe) -> Recipe:
        return recipe

    def measure(self, recipe: Recipe, views: str) -> Measured:
        variant = recipe.variant
        n, m = recipe.gaussians or self.config.gaussians, variant.nodes or self.config.nodes
        dynamic = 1 / (1 + recipe.dynamic_mm)
        bits = {"f32": 1.0, "f16": 0.6, "int8": 0.4}[variant.precision]
        square = 1e-9 + 1e-5 * (1 - bits) + 1e-4 * (1 - n / 30_000) + 2e-5 * (1 - dynamic) + 1e-5 * (1 - m / 7_500)
        square *= 1 + self._harder * (views == "held out")
        mb = bits * (1 + n / 10_000)
        return Measured(float(-10 * np.log10(square)), 4 + n / 5_000 + m / 1_500 * dynamic, mb)

    def allows(self, precision: str) -> bool:
        return True

    def still_share(self, recipe: Recipe) -> float:
        return 0.5


@pytest.mark.parametrize(("kind", "value"), [("mb", 2.5), ("mb", 0.9), ("ms", 9.0)])
def test_cost_bounds_hold_and_no_more_is_given_up_than_needed(kind, value) -> None:
    bench, steps = _Formula(), []
    found = search(bench, Bound(kind, value), steps.append)
    assert getattr(found.held_out, kind) <= value < getattr(steps[-2].measured, kind)
    psnr = [step.measured.psnr for step in steps]
    assert psnr == sorted(psnr, reverse=True) and len(psnr) > 1
    if kind == "mb":  # bits are cheaper than Gaussians in this formula
        assert found.plan.precision == 1 + (value < 2) and (found.plan.gaussians > 0) == (value < 1)
    else:
        assert found.plan.nodes > 0 and found.plan.precision == 0  # bits save no time
    assert given_up(bench, found.plan) != ["nothing"] == given_up(bench, Plan())


class _Machine:
    """A clock, and players whose frames take so many ms of it, three times as many from a moment on, or until one."""

    def __init__(self, busy_from: float) -> None:
        self.seconds, self._busy_from, self.busy_until = 0.0, busy_from, 0.0

    def player(self, ms: float):
        def draw(frame: int) -> None:
            busy = self.seconds > self._busy_from or self.seconds < self.busy_until
            self.seconds += 1e-3 * ms * (3 if busy else 1)

        return draw


@pytest.mark.parametrize("busy_from", [0.4, 0.5, 0.7, 9.0])
def test_a_busy_machine_does_not_make_a_file_slower(busy_from) -> None:
    machine = _Machine(busy_from)
    timer = PairedTimer(machine.player(20.0), lambda: machine.seconds)
    assert timer.ms(machine.player(20.0)) == pytest.approx(20.0)
    assert timer.ms(machine.player(15.0)) == pytest.approx(15.0)


def test_a_machine_that_becomes_calm_is_noticed_once() -> None:
    machine = _Machine(99.0)
    machine.busy_until = 9.0
    timer = PairedTimer(machine.player(20.0), lambda: machine.seconds)
    assert timer.ms(machine.player(10.0)) == pytest.approx(30.0) and not timer.recalibrated()
    machine.seconds = 9.0
    timer.ms(machine.player(10.0))
    assert timer.recalibrated() and not timer.recalibrated()
    assert timer.ms(machine.player(10.0)) == pytest.approx(10.0)


@pytest.mark.slow
@pytest.mark.parametrize("bound", ["--target-ms", "--max-mb"])
def test_a_search_on_a_busy_machine_begins_again_where_time_counts(
    bound, tiny_checkpoint, tmp_path, monkeypatch, capsys
) -> None:
    busy = iter([True, False])
    monkeypatch.setattr(Workbench, "recalibrated", lambda self: next(busy))
    out = tmp_path / "small.onnx"
    status = main([str(tiny_checkpoint), "--size", "48", "--frames", "30", bound, "1000", "--out", str(out)])
    said = capsys.readouterr().out
    assert status == 0 and out.exists() and next(busy, None) is None
    assert ("begins again" in said) == (bound == "--target-ms")


def test_what_cannot_be_kept_is_refused() -> None:
    with pytest.raises(InputError, match=r"no file keeps the bound of mb: expected 0\.01"):
        search(_Formula(), Bound("mb", 0.01), lambda found: None)


class _StaticAtLast(_Formula):
    """The size of a dynamic file: skinning at fewer nodes stores a little more, none at all a third less, and a lower
    degree of visibility, whichever, half a hundredth less."""

    def measure(self, recipe: Recipe, views: str) -> Measured:
        what, degree = super().measure(recipe, views), recipe.variant.visibility_degree
        skinning = 0.0 if recipe.dynamic_mm == np.inf else 1.01 if recipe.dynamic_mm else 1.0
        return what._replace(mb=what.mb * (0.67 + 0.33 * skinning) * (1 - 0.005 * (3 - degree)))


def _smallest(bench: _Formula) -> float:
    deepest = Plan(**{name: len(rungs) for name, rungs in LADDERS.items()})
    return bench.measure(deepest.recipe(CONFIG), "search").mb


@pytest.mark.parametrize("share", [1.001, 1.02, 1.4])
def test_a_size_that_any_file_has_is_found(share) -> None:
    """Down ladders whose first rungs save nothing, and those that save little each."""
    bench = _StaticAtLast()
    found = search(bench, Bound("mb", share * _smallest(bench)), lambda found: None)
    assert found.held_out.mb <= share * _smallest(bench)
    assert found.plan.recipe(CONFIG).dynamic_mm == np.inf or share > 1.1


def test_what_saves_most_for_its_cost_may_be_far_down_its_ladder() -> None:
    """Static skinning costs this formula 2e-5 for a third of the size, and 0.85 of the Gaussians 1.5e-5 for a tenth."""
    bench, steps = _StaticAtLast(), []
    search(bench, Bound("mb", 0.27 * bench.measure(Recipe(), "search").mb), steps.append)
    plan = steps[-1].plan
    assert (plan.precision, plan.dynamic_mm, plan.gaussians) == (2, len(LADDERS["dynamic_mm"]), 0)


class _Exact(_Formula):
    """Where constants of fewer bits than 16 move too much."""

    def allows(self, precision: str) -> bool:
        return precision != "int8"


def test_a_precision_that_moves_places_too_far_is_not_taken() -> None:
    deepest = {name: len(rungs) for name, rungs in LADDERS.items()} | {"precision": 1}
    smallest = _Exact().measure(Plan(**deepest).recipe(CONFIG), "search").mb
    assert search(_Exact(), Bound("mb", 1.01 * smallest), lambda _: None).plan.precision == 1
    with pytest.raises(InputError, match="no file keeps"):
        search(_Exact(), Bound("mb", 0.99 * smallest), lambda _: None)
    assert search(_Formula(), Bound("mb", 0.99 * smallest), lambda _: None).plan.precision == 2


def test_a_file_that_fails_unseen_is_given_up_for_the_one_before() -> None:
    easy, hard = (search(_Formula(harder), Bound("psnr", 45.0), lambda found: None) for harder in (0.0, 0.5))
    assert easy.held_out.psnr >= 45 and hard.held_out.psnr >= 45
    assert easy.measured.ms < hard.measured.ms
    failing = _Formula(0.5).measure(easy.model, "held out")
    assert failing.psnr < 45 <= easy.measured.psnr


def test_dynamic_skinning_stays_where_it_moves_something(bench) -> None:
    """By its own measure: nothing in the poses searched moves by more than the limit."""
    moves = bench._node_moves(bench._baked)
    limit = float(np.median(moves))
    some = Recipe(dynamic_mm=limit)
    model, share = bench.model(some), bench.still_share(some)
    assert 0.4 < share < 0.6 and _sites(model) == {"skinning": round(len(moves) * (1 - share))}
    whole, less = (bench.measure(bench.model(r), bench.search) for r in (Recipe(), some))
    static = bench.measure(bench.model(Recipe(Variant("static"))), bench.search)
    assert static.psnr + 3 < less.psnr < whole.psnr


def _sites(model: onnx.ModelProto) -> dict[str, int]:
    """At how many nodes each network is evaluated that is not at all of them."""
    stored = [tensor for tensor in model.graph.initializer if tensor.name.endswith("/sites_rows")]
    return {tensor.name.partition("/")[0]: tensor.dims[0] for tensor in stored}


def test_what_a_bound_does_not_need_is_taken_back() -> None:
    """What the search ends with has no step that could be taken back: each would break the bound or gain nothing."""
    bench, steps, most_ms = _Formula(), [], 9.5
    found = search(bench, Bound("ms", most_ms), steps.append)
    assert steps[-2].measured.psnr < steps[-1].measured.psnr and steps[-1].plan == found.plan
    for name in LADDERS:
        if rung := getattr(found.plan, name):
            less = replace(found.plan, **{name: rung - 1}).recipe(bench.config)
            measured = bench.measure(less, "held out")
            assert measured.ms > most_ms or measured.psnr <= found.measured.psnr, name


def test_rows_of_nodes_may_be_reordered(tiny_checkpoint) -> None:
    baked = bake(load_checkpoint(tiny_checkpoint).model)
    still = np.arange(len(baked.codes)) % 3 == 0
    other = static_where(baked, still)
    assert other.dynamic_nodes == (~still).sum()
    assert (other.codes[other.neighbours] == baked.codes[baked.neighbours]).all()
    assert (other.all_codes[other.node_rows] == other.codes).all()


def test_merging_conserves_mass_and_valid_gaussians(tiny_checkpoint) -> None:
    baked = bake(load_checkpoint(tiny_checkpoint).model)
    rng = np.random.default_rng(0)
    seen = rng.uniform(0.5, 1.5, len(baked.points))
    seen[::7] = 0.0
    fewer = merge_gaussians(baked, 400, seen)
    assert len(fewer.points) == 400 and len(fewer.node_rows) == len(baked.codes)
    assert (fewer.all_codes[fewer.node_rows] == baked.codes).all()
    unseen_kept = np.isin(fewer.all_codes[:, 0], baked.all_codes[seen == 0, 0])
    assert set(np.flatnonzero(unseen_kept)) <= set(fewer.node_rows)  # only where a node needs one
    assert np.allclose(np.linalg.norm(fewer.normals, axis=1), 1)
    same = merge_gaussians(baked, len(baked.points), np.ones(len(baked.points)))
    assert np.abs(same.points - baked.points).max() < 1e-12
    assert (
        np.abs(same.factors @ same.factors.transpose(0, 2, 1) - baked.factors @ baked.factors.transpose(0, 2, 1)).max()
        < 1e-12
    )


def test_what_contributes_more_is_kept_all_over_the_body(tiny_checkpoint) -> None:
    baked = order_gaussians(bake(load_checkpoint(tiny_checkpoint).model))
    seen = np.random.default_rng(3).uniform(0.1, 1, len(baked.points))
    seen[np.isin(baked.rows, baked.rows[baked.node_rows], invert=True) & (baked.rows % 5 == 0)] = 0
    count = (len(seen) + len(baked.node_rows)) // 2
    left = np.isin(baked.rows, merge_gaussians(baked, count, seen).rows)
    own = left.copy()
    own[baked.node_rows] = False  # which stay for the networks' sake
    assert left.sum() == count and (seen[own] > 0).all()
    assert seen[own].mean() > 1.15 * seen[~left & (seen > 0)].mean()
    assert cKDTree(baked.points[left]).query(baked.points)[0].max() < 6 * np.median(
        cKDTree(baked.points).query(baked.points, 2)[0][:, 1]
    )


def test_sides_that_are_fitted_are_of_the_searchs_moments(bench) -> None:
    motion = random_motion(bench._full.skeleton, frames=30, seed=2)
    seen, fitted, held_out = views_around(motion, (32, 32), lambda time: bench._full.pose(motion, time))
    assert (len(seen), len(fitted), len(held_out)) == (COUNT, FIT_COUNT, COUNT)
    assert {view.time for view in fitted} == {view.time for view in seen}
    assert not {view.time for view in fitted} & {view.time for view in held_out}
    assert len({view.camera.position.tobytes() for view in fitted}) == FIT_COUNT


def test_merging_conserves_the_moments(tiny_checkpoint) -> None:
    """Σ mass, Σ mass·x and Σ mass·(Σ + x xᵀ) of all Gaussians are those of the fewer."""
    baked = bake(load_checkpoint(tiny_checkpoint).model)
    seen = np.random.default_rng(1).uniform(0.5, 1.5, len(baked.points))
    fewer = merge_gaussians(baked, 300, seen)
    owner = cKDTree(fewer.all_codes).query(baked.all_codes)[1]
    mass = np.bincount(owner, seen, len(fewer.points))

    def moments(b: BakedAvatar, mass: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        second = b.factors @ b.factors.transpose(0, 2, 1) + b.points[:, :, None] * b.points[:, None, :]
        return mass @ b.points, np.einsum("n,nij->ij", mass, second)

    for ours, theirs in zip(moments(fewer, mass), moments(baked, seen)):
        assert np.allclose(ours, theirs, rtol=1e-9)


def test_colours_are_fitted_to_the_images(bench) -> None:
    views = bench._posed(bench._full)
    truth = views[0][0].albedo.astype(np.float64)
    wanted = [rasterize(g.means, g.covariances, g.opacities, g.albedo, c, depth=False).image for g, c in views]
    fitted = fitted_albedo(np.full_like(truth, 0.5), views, wanted)

    def off(albedo: np.ndarray) -> float:
        rendered = (
            rasterize(g.means, g.covariances, g.opacities, np.float32(albedo), c, depth=False) for g, c in views
        )
        return float(np.mean([(d.image - w) ** 2 for d, w in zip(rendered, wanted)]))

    assert off(fitted) < 0.02 * off(np.full_like(truth, 0.5))


def test_every_rung_is_a_file(bench) -> None:
    deepest = Plan(**{name: len(rungs) for name, rungs in LADDERS.items()})
    what = bench.measure(bench.model(deepest.recipe(bench.config)), bench.search)
    assert 5 < what.psnr < 60
    assert len(given_up(bench, deepest)) == len(LADDERS) - 1  # no window where nothing is dynamic


def test_what_is_said_to_be_left_is_what_the_file_has(bench) -> None:
    plan = Plan(gaussians=len(LADDERS["gaussians"]))
    model = bench.model(plan.recipe(bench.config))
    opacities = next(output for output in model.graph.output if output.name == "opacities")
    left = opacities.type.tensor_type.shape.dim[0].dim_value
    assert plan.recipe(bench.config).gaussians == left
    assert given_up(bench, plan)[0].startswith(f"{left} of {bench.config.gaussians} Gaussians")


@pytest.mark.slow
def test_a_search_looks_at_the_captures_views(tiny_checkpoint, tmp_path, monkeypatch) -> None:
    capture = load_capture(ASSETS / "capture")
    seen, fitted, held_out = views_of(capture, 40)

    def of_split(split) -> set[tuple[float, bytes]]:
        cameras = capture.cameras
        return {(f.frame / capture.fps, cameras[f.camera].position.tobytes()) for f in capture.split(split)}

    for views, split, count in ((seen, "train", COUNT), (fitted, "train", FIT_COUNT), (held_out, "novel_pose", COUNT)):
        assert len(views) == min(count, len(capture.split(split))) and {
            (s.time, s.camera.position.tobytes()) for s in views
        } <= of_split(split)
        assert len({view.time for view in views}) >= COUNT / 2  # spread over the split
        assert {max(view.camera.width, view.camera.height) for view in views} == {40}
    train = tuple(capture.split("train"))
    seen, fitted, held_out = views_of(replace(capture, frames=train[:5]), 40)
    assert len(seen) == len(fitted) == 3 and len(held_out) == 2
    assert not {view.time for view in (*seen, *fitted)} & {view.time for view in held_out}
    with pytest.raises(InputError, match="training views of the capture: expected at least 2, got 1"):
        views_of(replace(capture, frames=train[:1]), 40)

    rows, asked = tmp_path / "bounds.json", []
    monkeypatch.setattr(bounded, "views_of", lambda *words: asked.append(words[2]) or views_of(*words))
    words = [str(_trained_with_hold_out(tiny_checkpoint, tmp_path)), "--max-mb", "100", "--size", "48"]
    words += ["--json", str(rows)]
    words += ["--capture", str(ASSETS / "capture"), "--out", str(tmp_path / "small.onnx")]
    assert main(words) == 0 and json.loads(rows.read_text())[0]["shots"] == "capture" and asked == [True]


def _trained_with_hold_out(checkpoint, folder):
    read = load_checkpoint(checkpoint)
    config = replace(read.config, hold_out=True)
    save_checkpoint(folder / "avatar.ckpt", read.model, read.probes, read.skeleton, config, read.info)
    return folder / "avatar.ckpt"


def test_a_search_leaves_out_what_the_training_held_out() -> None:
    capture = load_capture(ASSETS / "capture")
    held = capture.holding_out()
    seen, fitted, held_out = views_of(capture, 40, hold_out=True)

    def times(split) -> set[float]:
        return {frame.frame / capture.fps for frame in held.split(split)}

    assert {view.time for view in (*seen, *fitted)} <= times("train") - times("validation")
    assert held_out and {view.time for view in held_out} <= times("validation")


def test_a_single_pose_is_compared_from_each_camera_with_itself(tiny_checkpoint) -> None:
    still = random_motion(load_checkpoint(tiny_checkpoint).skeleton, frames=2, seed=5).at(0.0)
    light = Light(np.ones((32, 64, 3), np.float32))
    bench = Workbench(load_checkpoint(tiny_checkpoint), SearchScene(still, light, size=(48, 48), shade="table"), _clock)
    assert bench.measure(bench.model(Recipe()), bench.search).psnr > 100


def test_fewer_gaussians_stand_farther_apart(bench) -> None:
    for count, apart in ((None, 1.0), (200, 2.0)):
        metadata = read_metadata(OnnxFile(bench.model(Recipe(gaussians=count)).SerializeToString()))
        whole = float(bench._checkpoint.model.spacing)
        assert metadata.spacing_m == pytest.approx(apart * whole, rel=1e-6)
