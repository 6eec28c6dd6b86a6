"""rnd-play --on: the bytes of one process, also where a worker is killed half-way."""

from __future__ import annotations

import json

import pytest

from rnd_viewer.play.cli import main
from support.dask_jobs import in_a_process, two_workers, worker_killed_when
from support.paths import ASSETS

FRAMES = 48
WORDS = [str(ASSETS / "avatar.onnx"), "--motion", str(ASSETS / "walk.npz"), "--size", "96", "--frames", f"0:{FRAMES}"]


def _files(folder):
    files = (file for file in folder.rglob("*") if file.is_file() and file.suffix != ".json")
    return {str(file.relative_to(folder)): file.read_bytes() for file in files}


@pytest.mark.slow
def test_a_killed_worker_changes_no_byte(tmp_path):
    alone, parted = tmp_path / "alone", tmp_path / "parted"
    words = [*WORDS, "--format", "png,exr,mp4,webp", "--aov", "normal"]
    for folder in (tmp_path / "first", alone):
        in_a_process("rnd_viewer.play.cli", *words, "--out", folder)
    with two_workers() as (cluster, where):
        made = []

        def begun() -> bool:
            made[:] = (parted / "frames").glob("[!.]*.png")
            return len(made) > 2

        with worker_killed_when(cluster, begun) as killed:
            assert main([*words, "--out", str(parted), "--on", where]) == 0
        assert killed and 2 < len(made) < FRAMES
        left = [name for name in _files(parted) if name.split("/")[-1].startswith(".0")]  # of the killed process
        assert len(left) <= 1
        assert {name: content for name, content in _files(parted).items() if name not in left} == _files(alone)
        reports = [json.loads((folder / f"play_000000-{FRAMES:06d}.json").read_text()) for folder in (alone, parted)]
        assert reports[1]["times"].pop("raster")["runs"] == reports[0]["times"].pop("raster")["runs"] == FRAMES
        assert all(report.pop("times") for report in reports) and reports[0] == reports[1]

        (parted / "frames/000007.png").unlink()
        before = (parted / "frames/000008.png").stat().st_mtime_ns
        png = [*WORDS, "--format", "png", "--aov", "normal", "--out", str(parted), "--skip-existing"]
        assert main([*png, "--on", where]) == 0
        assert _files(parted)["frames/000007.png"] == _files(alone)["frames/000007.png"]
        assert (parted / "frames/000008.png").stat().st_mtime_ns == before
        (parted / "frames/000009.png").unlink()
        assert main(png) == 0
        assert _files(parted)["frames/000009.png"] == _files(alone)["frames/000009.png"]
        assert (parted / "frames/000008.png").stat().st_mtime_ns == before


def test_a_clip_in_one_process_is_not_continued(tmp_path, capsys):
    pytest.importorskip("av")
    assert main([*WORDS, "--out", str(tmp_path), "--format", "mp4", "--skip-existing"]) == 2
    assert "--skip-existing: expected --format png,exr, got mp4 (a clip" in capsys.readouterr().err
