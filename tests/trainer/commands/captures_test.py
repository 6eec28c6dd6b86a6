"""rnd-train over several captures: alone and on workers of which one is killed."""

from __future__ import annotations

import shutil

import pytest
import torch

from rnd_trainer.commands.train import _has_finished, main
from rnd_trainer.model.checkpoint import load_checkpoint
from support.dask_jobs import in_a_process, two_workers, worker_killed_when

SIZES = ["--steps", "12", "--gaussians", "300", "--preset", "quick", "--save-every", "4"]


def test_captures_of_one_name_are_refused(tmp_path, capsys):
    assert main([str(tmp_path / "a/me"), str(tmp_path / "b/me/capture.json"), "--out", str(tmp_path / "out")]) == 2
    assert "CAPTURE: expected captures of different names" in capsys.readouterr().err


@pytest.mark.parametrize("text", ["", "{", "[]", '"finished"', "\xff", '{"ended": "stopped"}'])
def test_a_training_whose_status_says_nothing_is_not_finished(tmp_path, text):
    assert not _has_finished(tmp_path)
    (tmp_path / "status.json").write_text(text, encoding="latin-1")
    assert not _has_finished(tmp_path)
    (tmp_path / "status.json").write_text('{"ended": "finished"}')
    assert _has_finished(tmp_path)


@pytest.mark.slow
def test_a_training_goes_on_where_its_worker_was_killed(tiny_capture, tmp_path, capsys):
    captures = [str(shutil.copytree(tiny_capture.folder, tmp_path / name)) for name in ("ann", "ben")]
    alone, spread = tmp_path / "alone", tmp_path / "spread"
    in_a_process("rnd_trainer.commands.train", captures[0], *SIZES, "--out", tmp_path / "first")
    with two_workers() as (cluster, where):
        with worker_killed_when(cluster, lambda: any(spread.glob("*/training.state"))) as killed:
            assert main([*captures, *SIZES, "--out", str(spread), "--on", where]) == 0
        assert killed
    in_a_process("rnd_trainer.commands.train", *captures, *SIZES, "--out", alone)
    for name in ("ann", "ben"):
        made, expected = (
            load_checkpoint(folder / name / "avatar.ckpt").model.state_dict() for folder in (spread, alone)
        )
        assert made.keys() == expected.keys() and all(torch.equal(made[key], expected[key]) for key in made)
        assert (spread / name / "eval.json").is_file()
    capsys.readouterr()
    assert main([*captures, *SIZES, "--out", str(spread), "--skip-existing"]) == 0
    assert main([*captures, *SIZES, "--out", str(spread)]) == 2
    assert "holds a training already" in capsys.readouterr().err
