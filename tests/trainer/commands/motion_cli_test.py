"""rnd-data motion, as a user types it."""

import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from rnd_runtime.capture.body import Body
from rnd_runtime.motion.motion import load_motion
from rnd_runtime.motion.skeleton import SMPL_NAMES
from rnd_trainer.commands.data import main
from runtime.motion.motion_formats_test import FRAMES, MATRICES, NAMINGS, _bvh, _easymocap_json, _phalp
from support.paths import ASSETS


def _run(monkeypatch, *arguments: object) -> int:
    monkeypatch.setattr(sys, "argv", ["rnd-data", "motion", *map(str, arguments)])
    with pytest.raises(SystemExit) as exit_:
        main()
    return int(exit_.value.code or 0)


def test_a_walk_goes_out_as_amass_and_comes_back(tmp_path, monkeypatch, capsys):
    body, out = ASSETS / "body.npz", tmp_path / "walk.npz"
    assert _run(monkeypatch, ASSETS / "walk.npz", out, "--body", body) == 0
    assert "132 frames, 30 per second" in capsys.readouterr().out
    with np.load(out) as archive:
        assert archive["poses"].shape == (132, 156) and archive["trans"].shape == (132, 3)
        assert archive["mocap_framerate"] == 30
    skeleton = Body.load(body).skeleton
    before, after = load_motion(ASSETS / "walk.npz", skeleton), load_motion(out, skeleton)
    assert_allclose(after.rotations, before.rotations, atol=1e-9)
    assert_allclose(after.translations, before.translations, atol=1e-9)


FEET = [SMPL_NAMES.index(f"{side}_foot") for side in ("left", "right")]


def _lowest_foot(file: Path) -> float:
    """m above the floor, of the embedded body."""
    skeleton = Body.load(ASSETS / "body.npz").skeleton
    motion = load_motion(file, skeleton)
    heights = skeleton.joint_transforms(motion.rotations, motion.translations)[:, FEET, 1, 3]
    return float(np.percentile(heights.min(1), 5))


def test_without_a_body_people_stand_on_the_floor(tmp_path, monkeypatch, capsys):
    """SMPL's mean body is about its chest: a BVH and a walk from a body that stands on y = 0 come up to the floor."""
    out = tmp_path / "out.npz"
    for source in (_bvh(tmp_path / "a.bvh", NAMINGS["smpl"]), ASSETS / "walk.npz"):
        assert _run(monkeypatch, source, out) == 0
        assert abs(_lowest_foot(out)) < 0.1
        lifted = "lifted by 1.17 m" in capsys.readouterr().out
        assert lifted == (source.suffix == ".npz")
    _run(monkeypatch, out, tmp_path / "again.npz")
    assert "lifted" not in capsys.readouterr().out


def test_fingers_go_through(tmp_path, monkeypatch, capsys):
    """An AMASS file comes out as it went in; what SMPL-H lacks, or a body given, is said to be left out."""
    source, out = tmp_path / "in.npz", tmp_path / "out.npz"
    poses = 0.3 * np.random.default_rng(0).normal(size=(FRAMES, 55, 3))
    members = {"trans": np.tile([0, 0, 1.2], (FRAMES, 1)), "mocap_framerate": 30.0}
    for poses_in, left_out in ((np.delete(poses, [22, 23, 24], 1), None), (poses, "jaw, left_eye, right_eye")):
        np.savez(source, poses=poses_in.reshape(FRAMES, -1), **members)
        assert _run(monkeypatch, source, out) == 0
        with np.load(out) as archive:
            assert_allclose(archive["poses"].reshape(FRAMES, 52, 3), np.delete(poses, [22, 23, 24], 1), atol=1e-9)
        printed = capsys.readouterr().out
        assert (f"left out: {left_out}\n" in printed) if left_out else ("left out" not in printed)
    assert _run(monkeypatch, source, out, "--body", ASSETS / "body.npz") == 0
    assert "the skeleton lacks are left out: jaw, left_eye, right_eye, left_index2" in capsys.readouterr().out


def test_edits_and_rates(tmp_path, monkeypatch, capsys):
    arguments = ("--speed", 2, "--in-place", "--loop", "--smooth", 3, "--fps", 60)
    assert _run(monkeypatch, ASSETS / "walk.npz", tmp_path / "w.npz", *arguments) == 0
    with np.load(tmp_path / "w.npz") as archive:
        assert archive["mocap_framerate"] == 60
        assert np.ptp(archive["trans"][:, :2], axis=0).max() < 1e-9  # Z up: the floor's axes
        assert 60 < len(archive["poses"]) < 120  # half of 4.4 s, less the seam, at 60


def test_a_loop_at_another_rate_repeats_no_frame(tmp_path, monkeypatch, capsys):
    """132 frames less a seam of 15 go round in 3.9 s, at 60 per second in 234 frames."""
    arguments = ("--loop", "--in-place", "--fps", 60)
    assert _run(monkeypatch, ASSETS / "walk.npz", tmp_path / "w.npz", *arguments) == 0
    assert "234 frames, 60 per second, 3.9 s" in capsys.readouterr().out
    with np.load(tmp_path / "w.npz") as archive:
        assert len(archive["poses"]) == 234
        assert np.abs(archive["poses"][0] - archive["poses"][-1]).max() > 1e-3  # rad


@pytest.mark.parametrize("write", [_easymocap_json, _phalp])
def test_fits_of_a_video_go_out_as_amass(tmp_path, monkeypatch, capsys, write):
    """EasyMocap's folder and PHALP's pickle: the command says whom it took and what it assumed."""
    source, out = write(tmp_path), tmp_path / "out.npz"
    assert _run(monkeypatch, source, out, "--source-fps", 25) == 0
    printed = capsys.readouterr().out
    assert "left out:" in printed and f"{FRAMES} frames, 25 per second" in printed
    skeleton = Body.load(ASSETS / "body.npz").skeleton
    assert_allclose(load_motion(out, skeleton).rotations, MATRICES, atol=2e-6)


@pytest.mark.parametrize("name", ["walk[final].npz", "out[/x].npz"])
def test_a_files_name_is_printed_as_it_is(tmp_path, monkeypatch, capsys, name):
    monkeypatch.chdir(tmp_path)
    assert _run(monkeypatch, ASSETS / "walk.npz", name) == 0
    assert f"{name}: 132 frames" in capsys.readouterr().out


def test_bad_use_is_one_line_and_exit_2(tmp_path, monkeypatch, capsys):
    assert _run(monkeypatch, ASSETS / "walk.npz", tmp_path / "w.bvh") == 2
    assert "ends in .npz" in capsys.readouterr().err
    assert _run(monkeypatch, tmp_path / "none.bvh", tmp_path / "w.npz") == 2
    assert "none.bvh" in capsys.readouterr().err


def test_what_is_read_is_not_written_over(tmp_path, monkeypatch, capsys):
    walk, body = (Path(shutil.copy(ASSETS / name, tmp_path)) for name in ("walk.npz", "body.npz"))
    before = [file.read_bytes() for file in (walk, body)]
    for out in (walk, body):
        assert _run(monkeypatch, walk, out, "--body", body) == 2
        assert "output: expected another file than what is read" in capsys.readouterr().err
    assert [file.read_bytes() for file in (walk, body)] == before
