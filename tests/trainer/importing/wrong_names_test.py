"""rnd-data import: other conventions are named with the option that corrects them."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from rnd_runtime.capture.capture import load_capture
from rnd_trainer.checking.check import MIN_IOU
from rnd_trainer.checking.normals import parse_axes
from rnd_trainer.commands import data as data_cli
from support import layouts
from support.imported import LAYOUTS, assert_the_scene
from support.known_scene import FRAMES, view_of
from support.pose_programs import INTRINSICS, LENS, write_frames, write_poses


@pytest.fixture
def import_it(tmp_path, capsys) -> Callable[..., tuple[int, str, Path]]:
    """Run ``rnd-data import`` on a source: exit code, output, the capture's folder."""
    body = layouts.body_file(tmp_path)

    def run(source: Path, *options: object) -> tuple[int, str, Path]:
        out = tmp_path / f"capture{len(list(tmp_path.glob('capture*')))}"
        with pytest.raises(SystemExit) as ended:
            data_cli.main([str(word) for word in ("import", source, out, "--body", body, *options)])
        printed = capsys.readouterr()
        return int(ended.value.code or 0), printed.out + printed.err, out

    return run


@pytest.mark.parametrize("name", ["ARAH", "PeopleSnapshot", "nerfstudio", "ZJU-MoCap", "HumanNeRF", "EasyVolcap"])
def test_a_root_of_the_other_convention_is_named_and_corrected(tmp_path, monkeypatch, import_it, name) -> None:
    """The layout's own files, but Th where SMPL's trans belongs, or trans where Th belongs."""
    smpl = name in ("ARAH", "PeopleSnapshot", "nerfstudio")
    ours, other = ("trans", "Th") if smpl else ("Th", "trans")
    monkeypatch.setattr(layouts.World, ours, getattr(layouts.World, other))
    layout = LAYOUTS[name]
    source = layout.write_into(tmp_path / "source")
    every = ("--held-out-every", layout.selection.held_out_every) if layout.camera_of else ()
    code, printed, _ = import_it(source, *every)
    assert code == 1
    option = f"--root {'easymocap' if smpl else 'smpl'}"
    found = re.search(r"wrong silhouette: mean IoU (0\.\d\d): the root rotation looks like (.+?) \(mean", printed)
    assert found and found[2].endswith(f"try {option}"), printed
    assert float(found[1]) < MIN_IOU
    code, printed, out = import_it(source, *every, *option.split())
    assert code == 0, printed
    assert_the_scene(load_capture(out), layout)


@pytest.fixture
def frames(tmp_path) -> Path:
    """A folder with the scene's frames, masks and poses in camera axes."""
    write_frames(tmp_path)
    write_poses(tmp_path)
    return tmp_path


def _of_frames(folder: Path) -> list[object]:
    return ["--poses", folder / "poses.npz", "--masks", folder / "masks", "--intrinsics", *INTRINSICS]


@pytest.mark.parametrize(
    ("written", "given"),
    [("x,-y,-z", "x,y,z"), ("x,-y,-z", "y,x,-z"), ("-x,y,z", "-x,-y,-z"), ("y,-z,-x", "x,y,z"), ("y,-z,-x", "z,x,y")],
)
def test_wrong_axes_are_named_as_the_option_takes_them(frames, import_it, written, given) -> None:
    """``--normal-axes=given`` for maps in the axes ``written``: the check names ``written``."""
    to_theirs = np.linalg.inv(parse_axes(written))
    (frames / "normals").mkdir()
    for k in range(FRAMES):
        normals = view_of(LENS, k).normals @ to_theirs.T
        np.save(frames / "normals" / f"{k:05d}.npy", normals.astype(np.float32))
    options = [*_of_frames(frames), "--normals", frames / "normals"]
    code, printed, _ = import_it(frames / "frames", *options, f"--normal-axes={given}")
    named = re.search(r"wrong normals: mean cosine .* with --normal-axes=(\S+) it would be 1\.00", printed)
    assert code == 1 and named and named[1] == written, printed
    code, printed, out = import_it(frames / "frames", *options, f"--normal-axes={named[1]}")
    assert code == 0, printed
    capture = load_capture(out)
    for frame in capture.frames:
        normals, truth = capture.load_frame(frame).normal, view_of(LENS, frame.frame)
        assert (normals * truth.normals).sum(-1)[truth.mask].min() > 0.999


@pytest.mark.parametrize("write", [layouts.write_rana, partial(layouts.write_intrinsic_avatar, many=False)])
def test_axes_of_a_layouts_own_normals_can_be_given(tmp_path, monkeypatch, import_it, write) -> None:
    """OpenCV's axes where RANA promises OpenGL's."""
    monkeypatch.setattr(layouts, "FLIP", np.eye(3))
    (tmp_path / "source").mkdir()
    write(tmp_path / "source")
    code, printed, _ = import_it(tmp_path / "source")
    assert code == 1 and "with --normal-axes=x,-y,-z it would be 1.00" in printed
    code, printed, _ = import_it(tmp_path / "source", "--normal-axes=x,-y,-z")
    assert code == 0 and "ok normals: in 4 frames, 0° from the template" in printed, printed


UNUSED = [
    # source, options, words of the refusal
    ("rana", ("--poses", "poses.npz"), "--poses: expected none, as rana has its own"),
    ("rana", ("--person", 1), "--person: expected none, as rana has its own"),
    ("rana", ("--distortion", 0.1, 0, 0, 0), "--distortion: expected none, as rana has its own"),
    ("rana", ("--normal-axes=x,y",), "such as x,-y,-z"),
    ("rana", ("--root", "smpl"), "--root: expected none, as this layout stores the pelvis position"),
    ("rana", ("--count", 5), "--count: expected the default, got 5"),
    ("rana", ("--as", "rama"), "--as: expected zju or"),
    ("rana", ("--as", "zju"), "layout: expected zju"),
    ("frames", ("--normal-axes=x,y,z",), "--normal-axes: expected normals to permute"),
    ("frames", ("--mask-net", "net.onnx"), "--masks and --mask-net: expected one of them"),
    ("frames", ("--held-out-every", 2), "--held-out-every: expected the default, got 2"),
    ("frames", ("--train-camera", 1), "--train-camera: expected the default, got 1"),
]


@pytest.mark.parametrize(("source", "options", "words"), UNUSED)
def test_options_without_effect_are_refused(frames, import_it, source, options, words) -> None:
    if source == "rana":
        layouts.write_rana(frames / "rana")
    else:
        options = (*_of_frames(frames), *options)
    code, printed, _ = import_it(frames / source, *options)
    line = printed.strip().splitlines()[-1]
    assert code == 2 and line.startswith("rnd-data: ") and words in line
