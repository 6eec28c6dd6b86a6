"""The commands one after another, as a user types them, and what they say to bad input."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from rnd_runtime.core.images import read_image
from support.tiny import ASSETS

BIN = Path(sys.executable).parent
WALK, SKY = ASSETS / "walk.npz", ASSETS / "sky.exr"


def _command(*words: object) -> subprocess.CompletedProcess[str]:
    line = [str(BIN / str(words[0])), *map(str, words[1:])]
    return subprocess.run(line, capture_output=True, text=True, timeout=300, check=False)


def _refused(*words: object) -> str:
    """The one line with which a command refuses its input."""
    done = _command(*words)
    assert done.returncode == 2, done
    lines = done.stderr.strip().splitlines()
    assert len(lines) == 1 and lines[0].startswith(f"{words[0]}: "), done.stderr
    return lines[0]


@pytest.fixture(scope="module")
def played(tiny_capture, tmp_path_factory) -> Path:
    """A folder in which the whole chain has run."""
    folder = tmp_path_factory.mktemp("chain")
    words = ["rnd-train", tiny_capture.folder, "--out", folder / "run", "--preset", "quick"]
    played = ["--motion", WALK, "--hdr", SKY, "--frames", "0:3", "--size", 96]
    for line in (
        [*words, "--steps", 8, "--gaussians", 400],
        ["rnd-export", folder / "run" / "avatar.ckpt"],
        ["rnd-play", folder / "run" / "avatar.onnx", *played, "--out", folder / "out"],
    ):
        done = _command(*line)
        assert done.returncode == 0, done.stderr
    return folder


def test_the_chain_leaves_what_it_promises(played) -> None:
    run = played / "run"
    for name in ("avatar.ckpt", "avatar.onnx", "config.json", "metrics.jsonl", "training.state", "eval.json"):
        assert (run / name).stat().st_size > 0, name
    assert sorted(p.name for p in (run / "previews").iterdir()) == ["step_000014.png"]
    frames = sorted((played / "out" / "frames").iterdir())
    assert [frame.name for frame in frames] == ["000000.png", "000001.png", "000002.png"]
    picture = read_image(frames[0])
    assert picture.shape == (96, 96, 4)
    covered = (picture[..., 3] > 127).mean()
    assert 0.02 < covered < 0.5  # a person, not nothing and not everything
    hidden = [path.name for path in played.rglob(".*")]
    assert [name for name in hidden if not name.startswith(".run-")] == []  # no temporary is left
    stages = json.loads((played / "out" / "play_000000-000003.json").read_text())["times"]
    assert {"load", "encoders", "shading", "projection", "sort", "raster", "write"} <= set(stages)
    assert stages["encoders"]["runs"] == 3 and stages["load"]["runs"] == 1


def test_evaluation_rows_say_what_they_are(played) -> None:
    rows = json.loads((played / "run" / "eval.json").read_text())
    assert [row["split"] for row in rows] == ["novel_view"]
    assert rows[0]["frames"] == 2 and 5 < rows[0]["psnr"] < 60
    assert {"machine", "gaussians", "steps", "seed", "minutes", "normal_deg", "ssim_box"} <= set(rows[0])


def test_a_finished_folder_is_not_overwritten(played, tiny_capture) -> None:
    line = _refused("rnd-train", tiny_capture.folder, "--out", played / "run")
    assert "holds a training already" in line and "--resume" in line
    line = _refused("rnd-train", tiny_capture.folder, "--out", played / "none", "--resume")
    assert "state of a training to resume not found" in line and "none/training.state" in line


def test_an_avatar_is_not_overwritten_where_its_state_is_gone(played, tiny_capture, tmp_path) -> None:
    shutil.copy(played / "run" / "avatar.ckpt", tmp_path)
    line = _refused("rnd-train", tiny_capture.folder, "--out", tmp_path)
    assert "holds a training already" in line and "--resume" not in line
    assert [file.name for file in tmp_path.iterdir()] == ["avatar.ckpt"]
