"""Invalid options and files: one line that names them, and exit code 2."""

from __future__ import annotations

import json
import os

import numpy as np
import pytest

import rnd_bench.cli
import rnd_export.cli
import rnd_stage.cli
import rnd_trainer.commands.data
import rnd_trainer.commands.eval
import rnd_trainer.commands.train
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import existing_file, write_json
from rnd_trainer.training.data import load_views
from support.paths import ASSETS

CAPTURE = str(ASSETS / "capture")
COMMANDS = {
    "rnd-train": rnd_trainer.commands.train.main,
    "rnd-eval": rnd_trainer.commands.eval.main,
    "rnd-export": rnd_export.cli.main,
    "rnd-bench": rnd_bench.cli.main,
    "rnd-data": rnd_trainer.commands.data.main,
    "rnd-stage": rnd_stage.cli.main,
}
BODY, AVATAR = ASSETS / "body.npz", ASSETS / "avatar.onnx"
IS_READ = "output: expected another file than what is read, got"
IMPORT = f"rnd-data import {CAPTURE} OUT --body {BODY}"


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (f"rnd-train {CAPTURE} --out OUT --seed -1", "--seed: expected 0 to 2^63 - 1, got -1"),
        (f"rnd-train {CAPTURE} --out OUT --seed {2**64}", "--seed: expected 0 to 2^63 - 1, got 184467"),
        (
            f"rnd-train {CAPTURE} --out OUT --light none --probe-channels 1",
            "--probe-channels: expected the default, got 1 (--light none learns no light)",
        ),
        (
            f"rnd-train {CAPTURE} --out OUT --light capture --grey-card 0:1,1",
            "--grey-card: expected the default, got 0:1,1 (--light capture learns no light)",
        ),
        (
            f"rnd-train {CAPTURE} --out OUT --grey-card chest",
            "--grey-card: expected FRAME:X,Y, such as 12:340,220, got chest",
        ),
        (
            f"rnd-train {CAPTURE} --out OUT --light none --visibility paper",
            "--visibility: expected the default, got paper",
        ),
        (f"rnd-train {CAPTURE} --out OUT --steps 0", "--steps: expected at least 1, got 0"),
        (f"rnd-train {CAPTURE} --out OUT --image-scale 0", "--image-scale: expected more than 0, at most 1, got 0"),
        (f"rnd-eval OUT {CAPTURE} --cull 2", "--cull: expected a cosine, from -1 to 1, got 2"),
        (f"rnd-train {CAPTURE} --out OUT --device mps", "--device: expected cpu, cuda or cuda:NUMBER, got mps"),
        ("rnd-export OUT/avatar.ckpt --motion walk.npz --frames 9", "--frames: expected the default, got 9"),
        ("rnd-export OUT/avatar.ckpt --cull -2", "--cull: expected a cosine, from -1 to 1, got -2"),
        ("rnd-export OUT/avatar.ckpt --frames 1", "--frames: expected 2 to 1000, got 1"),
        (f"rnd-export {BODY} --out {BODY}", "output: expected another file than what is read, got"),
        (f"rnd-export {BODY} --out a.json", "--out: expected a name in .onnx, got a.json"),
        ("rnd-export .", "avatar.ckpt: checkpoint not found"),
        (f"rnd-export {AVATAR}", "not a checkpoint: expected an avatar.ckpt of rnd-train, got .onnx"),
        ("rnd-bench raster --threads 999", "--threads: expected 1 to "),
        (f"rnd-bench frame {ASSETS} --cull 2", "--cull: expected a cosine, from -1 to 1, got 2"),
        (f"rnd-bench grid {ASSETS} --chart chart.pdf", "--chart: expected .svg or .png, got chart.pdf"),
        (f"rnd-bench stability {CAPTURE} --rows P1,Q9", "--rows: expected some of P1,P2"),
        (f"rnd-bench stability {CAPTURE} --size 0", "--size: expected 16 to 4096, got 0"),
        (f"rnd-bench study causes OUT {CAPTURE} --seeds 101", "--seeds: expected 1 to 100, got 101"),
        (f"rnd-bench study causes OUT {CAPTURE} --shade lights:K", "shading mode: expected one of ao, table"),
        (f"rnd-bench study causes OUT {CAPTURE}", "variant 'true normals': expected normal_gt"),
        (f"rnd-bench study causes OUT {CAPTURE} --json {CAPTURE}/capture.json", IS_READ),
        (f"{IMPORT} --every 0", "--every: expected at least 1, got 0"),
        (f"{IMPORT} --held-out-every 0", "--held-out-every: expected at least 1, got 0"),
        (f"{IMPORT} --count 0", "--count: expected at least 1, got 0"),
        (f"{IMPORT} --start 9 --stop 3", "--stop: expected more than --start 9, got 3"),
        (f"{IMPORT} --fps 0", "--fps: expected 0.001 to 10000, got 0"),
        (f"rnd-eval OUT {CAPTURE} --json {ASSETS}", "assets: cannot be written: it is a folder"),
        (f"rnd-export {BODY} --out {BODY}/a.onnx", "body.npz: output folder cannot be made"),
        (f"rnd-eval OUT {CAPTURE} --json {CAPTURE}/capture.json", IS_READ),
        (f"rnd-eval OUT/avatar.ckpt {CAPTURE} --json OUT/avatar.ckpt", IS_READ),
        (f"rnd-eval OUT {CAPTURE} --perceptual-weights {BODY} --json {BODY}", IS_READ),
        (f"rnd-export {BODY} --out OUT.onnx --max-mb 5 --json OUT.onnx", IS_READ),
        (f"rnd-export {BODY} --max-mb 5 --capture {CAPTURE} --json {CAPTURE}/capture.json", IS_READ),
        (f"rnd-export {BODY} --out OUT.onnx --max-mb 5 --json {ASSETS}", "assets: cannot be written: it is a folder"),
        ("rnd-bench study agreement OUT/a.json --step nan", "--step: expected 0.001 to 0.03 m, got nan"),
        ("rnd-bench study agreement OUT/a.json --step 0", "--step: expected 0.001 to 0.03 m, got 0"),
        (f"rnd-bench study agreement {ASSETS}", "assets: cannot be written: it is a folder"),
        (
            "rnd-stage OUT --character X.npz --subject 2",
            "--subject: expected the default, got 2 (--character has its own)",
        ),
        ("rnd-stage OUT --character X.npz --step 0.01", "--step: expected the default, got 0.01 (--character"),
        ("rnd-stage OUT --estimate-seed -1", "--estimate-seed: expected at least 0, got -1"),
    ],
)
def test_invalid_numbers_are_refused(line, message, tmp_path, monkeypatch, capsys) -> None:
    command, *words = line.replace("OUT", str(tmp_path / "out")).split()
    monkeypatch.setattr("sys.argv", [command, *words])
    code = _code(COMMANDS[command])
    error = capsys.readouterr().err.lstrip()  # where a progress bar had begun, it has ended its line
    assert code == 2 and error.startswith(command) and message in error, error
    assert error.count("\n") == 1 and not any(tmp_path.rglob("*.*"))


def _code(main) -> object:
    """Exit code of a command, returned or raised."""
    try:
        return main()
    except SystemExit as ended:
        return ended.code


def test_rows_of_another_bench_are_refused(tmp_path, monkeypatch, capsys) -> None:
    rows = tmp_path / "raster.json"
    rows.write_text(json.dumps([{"n": 3, "machine": "this one"}]))
    assert rnd_bench.cli.main(["grid", str(ASSETS), "--quick", "--json", str(rows)]) == 2
    assert "expected rows of rnd-bench, got another file" in capsys.readouterr().err


def test_an_unreadable_file_is_named(tmp_path, monkeypatch) -> None:
    file = tmp_path / "avatar.onnx"
    file.write_bytes(b"secret")
    monkeypatch.setattr(os, "access", lambda path, mode: False)  # whoever runs the tests
    with pytest.raises(InputError, match=r"avatar\.onnx: avatar cannot be read: got no permission"):
        existing_file(file, what="avatar")


def test_json_has_no_nan(tmp_path) -> None:
    write_json(tmp_path / "a.json", {"a": [float("nan"), (1.5, float("inf"))], "b": np.float64(np.nan)})
    assert json.loads((tmp_path / "a.json").read_text()) == {"a": [None, [1.5, None]], "b": None}


def test_images_too_small_for_the_losses_are_refused(tiny_capture) -> None:
    with pytest.raises(InputError, match=r"training images: expected at least 11 pixels wide and high, got \d+ x"):
        load_views(tiny_capture, "train", 0.1)


def test_crops_have_at_least_the_size_of_the_ssim_window(tiny_capture) -> None:
    """The crop of a partly visible person is as wide as the SSIM window."""
    camera = next(iter(tiny_capture.cameras.values()))
    views, _ = load_views(tiny_capture, "train", 11.5 / min(camera.width, camera.height))
    assert min(min(view.camera.width, view.camera.height) for view in views) >= 11
