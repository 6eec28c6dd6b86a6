"""One point of the chart: its process, its reference, its errors, and the files that it stores."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from rnd_bench.scenes.avatars import seeded_checkpoint
from rnd_bench.scenes.scenes import HARDEST, INSIDE, SQUAT, SUN, USUAL, BenchScene, bench_camera, bench_scene
from rnd_bench.speed import frame as frames
from rnd_bench.speed.frame import COMPARED, STEP_S, STEP_YAW, Measured, Point
from rnd_bench.speed.point import Inputs, Setting, measured
from rnd_bench.speed.reference import MAX_DB, Reference, errors, reference
from rnd_export.export import export
from rnd_export.reduce.variant import Variant
from rnd_runtime.avatar.avatar import Avatar
from rnd_runtime.capture.body import Body
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.rotations import matrix_to_axis_angle
from rnd_runtime.motion.motion import load_motion
from rnd_runtime.playback.frame import FrameRenderer
from rnd_runtime.shading.files.load import load_light
from rnd_trainer.model.checkpoint import load_checkpoint
from support.tiny import ASSETS

pytestmark = pytest.mark.slow
WALK, SKY = ASSETS / "walk.npz", ASSETS / "sky.exr"
LAST_BITS = 1e-5
"""of radiance in float32: a kernel that a process compiled itself and the same out of numba's cache differ by an ulp"""
BRUTE_DB = 65.0  # the fastest exact path against the reference: float32 against float64, numba against numpy
SUNS_DB = 50.0  # tables, and suns by their middle and spread; 56.4 measured


def _played(avatar_file, shade) -> Measured:
    """The compared frames as a player renders them, 64 pixels wide."""
    avatar = Avatar.load(avatar_file)
    motion = load_motion(WALK, avatar.skeleton)
    renderer = FrameRenderer(avatar, load_light(SKY), bench_camera(64), shade=shade)
    radiance = []
    for number in COMPARED:
        renderer.turn(STEP_YAW * number)
        radiance.append(renderer.render(motion, STEP_S * number).radiance)
    means = np.array([avatar.pose(motion, STEP_S * number).means for number in COMPARED])
    return Measured({}, np.array(radiance), means)


def test_the_reference_is_what_the_slowest_mode_approaches(tiny_avatar, tmp_path) -> None:
    scene = BenchScene(WALK, SKY, USUAL)
    truth = reference(tiny_avatar, scene, 64, tmp_path)
    decibels = {}
    for mode in ("brute", "ao"):
        found = errors(_played(tiny_avatar, mode), truth)
        decibels[mode] = found["psnr_db"]
        assert found["position_mm"] < 0.01
    assert decibels["brute"] > BRUTE_DB and decibels["ao"] < decibels["brute"] - 20
    stored = reference(tiny_avatar, scene, 64, tmp_path)  # the second time from the folder
    assert (stored.radiance == truth.radiance).all() and truth.radiance.max() > 0.01
    played = _played(tiny_avatar, "table+sun")
    with_suns = errors(played, reference(tiny_avatar, scene, 64, tmp_path, with_suns=True))["psnr_db"]
    assert with_suns > SUNS_DB and errors(played, truth)["psnr_db"] < with_suns - 10


def test_errors_are_those_of_the_definition() -> None:
    grey = np.full((2, 4, 4, 3), 0.5)
    truth = Reference(grey, np.zeros((2, 5, 3)))
    assert errors(Measured({}, grey, truth.means), truth)["psnr_db"] == MAX_DB
    other = grey.copy()
    other[1] = 1.0  # in sRGB 0.7354 and 1: a difference of 0.2646
    means = np.zeros((2, 5, 3))
    means[1, 2, 0] = 0.003
    found = errors(Measured({}, other, means), truth)
    assert found["psnr_db_worst"] == pytest.approx(-20 * np.log10(1 - 0.7353569), abs=1e-3)
    assert found["psnr_db"] == pytest.approx(found["psnr_db_worst"] + 10 * np.log10(2), abs=1e-6)
    assert found["position_mm"] == pytest.approx(3.0) and found["worst_frame"] == COMPARED[1]
    assert errors(Measured({}, grey, np.zeros((2, 4, 3))), truth)["position_mm"] is None


def test_a_point_is_measured_in_a_process_of_its_own(tiny_avatar, monkeypatch) -> None:
    point = Point(str(tiny_avatar), str(WALK), str(SKY), size=48, shade="table", threads=1, frames=6)
    found = frames.measure(point)
    row = found.row
    assert 0 < row["ms_min"] <= row["ms_median"] <= row["ms_p95"] and row["frames"] == 6
    assert {"encoders", "shading", "raster"} <= set(row["stages"])
    assert 50 < row["peak_mb"] < 2000 and row["file_mb"] == tiny_avatar.stat().st_size / 1e6
    assert found.radiance.shape == (len(COMPARED), 48, 48, 3) and found.radiance.max() > 0
    with pytest.raises(InputError, match="optix, table"):
        frames.measure(dataclasses.replace(point, raster="optix", frames=1))
    monkeypatch.setattr(frames, "DEADLINE_S", 0.05)
    with pytest.raises(InputError, match=r"cpu, table: expected an answer within 0\.05 s, got none"):
        frames.measure(point)


@pytest.mark.parametrize("raster", ["gl-egl", "gl-osmesa"])
def test_a_point_in_gl_has_the_cpus_frames(tiny_avatar, raster) -> None:
    cpu, gl = (
        frames.measure(Point(str(tiny_avatar), str(WALK), str(SKY), 48, "table+sun", kind, 1, 2))
        for kind in ("cpu", raster)
    )
    assert {"encoders", "shading", "raster", "read-back"} <= set(gl.row["stages"])
    assert errors(gl, Reference(cpu.radiance, cpu.means))["psnr_db"] > 50


def test_a_point_may_leave_the_back_out(tiny_avatar) -> None:
    """A cosine as high as this one leaves front out too."""
    point = Point(str(tiny_avatar), str(WALK), str(SKY), 48, "table", threads=1, frames=1)
    full, culled = (frames.measure(dataclasses.replace(point, cull=cull)).radiance for cull in (None, 0.5))
    avatar = Avatar.load(tiny_avatar, threads=1)
    renderer = FrameRenderer(avatar, load_light(SKY), bench_camera(48), shade="table", cull=0.5)
    renderer.turn(STEP_YAW * COMPARED[0])
    ours = renderer.render(load_motion(WALK, avatar.skeleton), STEP_S * COMPARED[0]).radiance
    assert np.abs(culled[0] - ours).max() < LAST_BITS and np.abs(culled - full).max() > 0.01


def test_the_hardest_scenes_match_their_names(tiny_avatar, tmp_path) -> None:
    scenes = {name: bench_scene(name, ASSETS / "body.npz", WALK, SKY, tmp_path, "key") for name in (USUAL, *HARDEST)}
    assert scenes[USUAL] == BenchScene(WALK, SKY, USUAL) and scenes[INSIDE] == BenchScene(WALK, SKY, INSIDE)
    assert load_light(scenes[SUN].hdr).radiance.max() > 0.5e6 and scenes[SUN].motion == WALK
    avatar = Avatar.load(tiny_avatar)
    walking, squatting = (load_motion(scenes[name].motion, avatar.skeleton) for name in (USUAL, SQUAT))
    angles = matrix_to_axis_angle(squatting.rotations[:, squatting.joint_names.index("left_knee")])
    assert np.allclose(angles, [2.2, 0, 0], atol=1e-6) and squatting.frame_count == walking.frame_count
    means = avatar.pose(walking, 0.0).means
    low, high = means.min(0), means.max(0)
    inside, outside = (bench_camera(64, view).position for view in (INSIDE, USUAL))
    assert (low < inside).all() and (inside < high).all() and outside[2] > high[2] + 1
    for hard in scenes.values():
        truth = reference(tiny_avatar, hard, 32, tmp_path)
        assert np.isfinite(truth.radiance).all() and (truth.radiance > 0.01).mean() > 0.05


def test_a_file_is_measured_beside_its_own_checkpoints_avatar(tiny_checkpoint, tiny_avatar, tmp_path) -> None:
    merged = tmp_path / "merged.onnx"
    checkpoint = load_checkpoint(tiny_checkpoint)
    export(checkpoint, merged, variant=Variant(encoder="coarse", nodes=40, window_poses=3), cull=-0.6)
    inputs = Inputs(ASSETS / "body.npz", WALK, SKY, tmp_path / "work", (tiny_checkpoint,)).checked()
    usual = Setting(size=32, shade="table", threads=1)
    rows = [measured(usual, inputs, seconds=0.1, file=file) for file in (tiny_avatar, merged)]
    for row, encoder, window in zip(rows, ("full", "coarse"), (None, 3)):
        assert (row["encoder"], row["window"], row["avatar"]) == (encoder, window, "exported")
        assert row["n"] == checkpoint.config.model.gaussians
    assert rows[0]["psnr_db"] > rows[1]["psnr_db"] + 1
    assert rows[1]["cull"] == -0.6  # as its file advises
    with pytest.raises(InputError, match="--checkpoint: expected the one that"):
        measured(usual, dataclasses.replace(inputs, checkpoints=()), file=merged)


def test_a_seeded_avatar_stands_on_the_body_that_was_given(tmp_path) -> None:
    body = Body.load(ASSETS / "body.npz")
    body.save(tmp_path / "body.npz")
    before = seeded_checkpoint(60, tmp_path / "body.npz", tmp_path)
    assert seeded_checkpoint(60, tmp_path / "body.npz", tmp_path) == before
    dataclasses.replace(body, vertices=1.5 * body.vertices).save(tmp_path / "body.npz")
    after = seeded_checkpoint(60, tmp_path / "body.npz", tmp_path)
    heights = [np.ptp(load_checkpoint(file).model.points.numpy()[:, 1]) for file in (before, after)]
    assert heights[1] > 1.2 * heights[0]
