"""``rnd-export --target visionary``: the clip that ``rnd-convert`` makes of the exported avatar."""

from __future__ import annotations

import sys

import pytest

from rnd_export.cli import main
from rnd_runtime.motion.motion import save_motion
from rnd_viewer.convert.cli import main as convert
from support.tiny import ASSETS, body, motion


@pytest.fixture
def run(monkeypatch, capsys):
    """rnd-export with a line of words: its exit status and what it printed."""

    def command(*words: object) -> tuple[object, str]:
        monkeypatch.setattr(sys, "argv", ["rnd-export", *map(str, words)])
        with pytest.raises(SystemExit) as ended:
            main()
        printed = capsys.readouterr()
        return ended.value.code, printed.out + printed.err

    return command


def test_it_is_what_rnd_convert_makes(tiny_checkpoint, tmp_path, run) -> None:
    sky, moves = ASSETS / "sky.exr", tmp_path / "moves.npz"
    save_motion(moves, motion(body()))
    assert run(tiny_checkpoint, "--out", tmp_path / "avatar.onnx", "--motion", moves)[0] == 0
    lit = ["--motion", str(moves), "--hdr", str(sky)]
    wanted = ["splats", str(tmp_path / "avatar.onnx"), *lit, "--frames", ":", "--format", "visionary"]
    assert convert([*wanted, "--out", str(tmp_path / "clip")]) == 0
    out = tmp_path / "baked.onnx"
    status, printed = run(tiny_checkpoint, "--target", "visionary", *lit, "--out", out)
    assert status == 0 and "frames, " in printed
    assert out.read_bytes() == (tmp_path / "clip/visionary.onnx").read_bytes()


def test_a_motion_too_long_for_a_clip_is_refused_by_its_own_name(tiny_checkpoint, tmp_path, run, monkeypatch) -> None:
    monkeypatch.setattr("rnd_viewer.convert.visionary.MOST_BYTES", 3 * 40 * 800)
    save_motion(tmp_path / "moves.npz", motion(body()))
    words = ["--motion", tmp_path / "moves.npz", "--out", tmp_path / "baked.onnx"]
    status, printed = run(tiny_checkpoint, "--target", "visionary", *words)
    assert status == 2 and not (tmp_path / "baked.onnx").exists()
    assert "frames of --motion: expected at most 3 of this avatar for visionary" in printed
    assert "rnd-convert splats" in printed


@pytest.mark.parametrize(
    ("words", "line"),
    [
        ([], "--target visionary: expected a --motion to bake in, got none"),
        (["--motion", "m.npz", "--max-mb", "4"], "--target: expected the default, got visionary"),
        (["--motion", "m.npz", "--size", "256"], "--size: expected the default, got 256"),
    ],
)
def test_what_does_not_go_together_is_refused(tiny_checkpoint, run, words, line) -> None:
    status, printed = run(tiny_checkpoint, "--target", "visionary", *words)
    assert status == 2 and line in printed
