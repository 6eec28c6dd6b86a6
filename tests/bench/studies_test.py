"""rnd-bench study: every variant trains, runs are done once, those of another study are refused, gains are means."""

from __future__ import annotations

import dataclasses
import json
import shutil

import numpy as np
import pytest
import torch
from msgspec import structs

from rnd_bench.cli import main
from rnd_bench.studies import people, trainings
from rnd_bench.studies.people_sheet import WORDS
from rnd_bench.studies.summary import summarise
from rnd_bench.studies.trainings import ablate, check_needs, encoder_cost, time_encoders
from rnd_bench.studies.variants import CAUSES, VARIANTS, StudyRow, chosen
from rnd_runtime.capture.capture import load_capture, save_capture
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import sha256_of, write_json
from rnd_runtime.core.images import read_image
from rnd_trainer.config import to_dict
from rnd_trainer.evaluation.preview import CAPTION
from rnd_trainer.model.checkpoint import write_tensors
from rnd_trainer.training.state import STATE_FILE, STATE_SCHEMA
from rnd_trainer.training.training import Training
from support.dask_jobs import two_workers


@pytest.mark.parametrize(
    ("differences", "shows"), [((2.0, 2.2), True), ((-2.0, -2.2), True), ((-0.1, 0.3), False), ((2.0,), None)]
)
def test_losses_and_gains_are_significant_alike(differences, shows) -> None:
    variants = (StudyRow("ours", "", None), StudyRow("less", "", "ours"))
    common = {"split": "novel_view", "encoder_gflop": 1.0, "encoder_ms": 1.0}
    rows = [
        common | {"method": name, "seed": seed, "psnr": 30 + (difference if name == "less" else 0)}
        for seed, difference in enumerate(differences)
        for name in ("ours", "less")
    ]
    assert summarise(rows, variants)[1]["novel_view"]["shows"] is shows


@pytest.mark.slow
def test_ablations_are_trained_once_and_compared_seed_by_seed(tiny_capture, tiny_config, tmp_path) -> None:
    calls: list[tuple[str, int, float, int]] = []
    config = dataclasses.replace(tiny_config, steps=4)
    variants = [VARIANTS[0], VARIANTS[2]]  # ours, static skinning

    def go(capture=tiny_capture, config=config):
        return ablate(
            capture, config, tmp_path, variants, seeds=(0, 1), perceptual=None, on_run=lambda *call: calls.append(call)
        )

    rows = go()
    shares = [done for _, _, done, _ in calls]
    assert len({call[:2] for call in calls}) == 4 and {row["seed"] for row in rows} == {0, 1}
    assert shares == sorted(shares) and {0, 0.25, 0.5, 0.75, 1, 3.5, 4} <= set(shares)  # four steps each
    written = (tmp_path / "ours-0" / "avatar.ckpt").stat().st_mtime_ns
    assert go() == rows and (tmp_path / "ours-0" / "avatar.ckpt").stat().st_mtime_ns == written
    with pytest.raises(InputError, match="steps of a run done before: expected 5, got 4"):
        go(config=dataclasses.replace(config, steps=5))
    with pytest.raises(InputError, match="hold_out of a run done before: expected True, got False"):
        go(config=dataclasses.replace(config, hold_out=True))
    poses = dataclasses.replace(tiny_capture.motion, source="other.npz")
    with pytest.raises(InputError, match=r"motion of a run done before: expected other\.npz, got motion\.npz"):
        go(capture=dataclasses.replace(tiny_capture, motion=poses))
    timed = time_encoders(rows, tmp_path, variants, 0)
    assert [row["encoder_gflop"] for row in timed] == [row["encoder_gflop"] for row in rows]
    ours, static = summarise(timed, variants)
    both = [
        next(r["psnr"] for r in rows if r["method"] == name and r["seed"] == seed and r["split"] == "novel_view")
        for seed in (0, 1)
        for name in ("static skinning", "ours")
    ]
    assert static["novel_view"]["gain"] == pytest.approx((both[0] - both[1] + both[2] - both[3]) / 2)
    assert static["encoder_gflop"] == 0 < ours["encoder_gflop"] and static["minutes"] > 0


@pytest.mark.slow
def test_workers_train_each_variant_once(tiny_capture, tmp_path) -> None:
    sizes = ["--variants", "ours", "static skinning", "--seeds", "1", "--steps", "4", "--gaussians", "300"]
    words = ["study", "ablations", str(tmp_path / "run"), str(tiny_capture.folder), *sizes]
    with two_workers() as (_, where):
        assert main([*words, "--json", str(tmp_path / "spread.json"), "--on", where]) == 0
    trained = {file.parent.name: file.stat().st_mtime_ns for file in (tmp_path / "run").glob("*/avatar.ckpt")}
    assert trained.keys() == {"ours-0", "static_skinning-0"}
    assert main([*words, "--json", str(tmp_path / "again.json")]) == 0
    spread, again = (json.loads((tmp_path / name).read_text())["rows"] for name in ("spread.json", "again.json"))
    assert [row["psnr"] for row in spread] == [row["psnr"] for row in again] and len(spread) == 2
    assert trained == {name: (tmp_path / "run" / name / "avatar.ckpt").stat().st_mtime_ns for name in trained}


@pytest.fixture
def study(tiny_capture, tiny_config, tmp_path, monkeypatch):
    """``ablate`` that fails where it would train, the folder of its second variant's run, and a row of that."""

    def train(*_: object) -> None:
        raise AssertionError("trained")

    monkeypatch.setattr(trainings, "train", train)

    def go() -> object:
        return ablate(
            tiny_capture, tiny_config, tmp_path, VARIANTS[:2], seeds=(0,), perceptual=None, on_run=lambda *call: None
        )

    row = {
        **{"method": "LBS, plain colour", "split": "novel_view", "seed": 0, "psnr": 20.0, "steps": tiny_config.steps},
        **{
            "capture": tiny_capture.folder.name,
            "gaussians": 600,
            "image_scale": 1.0,
            "hold_out": False,
            "shade": "table+sun",
        },
        **{"motion": "motion.npz", "capture_sha256": sha256_of(tiny_capture.file)},
    }
    folder = tmp_path / "lbs__plain_colour-0"
    folder.mkdir()
    return go, folder, row


def test_runs_done_before_are_checked_before_any_is_trained(study) -> None:
    go, folder, row = study
    file = folder / "rows.json"
    for usable in ([row], []):
        write_json(file, usable)
        with pytest.raises(AssertionError, match="trained"):
            go()
    for changed in ({"steps": 4}, {"capture_sha256": "of another capture.json"}):
        write_json(file, [row | changed])
        with pytest.raises(InputError, match=rf"rows\.json: {next(iter(changed))} of a run done before"):
            go()
    for broken in ('[{"method": "LBS', "{}", '[{"psnr": 20}]'):
        file.write_text(broken)
        with pytest.raises(InputError, match=r"rows\.json: a run done before: expected rows of a study, got an"):
            go()


def test_runs_begun_before_are_checked_before_any_is_trained(study, tiny_config) -> None:
    go, folder, row = study

    def begin(**changed: object) -> None:
        """A state of the second variant, LBS with plain colours."""
        model = dataclasses.replace(tiny_config.model, dynamic_skinning=False)
        others = {"light": "none", "weight_consistency": 0.0, "unseen_fraction": 0.0}
        config = to_dict(dataclasses.replace(tiny_config, model=model, **others | changed))
        header = {"schema": STATE_SCHEMA, "config": config, "networks": {}}
        header |= {name: row[name] for name in ("motion", "capture_sha256")}
        write_tensors(folder / STATE_FILE, {"generator": torch.zeros(1)}, header)

    begin()
    with pytest.raises(AssertionError, match="trained"):
        go()
    begin(steps=tiny_config.steps + 1)
    with pytest.raises(InputError, match=r"training\.state: a run begun before: expected .* other \['steps'\]"):
        go()
    write_json(folder / "rows.json", [row])
    begin(rate_residuals=tiny_config.rate_residuals / 2)  # done, but at another rate
    with pytest.raises(InputError, match=r"a run begun before: expected .* other \['rate_residuals'\]"):
        go()


def test_what_a_study_needs_is_checked_before_it_begins(tiny_capture) -> None:
    noisy, true_light = (next(v for v in CAUSES if v.name == name) for name in ("noisy poses", "true light"))
    with pytest.raises(InputError, match="motion_noisy"):
        check_needs([noisy], tiny_capture)
    with pytest.raises(InputError, match="expected a light map"):
        check_needs([true_light], dataclasses.replace(tiny_capture, lights={}))


def test_variants_are_chosen_by_name() -> None:
    assert chosen(VARIANTS, ()) == VARIANTS
    assert [one.name for one in chosen(VARIANTS, ("static skinning", "ours"))] == ["ours", "static skinning"]
    with pytest.raises(InputError, match="--variants"):
        chosen(VARIANTS, ("ours", "theirs"))


@pytest.mark.slow
def test_every_variant_builds_and_the_encoders_cost_grows_with_its_window(tiny_capture, tiny_config) -> None:
    costs = {}
    exact = tuple(structs.replace(frame, normal_gt=frame.normal) for frame in tiny_capture.frames)
    tiny_capture = dataclasses.replace(tiny_capture, frames=exact)
    for variant in (*VARIANTS, *CAUSES[:5]):
        model = dataclasses.replace(tiny_config.model, **variant.model)
        training = Training(tiny_capture, dataclasses.replace(tiny_config, model=model, steps=2, **variant.train))
        assert not any(training.step().skipped for _ in range(2)), variant.name
        costs[variant.name] = encoder_cost(training.model)["encoder_gflop"]
    assert costs["d = 2"] < costs["d = 5"] < costs["d = 20"] < costs["d = 30"]
    assert costs["spatial only"] < costs["ours"]


def _person_row(method: str, subject: int, seed: int, psnr: float, **more: float) -> dict[str, object]:
    return {"method": method, "split": "novel_view", "subject": subject, "seed": seed, "psnr": psnr, **more}


def test_every_person_counts_once() -> None:
    rows = [
        _person_row("ours", 0, 0, 30.0, ssim=0.9),
        _person_row("ours", 0, 1, 32.0, ssim=0.94),
        _person_row("ours", 1, 0, 20.0, ssim=0.8),
        _person_row("ours", 1, 1, 22.0),
        _person_row("plain", 0, 0, 20.0),
        _person_row("plain", 1, 0, 22.0),
    ]
    ours, plain = people.means(rows)
    assert (ours["method"], ours["split"], ours["subjects"]) == ("ours", "novel_view", 2)
    assert ours["psnr"] == pytest.approx((31 + 21) / 2) and ours["ssim"] == pytest.approx((0.92 + 0.8) / 2)
    assert ours["psnr_spread"] == pytest.approx(2**0.5) and plain["psnr_spread"] is None
    assert ours["psnr_subjects"] == pytest.approx(50**0.5)
    assert plain["psnr"] == pytest.approx(21) and plain["ssim"] is None


def test_the_type_of_skin_is_the_persons() -> None:
    pytest.importorskip("mitsuba")
    assert [people._told(people.SKIN_KNOWN, number).train for number in (1, 2)] == [{"skin": 1}, {"skin": 5}]
    assert people._told(VARIANTS[0], 1) is VARIANTS[0]


def _as_on_the_stage(capture, folder):
    """``capture`` with true albedo, and with its novel views once more as under another light."""
    shutil.copytree(capture.folder, folder)
    frames = [structs.replace(frame, albedo=frame.image) for frame in capture.frames]
    frames += [structs.replace(f, split="relight", light="other") for f in frames if f.split == "novel_view"]
    lights = capture.lights | {"other": capture.lights["white"]}
    save_capture(dataclasses.replace(capture, folder=folder, frames=tuple(frames), lights=lights))
    return load_capture(folder)


@pytest.mark.slow
def test_people_are_trained_scored_and_nothing_is_done_twice(tiny_capture, tmp_path, monkeypatch) -> None:
    """By the command, of a subject that is filmed already."""
    pytest.importorskip("mitsuba")
    monkeypatch.setattr(people, "film_subjects", lambda *words: None)
    capture = _as_on_the_stage(tiny_capture, tmp_path / "subject0")
    sizes = ["--subjects", "1", "--seeds", "1", "--steps", "4", "--gaussians", "400", "--variant", "scalar_rgb"]
    files = ["--json", str(tmp_path / "people.json"), "--sheet", str(tmp_path / "people.png")]
    words = ["study", "people", str(tmp_path), *files, "--methods", "ours", *sizes]
    results = []
    for _ in range(2):
        assert main(words) == 0
        results.append(json.loads((tmp_path / "people.json").read_text()))
    first, again = results
    assert first["rows"] and all(row["subject"] == 0 and row["method"] == "ours" for row in first["rows"])
    assert all("light_hue_de" in row for row in first["rows"])
    relit, side = capture.split("relight"), 64
    sheet = read_image(tmp_path / "people.png")
    assert sheet.shape == (CAPTION + side, len(WORDS) * side, 3)
    truth = capture.load_frame(relit[len(relit) // 2]).image_srgb
    np.testing.assert_allclose(sheet[CAPTION:, 6 * side : 7 * side] / 255, truth, atol=1 / 254)
    assert again["rows"] == first["rows"] and (first["looks"], again["looks"]) == (1, 2)
