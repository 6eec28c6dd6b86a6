"""Held-out scores: against independent metrics, on perfect and degraded renderings, and as JSON rows."""

from __future__ import annotations

import dataclasses
import json
import math
import shutil
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
from msgspec import structs

import rnd_trainer.commands.eval
import rnd_trainer.evaluation.evaluate
import rnd_trainer.evaluation.held_out
from rnd_runtime.capture.capture import Capture, load_capture
from rnd_runtime.core.files import sha256_of
from rnd_runtime.core.images import linear_to_srgb, srgb_to_linear
from rnd_runtime.shading.light import Light
from rnd_runtime.shading.shader import Shader
from rnd_trainer.commands.eval import EvalOptions, _is_of, evaluate_run
from rnd_trainer.config import ModelConfig
from rnd_trainer.evaluation.evaluate import Evaluator, albedo_scale, evaluate, flicker
from rnd_trainer.evaluation.evaluator import Rendered, render_runtime
from rnd_trainer.evaluation.held_out import playback, score, strip_names
from rnd_trainer.evaluation.scores import frame_scores, outline_length, silhouette, to_srgb8
from rnd_trainer.losses.metrics import psnr, ssim_map
from rnd_trainer.model.checkpoint import load_checkpoint
from rnd_trainer.model.model import AvatarModel
from rnd_trainer.model.template import sample_template
from rnd_trainer.training.data import pose_input
from rnd_trainer.training.saving import save_training
from rnd_trainer.training.training import Training
from support.tiny import ASSETS

OUTLINE = 0.02  # central differences of an edge one pixel wide: 1.4 % too long
CV2_SSIM = 2e-3  # OpenCV filters 8-bit levels at float32 and keeps the border; its window is the same


def _truth(capture):
    return capture.load_frame(capture.split("train")[0])


def _perfect(truth) -> Rendered:
    normal = truth.normal if truth.normal_gt is None else truth.normal_gt
    linear = torch.from_numpy(srgb_to_linear(truth.image_srgb)).float()
    mask = torch.from_numpy(truth.mask)
    return Rendered(linear, torch.from_numpy(normal) * mask[..., None], linear, mask)


def test_a_perfect_rendering_has_perfect_scores(tiny_capture) -> None:
    truth = _truth(tiny_capture)
    scores = frame_scores(_perfect(truth), truth)
    assert scores["psnr"] == scores["psnr_box"] == math.inf
    assert scores["psnr_n"] > 120  # normals are scaled to unit length once more
    assert scores["ssim"] == pytest.approx(1) and scores["ssim_n"] == pytest.approx(1)
    assert scores["normal_deg"] == pytest.approx(0, abs=0.1) and scores["outline_px"] == 0


def test_an_albedo_is_compared_after_its_scale(tiny_capture) -> None:
    truth = _truth(tiny_capture)
    perfect = dataclasses.replace(truth, albedo_srgb=truth.image_srgb)
    scale = torch.tensor([2.0, 1.5, 4.0])
    half = dataclasses.replace(_perfect(truth), albedo=_perfect(truth).image / scale)
    assert (
        frame_scores(half, perfect, scale=scale)["psnr_albedo"] > 60 > 20 > frame_scores(half, perfect)["psnr_albedo"]
    )


def test_box_scores_are_those_of_the_crop(tiny_capture) -> None:
    truth = _truth(tiny_capture)
    perfect = _perfect(truth)
    spoilt = dataclasses.replace(perfect, image=0.7 * perfect.image)
    scores = frame_scores(spoilt, truth)
    rows, columns = np.nonzero(truth.mask > 0)
    box = (slice(max(rows.min() - 8, 0), rows.max() + 9), slice(max(columns.min() - 8, 0), columns.max() + 9))
    target = torch.from_numpy(truth.image_srgb)
    assert scores["psnr_box"] == pytest.approx(psnr(to_srgb8(spoilt.image)[box], target[box]))
    assert scores["psnr_box"] < scores["psnr"] < 60


def test_outline_error_is_that_of_a_disc_too_wide(tiny_capture) -> None:
    row, column = torch.meshgrid(torch.arange(256.0), torch.arange(256.0), indexing="ij")
    distance = torch.hypot(row - 127.3, column - 127.9)

    def disc(radius: float) -> torch.Tensor:
        return (radius + 0.5 - distance).clamp(0, 1)  # a soft edge, one pixel wide

    assert outline_length(disc(100)) == pytest.approx(2 * math.pi * 100, rel=OUTLINE)
    truth = dataclasses.replace(
        _truth(tiny_capture),
        image_srgb=np.zeros((256, 256, 3), np.float32),
        mask=disc(100).numpy(),
        normal=None,
        normal_gt=None,
        albedo_srgb=None,
    )
    black = torch.zeros(256, 256, 3)
    for wider in (0.25, -0.25):
        scores = frame_scores(Rendered(black, black, black, disc(100 + wider)), truth)
        assert scores["outline_px"] == pytest.approx(0.25, rel=OUTLINE)
    everywhere = dataclasses.replace(truth, mask=np.ones((256, 256), np.float32))
    assert "outline_px" not in frame_scores(Rendered(black, black, black, disc(100)), everywhere)


@pytest.mark.parametrize(("wrong", "degrees"), [("hole", 0.0), ("beside", math.degrees(math.acos(1 / 3)))])
def test_normals_without_data_are_not_scored(tiny_capture, wrong, degrees) -> None:
    """Rendered normals do not count without true normals."""
    truth = _truth(tiny_capture)
    tilted = np.full_like(truth.image_srgb, [-(3**-0.5)] * 3)
    flipped = tilted * [1, 1, -1]
    normal, half = tilted.copy(), len(tilted) // 2
    normal[:half] = 0
    ours = tilted.copy()
    rows = slice(half) if wrong == "hole" else slice(half, None)
    ours[rows] = flipped[rows]
    rendered = dataclasses.replace(_perfect(truth), normals=torch.from_numpy(ours))
    scores = frame_scores(rendered, dataclasses.replace(truth, normal=normal, normal_gt=None))
    assert scores["normal_deg"] == pytest.approx(degrees, abs=0.1)
    assert (scores["psnr_n"] > 120) is (scores["ssim_n"] > 0.9999) is (wrong == "hole")


def test_psnr_and_ssim_are_opencvs(tiny_capture) -> None:
    first, second = (torch.from_numpy(tiny_capture.load_frame(f).image_srgb) for f in tiny_capture.split("train")[:2])
    a, b = (np.round(x.numpy() * 255).astype(np.uint8) for x in (first, second))
    expected = cv2.quality.QualityPSNR_compute(a, b)[0][:3]
    mean_square = np.mean(10 ** (-np.array(expected) / 10))
    assert psnr(first, second) == pytest.approx(-10 * math.log10(mean_square), abs=1e-3)
    _, similarity = cv2.quality.QualitySSIM_compute(a, b)
    ours = ssim_map(first, second).numpy()
    assert np.abs(ours - similarity[5:-5, 5:-5, :3]).mean() < CV2_SSIM


@pytest.mark.parametrize(("visibility", "shadows"), [("pose", True), ("paper", False), ("none", False)])
def test_a_model_trained_without_shadows_is_evaluated_without(tiny_capture, monkeypatch, visibility, shadows):
    body = tiny_capture.body
    config = ModelConfig(gaussians=800, nodes=200, width=32, attribute_width=32, visibility=visibility)
    model = AvatarModel(config, sample_template(body, 800, 200, seed=1))
    overhead = np.zeros((32, 64, 3), np.float32)
    overhead[1] = 1e3  # the head's shadow falls on the shoulders
    shader = Shader(Light(overhead), "table+sun")
    assert shader.directional

    def image() -> torch.Tensor:
        pose = pose_input(tiny_capture.motion, body.skeleton, 0.0, config)
        return render_runtime(model, pose, tiny_capture.cameras["front"], shader).image

    played = image()
    monkeypatch.setattr(
        "rnd_runtime.shading.shader.directional_visibility",
        lambda points, normals, ways, **_: np.ones((len(points), len(ways)), np.float32),
    )
    assert torch.equal(played, image()) is not shadows


def test_evaluation_culls_as_the_player(tiny_run, tiny_capture) -> None:
    checkpoint = load_checkpoint(tiny_run / "avatar.ckpt")
    frame = tiny_capture.split("train")[0]
    whole, all_of_it, *fewer = (
        Evaluator(checkpoint, tiny_capture, cull=cull).render(frame).image for cull in (None, -1.0, -0.5, 0.0, 1.0)
    )
    assert torch.equal(whole, all_of_it) and fewer[-1].abs().max() == 0
    backs, backs_and_sides, everything = (float(torch.mean((image - whole) ** 2)) for image in fewer)
    assert 0 < backs < backs_and_sides < 0.1 * everything


def test_a_sliver_at_the_edge_is_scored_and_an_empty_frame_is_left_out(tiny_run, tiny_capture, monkeypatch) -> None:
    evaluator, original = (
        Evaluator(load_checkpoint(tiny_run / "avatar.ckpt"), tiny_capture),
        type(tiny_capture).load_frame,
    )
    first = tiny_capture.split("novel_view")[0]

    def with_mask(columns: slice):
        def load(capture, frame):
            images = original(capture, frame)
            mask = np.zeros_like(images.mask)
            mask[:, columns] = 1
            return dataclasses.replace(images, mask=mask) if frame == first else images

        return load

    monkeypatch.setattr(type(tiny_capture), "load_frame", with_mask(slice(0, 2)))
    scores = evaluate(evaluator, "novel_view")
    assert scores.frames == len(tiny_capture.split("novel_view")) and "ssim_box" in scores.scores
    assert not np.isnan(list(scores.scores.values())).any()
    assert scores.scores["normal_deg"] > 0  # of the other frames: nothing of this one's is in the sliver
    monkeypatch.setattr(type(tiny_capture), "load_frame", with_mask(slice(0, 0)))
    assert evaluate(evaluator, "novel_view").frames == len(tiny_capture.split("novel_view")) - 1


def test_the_silhouette_is_a_band_on_either_side_of_the_edge() -> None:
    mask = torch.zeros(40, 40)
    mask[12:28, 12:28] = 1
    mask[12:28, 28] = 0.4  # less than half: still outside
    band = silhouette(mask)[..., 0]
    outside, inside = torch.zeros(40, 40), torch.zeros(40, 40)
    outside[8:32, 8:32] = 1  # four pixels on either side
    inside[16:24, 16:24] = 1
    assert torch.equal(band, (outside - inside) > 0)


def test_rows_name_all_scores_and_their_provenance(tiny_run, tiny_capture, tmp_path) -> None:
    rows = score(load_checkpoint(tiny_run / "avatar.ckpt"), tiny_capture, method="m", strips=tmp_path)
    assert [row["split"] for row in rows] == ["novel_view"]
    row = json.loads(json.dumps(rows[0]))
    wanted = {"psnr", "ssim", "psnr_n", "ssim_n", "normal_deg", "psnr_box", "method", "seed", "minutes"}
    assert wanted <= set(row) and row["frames"] == 2 and "lpips" not in row
    assert (tmp_path / "novel_view.png").exists() and len(list((tmp_path / "novel_view").glob("*.png"))) == 2


def test_a_training_that_held_frames_out_is_scored_on_those_alone(tiny_run, tiny_capture) -> None:
    everything = tiny_capture.split("train")
    held = tiny_capture.holding_out()
    learned, validation = held.split("train"), held.split("validation")
    assert len(validation) == max(1, round(len(everything) / 5)) and len(learned) + len(validation) == len(everything)
    assert not {f.image for f in learned} & {f.image for f in validation}
    checkpoint = load_checkpoint(tiny_run / "avatar.ckpt")
    config = dataclasses.replace(checkpoint.config, hold_out=True)
    views = Training(tiny_capture, config).views
    assert [view.frame.image for view in views] == [frame.image for frame in learned]
    rows = score(dataclasses.replace(checkpoint, config=config), tiny_capture, method="m")
    assert [(row["split"], row["frames"]) for row in rows] == [("validation", len(validation))]


def test_strips_have_unique_names_and_are_png() -> None:
    assert strip_names(["images/a.jpg", "images/b.png"]) == {"images/a.jpg": "a", "images/b.png": "b"}
    cameras = ["cam0/000001.jpg", "cam1/000001.jpg", "cam1/000002.jpg"]
    assert list(strip_names(cameras).values()) == ["cam0_000001", "cam1_000001", "000002"]


def test_a_refined_run_is_scored_in_its_own_poses(tiny_capture, tiny_config, tmp_path, monkeypatch) -> None:
    training = Training(tiny_capture, dataclasses.replace(tiny_config, refine_poses=True, steps=2))
    for _ in range(2):
        training.step()
    run = tmp_path / "run"
    save_training(training, run)
    scored: list[Capture] = []

    def score(checkpoint, capture, **_):
        scored.append(capture)
        return [{"split": "novel_view", "frames": 1}]

    monkeypatch.setattr(rnd_trainer.evaluation.held_out, "score", score)
    for place, motion in ((tiny_capture.folder, None), (tiny_capture.file, None), (tiny_capture.folder, "motion.npz")):
        evaluate_run(EvalOptions(run, place, motion=motion))
    refined = str((run / "refined_motion.npz").resolve())
    assert [str(capture.motion.source) for capture in scored] == [refined, refined, tiny_capture.motion.source]
    other = tmp_path / "other" / tiny_capture.folder.name  # another capture of the same name
    shutil.copytree(tiny_capture.folder, other)
    (other / "capture.json").write_bytes(tiny_capture.file.read_bytes() + b"\n")
    evaluate_run(EvalOptions(run, other))
    assert Path(str(scored[-1].motion.source)) == other / "motion.npz"
    (run / "refined_motion.npz").unlink()
    evaluate_run(EvalOptions(run, tiny_capture.folder))
    assert str(scored[-1].motion.source) == str(tiny_capture.motion.source)


def test_the_scores_are_those_of_the_rendered_frames(tiny_run, tiny_capture) -> None:
    evaluator = Evaluator(load_checkpoint(tiny_run / "avatar.ckpt"), tiny_capture)
    seen = []
    result = evaluate(evaluator, "novel_view", on_frame=lambda frame, rendered, target: seen.append((rendered, target)))
    expected = np.mean([psnr(to_srgb8(rendered.image), target) for rendered, target in seen])
    assert result.scores["psnr"] == pytest.approx(expected, rel=1e-6)


def _shown(values: list[float], mask: np.ndarray) -> SimpleNamespace:
    """An evaluator of grey images of these sRGB ``values`` by motion frame."""

    def render(frame: object, index: int) -> Rendered:
        grey = torch.full((*mask.shape, 3), float(srgb_to_linear(np.array(values[index]))))
        return Rendered(grey, grey, grey, torch.from_numpy(mask))

    capture = SimpleNamespace(split=lambda name: [SimpleNamespace(camera="0", frame=0)])
    return SimpleNamespace(capture=capture, motion=SimpleNamespace(frame_count=len(values)), render=render)


def test_flicker_is_half_the_second_difference() -> None:
    """Zero at constant speed, the full step for an alternating value."""
    mask = np.ones((4, 5), np.float32)
    assert flicker(_shown([k * 10 / 255 for k in range(8)], mask)) == pytest.approx(0, abs=1e-3)
    assert flicker(_shown([k % 2 * 10 / 255 for k in range(8)], mask)) == pytest.approx(10, abs=1e-3)


def test_the_training_light_is_the_learned_one_and_others_the_captures(tiny_run, tiny_capture, monkeypatch) -> None:
    frames = tuple(
        structs.replace(frame, light="noon" if frame.split == "train" else "dusk") for frame in tiny_capture.frames
    )
    capture = dataclasses.replace(tiny_capture, frames=frames)
    monkeypatch.setattr(Capture, "load_light", lambda self, name: f"the true {name}")
    monkeypatch.setattr(rnd_trainer.evaluation.evaluate, "Shader", lambda light, mode: light)
    checkpoint = load_checkpoint(tiny_run / "avatar.ckpt")
    checkpoint.info["lights"] = {"noon": None, "evening": None}  # the capture has no maps of them
    checkpoint.probes = {"noon": checkpoint.probe, "evening": 2 * checkpoint.probe}
    evaluator = Evaluator(checkpoint, capture)
    assert evaluator._shader("dusk") == "the true dusk"
    for name, factor in (("noon", 1), (None, 1), ("evening", 2)):
        assert np.array_equal(evaluator._shader(name).radiance, Light(factor * checkpoint.probe.numpy()).radiance)


def test_the_training_light_is_identified_by_its_map(tiny_capture, tiny_config, tmp_path) -> None:
    """Also in a renamed or edited capture; another map of the same name is another light."""
    shutil.copytree(ASSETS / "capture", tmp_path / "me/capture")
    mine = load_capture(tmp_path / "me/capture")
    training = Training(mine, dataclasses.replace(tiny_config, image_scale=0.1))
    save_training(training, tmp_path)
    name = mine.split("train")[0].light
    checkpoint = load_checkpoint(tmp_path / "avatar.ckpt")
    assert checkpoint.learned_under(mine) == {name}
    shutil.copytree(tmp_path / "me/capture", tmp_path / "renamed")
    assert checkpoint.learned_under(load_capture(tmp_path / "renamed")) == {name}
    lights = mine.lights | {name: structs.replace(mine.lights[name], yaw=1.0)}
    assert checkpoint.learned_under(dataclasses.replace(mine, lights=lights)) == set()
    assert checkpoint.learned_under(dataclasses.replace(mine, lights={})) == set()


def test_the_albedos_scale_is_fitted_to_training_frames() -> None:
    """By least squares, without held-out lights."""
    rng = np.random.default_rng(0)
    ours, factor = rng.uniform(0.1, 0.3, (6, 7, 3)).astype(np.float32), np.array([1.5, 2.0, 0.5])
    splits = {"train": 1.0, "relight": 3.0}
    whole = np.ones((6, 7), np.float32)
    capture = SimpleNamespace(
        split=lambda name: [SimpleNamespace(albedo="a.png", split=name)],
        load_frame=lambda frame: SimpleNamespace(
            albedo_srgb=linear_to_srgb(splits[frame.split] * factor * ours), mask=whole
        ),
    )
    albedo = torch.from_numpy(ours)
    rendered = Rendered(albedo, albedo, albedo, torch.from_numpy(whole))
    scale = albedo_scale(SimpleNamespace(capture=capture, render=lambda frame: rendered))
    np.testing.assert_allclose(scale.numpy(), factor, rtol=1e-4)


def test_frames_a_second_are_those_of_the_median_frame(tiny_run, tiny_capture, tmp_path, monkeypatch) -> None:
    seconds, now = iter([0.5] * 5 + [0.01] * 30 + [0.001] * 5), [0.0]

    class Renderer:
        def __init__(self, *_: object, **__: object) -> None:
            pass

        def render(self, *_: object) -> None:
            now[0] += next(seconds)

        def close(self) -> None:
            pass

    monkeypatch.setattr(rnd_trainer.evaluation.held_out, "FrameRenderer", Renderer)
    monkeypatch.setattr(rnd_trainer.evaluation.held_out.Avatar, "load", lambda path: None)
    monkeypatch.setattr(rnd_trainer.evaluation.held_out, "time", SimpleNamespace(perf_counter=lambda: now[0]))
    (tmp_path / "avatar.onnx").write_bytes(bytes(3_000_000))
    evaluator = Evaluator(load_checkpoint(tiny_run / "avatar.ckpt"), tiny_capture)
    assert playback(tmp_path / "avatar.onnx", evaluator) == {"file_mb": 3.0, "fps": pytest.approx(100)}


def test_an_exported_avatar_of_another_checkpoint_is_skipped_with_a_warning(
    tiny_checkpoint, tiny_avatar, tmp_path, capsys
) -> None:
    checkpoint, exported = tmp_path / "avatar.ckpt", tmp_path / "avatar.onnx"
    checkpoint.write_bytes(tiny_checkpoint.read_bytes())
    assert not _is_of(exported, sha256_of(checkpoint))
    exported.write_bytes(tiny_avatar.read_bytes())
    assert _is_of(exported, sha256_of(checkpoint)) and not capsys.readouterr().err
    checkpoint.write_bytes(tiny_checkpoint.read_bytes() + b"later")
    assert not _is_of(exported, sha256_of(checkpoint))
    said = capsys.readouterr().err
    assert f"{exported}: of another checkpoint" in said and said.count("\n") == 1
    exported.write_bytes(b"cut")
    assert not _is_of(exported, sha256_of(checkpoint))  # the figures of the checkpoint are there all the same
    assert f"{exported}: not a readable ONNX model" in capsys.readouterr().err


def test_an_exported_avatar_adds_its_size_and_speed(tiny_checkpoint, tiny_avatar, tiny_capture) -> None:
    rows = score(load_checkpoint(tiny_checkpoint), tiny_capture, method="m", avatar=tiny_avatar)
    assert rows[0]["file_mb"] == tiny_avatar.stat().st_size / 1e6
    assert rows[0]["fps"] > 0
