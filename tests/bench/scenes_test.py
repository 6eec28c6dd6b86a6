"""Rows of ``rnd-bench scenes``: levels are coarser, differ little, and a crowd is drawn."""

import json

import numpy as np

from rnd_bench.cli import main
from rnd_bench.speed import scenes
from rnd_bench.speed.roofline import network_flops
from rnd_runtime.avatar.avatar import Avatar
from rnd_runtime.posing.levels import CULLED_LEVELS, MIN_GAUSSIANS
from support.paths import ASSETS


def test_rows_of_levels_and_crowds(tmp_path, monkeypatch):
    monkeypatch.setattr(scenes, "HEIGHTS", (192, 16))
    monkeypatch.setattr(scenes, "CROWDS", {1: None, 3: 40.0})
    monkeypatch.setattr(scenes, "VIEWS", scenes.VIEWS[:1])
    monkeypatch.setattr(scenes, "SIZE", (160, 90))
    words = ["--avatar", ASSETS / "avatar.onnx", "--motion", ASSETS / "walk.npz", "--hdr", ASSETS / "sky.exr"]
    assert main(["scenes", *map(str, words), "--json", str(tmp_path / "rows.json"), "--repeats", "2"]) == 0
    rows = json.loads((tmp_path / "rows.json").read_text())
    counts = [row["gaussians"] for row in rows["switches"]]
    assert (
        counts == sorted(counts, reverse=True)
        and counts[len(CULLED_LEVELS) - 1] == 12000 > counts[len(CULLED_LEVELS)]
        and counts[-1] <= MIN_GAUSSIANS
    )
    large, small = rows["heights"]
    assert large["gaussians"] == 12000 and 0 < large["rms_to_whole"] < 2  # fewer nodes, and nothing of the far side
    assert small["gaussians"] < 4000 and 0 < small["rms_to_whole"] < 4
    one, three = rows["crowds"]
    assert (
        three["gaussians"] / 3 < one["gaussians"] < 12000
        and three["people"] == 3
        and three["ms_median"] > 0
        and three["cpu_ms_median"] > 0
    )
    assert {"encoders", "posing", "shading", "raster"} <= set(three["stages"])
    bounds = {row["stage"]: row for row in rows["roofline"] if row["people"] == 3}
    assert {"encoders", "posing", "shading", "projection", "sort", "raster"} == set(bounds)
    assert all(0 < row["ms_least"] < row["ms"] for row in bounds.values())


def test_the_networks_operations_are_those_of_their_nodes():
    avatar = Avatar.load(ASSETS / "avatar.onnx")
    whole, quarter = (network_flops(each) for each in (avatar, avatar.level(1)))
    last_layers = 2 * avatar.nodes * 64 * (24 + 6 + 16)
    assert whole > last_layers and 0.25 < quarter / whole < 0.4  # attention between joints does not shrink


def test_a_camera_shows_a_person_of_so_many_pixels():
    camera = scenes.camera_of(64, 0.3)
    ends = np.array([[0, 0.025, 0, 1], [0, 0.025 + scenes.HEIGHT, 0, 1]]) @ camera.world_to_camera.T
    rows = ends[:, 1] / ends[:, 2] * camera.K[1, 1] + camera.K[1, 2]
    np.testing.assert_allclose(rows[0] - rows[1], 64, rtol=0.02)
    assert rows.min() > 0 and rows.max() < camera.height
