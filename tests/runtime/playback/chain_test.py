"""The commands one after another, as a user types them, and what they say to bad input."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from rnd_runtime.core.images import read_image, write_image
from rnd_runtime.motion.motion import save_motion
from support.tiny import ASSETS, body, motion

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
    for line in (
        [*words, "--steps", 8, "--gaussians", 400],
        ["rnd-export", folder / "run" / "avatar.ckpt"],
        [
            "rnd-play",
            folder / "run" / "avatar.onnx",
            "--motion",
            WALK,
            "--hdr",
            SKY,
            "--out",
            folder / "out",
            "--frames",
            "0:3",
            "--size",
            96,
        ],
    ):
        done = _command(*line)
        assert done.returncode == 0, done.stderr
    return folder


def test_the_chain_leaves_what_it_promises(played) -> None:
    run = played / "run"
    for name in ("avatar.ckpt", "avatar.onnx", "config.json", "metrics.jsonl", "training.state", "eval.json"):
        assert (run / name).stat().st_size > 0, name
    assert sorted(p.name for p in (run / "previews").iterdir()) == ["step_000012.png"]
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


def test_training_refuses_bad_captures(tiny_capture, tmp_path) -> None:
    assert "capture not found" in _refused("rnd-train", tmp_path / "nowhere", "--out", tmp_path / "run")
    folder = tmp_path / "capture"
    shutil.copytree(tiny_capture.folder, folder)
    frame = tiny_capture.frames[3]
    write_image(folder / frame.mask, np.zeros((64, 60, 1), np.uint8))
    line = _refused("rnd-train", folder, "--out", tmp_path / "run")
    assert "64" in line and "60" in line and "frame 3" in line
    assert not (tmp_path / "run").exists()
    (folder / frame.mask).unlink()
    assert "front_003.png" in _refused("rnd-train", folder, "--out", tmp_path / "run")


def test_training_refuses_senseless_options(tiny_capture, tmp_path) -> None:
    senseless = {"--steps": 0, "--image-scale": 2, "--gaussians": 3, "--save-every": 0}
    for option, value in senseless.items():
        line = _refused("rnd-train", tiny_capture.folder, "--out", tmp_path / "run", option, value)
        assert option in line and str(value) in line
    weights = tmp_path / "weights.pth"
    weights.write_text("none")
    assert str(weights) in _refused(
        "rnd-train", tiny_capture.folder, "--out", tmp_path / "run", "--perceptual-weights", weights
    )
    assert not (tmp_path / "run").exists()


def test_export_refuses_what_is_no_checkpoint(tiny_checkpoint, tmp_path) -> None:
    cut = tmp_path / "cut.ckpt"
    cut.write_bytes(tiny_checkpoint.read_bytes()[:1000])
    assert "not a whole safetensors file" in _refused("rnd-export", cut)
    assert "checkpoint not found" in _refused("rnd-export", tmp_path / "nowhere.ckpt")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["cut.ckpt"]


def test_an_output_folder_that_cannot_be_made_is_named(tiny_avatar, tiny_capture, tmp_path) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("not a folder")
    play = ["rnd-play", tiny_avatar, "--motion", WALK, "--hdr", SKY, "--out"]
    assert str(blocked) in _refused(*play, blocked / "out")
    assert str(blocked) in _refused("rnd-train", tiny_capture.folder, "--out", blocked / "run")


def test_playing_refuses_bad_files(tiny_avatar, tmp_path) -> None:
    out = tmp_path / "out"

    def line(**changed: object) -> str:
        words = {"avatar": tiny_avatar, "motion": WALK, "hdr": SKY} | changed
        return _refused("rnd-play", words["avatar"], "--motion", words["motion"], "--hdr", words["hdr"], "--out", out)

    broken = tmp_path / "broken.exr"
    broken.write_bytes(SKY.read_bytes()[:500])
    assert "broken.exr" in line(hdr=broken)
    nan = tmp_path / "nan.npz"
    save_motion(nan, motion(body()))
    with np.load(nan) as archive:
        arrays = dict(archive)
    arrays["poses"][4, 7] = np.nan
    np.savez(nan, **arrays)
    assert "nan.npz: frame 4: poses: expected finite numbers" in line(motion=nan)
    arrays["poses"] = np.zeros((6, 75))
    np.savez(nan, **{k: v for k, v in arrays.items() if k != "joint_names"})
    assert "75" in line(motion=nan)
    assert "nowhere.npz" in line(motion=tmp_path / "nowhere.npz")
    cut = tmp_path / "cut.onnx"
    cut.write_bytes(tiny_avatar.read_bytes()[:5000])
    assert "cut.onnx" in line(avatar=cut)
    assert not list(tmp_path.rglob("*.png"))


def test_an_avatar_is_not_overwritten_where_its_state_is_gone(played, tiny_capture, tmp_path) -> None:
    shutil.copy(played / "run" / "avatar.ckpt", tmp_path)
    line = _refused("rnd-train", tiny_capture.folder, "--out", tmp_path)
    assert "holds a training already" in line and "--resume" not in line
    assert [file.name for file in tmp_path.iterdir()] == ["avatar.ckpt"]
