"""What is imported under the wrong name is told its right one, by the command, and what it tells mends it."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from rnd_runtime.capture.capture import load_capture
from rnd_runtime.core.images import to_bytes, write_image
from rnd_trainer.checking.check import GOOD_OVERLAP
from rnd_trainer.checking.normals import parse_axes
from rnd_trainer.commands import data as data_cli
from support import layouts
from support.known_scene import BETAS, FRAMES, HEIGHT, WIDTH, view_of
from trainer.importing.importing_test import LAYOUTS, ONE_A_MOMENT, assert_the_scene

ALIGNED = 0.999  # cosine of stored normals with the scene's: 8 bits


@pytest.fixture
def import_it(tmp_path, monkeypatch, capsys) -> Callable[..., tuple[int, str, Path]]:
    """Run ``rnd-data import`` on a source: exit code, what was printed, the capture's folder."""
    body = layouts.body_file(tmp_path)

    def run(source: Path, *options: object) -> tuple[int, str, Path]:
        out = tmp_path / f"capture{len(list(tmp_path.glob('capture*')))}"
        words = ["import", source, out, "--body", body, *options]
        monkeypatch.setattr("sys.argv", ["rnd-data", *map(str, words)])
        with pytest.raises(SystemExit) as ended:
            data_cli.main()
        printed = capsys.readouterr()
        return int(ended.value.code or 0), printed.out + printed.err, out

    return run


SMPL_ROOTS = ("ARAH", "PeopleSnapshot", "InstantAvatar", "RANA prepared", "SyntheticHuman", "nerfstudio")
EASYMOCAP_ROOTS = ("ZJU-MoCap", "ZJU-MoCap refined", "HumanNeRF", "EasyMocap", "EasyVolcap")


@pytest.mark.parametrize("name", [*SMPL_ROOTS, *EASYMOCAP_ROOTS])
def test_a_root_of_the_other_convention_is_named_and_mended(tmp_path, monkeypatch, import_it, name) -> None:
    """The layout's own files, but Th where SMPL's trans belongs, or trans where Th belongs."""
    if name == "PeopleSnapshot":
        pytest.importorskip("h5py")
    smpl = name in SMPL_ROOTS
    ours, other = ("trans", "Th") if smpl else ("Th", "trans")
    monkeypatch.setattr(layouts.World, ours, getattr(layouts.World, other))
    source = tmp_path / "source"
    source.mkdir()
    _, write, camera_of, bent, fps = LAYOUTS[name]
    write(source)
    every = () if camera_of in ONE_A_MOMENT else ("--held-out-every", 1)
    code, printed, _ = import_it(source, *every)
    assert code == 1
    told = "EasyMocap's Rh/Th; try --as easymocap" if smpl else "read as EasyMocap's Rh/Th; try --as smpl"
    found = re.search(r"wrong silhouette: mean IoU (0\.\d\d): the root rotation looks like (.+?) \(mean", printed)
    assert found and found[2].endswith(told), printed
    assert float(found[1]) < GOOD_OVERLAP
    code, printed, out = import_it(source, *every, "--as", told.split()[-1])
    assert code == 0, printed
    assert_the_scene(load_capture(out), camera_of, bent=bent, fps=fps)


def test_a_layout_that_places_the_pelvis_has_no_root_to_misread(tmp_path, import_it) -> None:
    layouts.write_rana(tmp_path)
    code, printed, _ = import_it(tmp_path, "--as", "smpl")
    assert code == 2 and "this layout says where the pelvis is" in printed


# Normals


@pytest.fixture
def frames(tmp_path) -> Path:
    """A folder with the scene's frames, masks and poses before the camera."""
    camera, world = layouts.video_camera(77.0), layouts.camera_world()
    for k in range(FRAMES):
        view = view_of(camera, k)
        image = np.where(view.mask[..., None], to_bytes(0.2 + 0.35 * (view.normals + 1)), 90)
        write_image(tmp_path / "frames" / f"{k:05d}.png", image.astype(np.uint8))
        write_image(tmp_path / "masks" / f"{k:05d}.png", (255 * view.mask).astype(np.uint8))
    np.savez(tmp_path / "poses.npz", thetas=world.thetas, trans=world.trans, betas=BETAS)
    return tmp_path


def _of_frames(folder: Path) -> list[object]:
    lens = ("--intrinsics", 77, 77, WIDTH / 2, HEIGHT / 2)
    return ["--poses", folder / "poses.npz", "--masks", folder / "masks", *lens]


def _assert_normals(out: Path) -> None:
    capture = load_capture(out)
    for frame in capture.frames:
        normals, truth = capture.load_frame(frame).normal, view_of(layouts.video_camera(77.0), frame.frame)
        assert (normals * truth.normals).sum(-1)[truth.mask].min() > ALIGNED


@pytest.mark.parametrize("said", ["x,y,z", "x,-y,z", "-x,-y,-z", "y,x,-z", "z,x,y"])
@pytest.mark.parametrize("written", ["x,-y,-z", "-x,y,z", "y,-z,-x"])
def test_axes_told_wrongly_are_named_as_the_flag_wants_them(frames, import_it, written, said) -> None:
    """``--normal-axes=SAID`` for maps in the axes ``written``: the check names ``written``, whatever was said."""
    to_theirs = np.linalg.inv(parse_axes(written))
    (frames / "normals").mkdir()
    for k in range(FRAMES):
        normals = view_of(layouts.video_camera(77.0), k).normals @ to_theirs.T
        np.save(frames / "normals" / f"{k:05d}.npy", normals.astype(np.float32))
    given = [*_of_frames(frames), "--normals", frames / "normals"]
    code, printed, _ = import_it(frames / "frames", *given, f"--normal-axes={said}")
    named = re.search(r"wrong normals: mean cosine .* with --normal-axes=(\S+) it would be 1\.00", printed)
    assert code == 1 and named and named[1] == written, printed
    code, printed, out = import_it(frames / "frames", *given, f"--normal-axes={named[1]}")
    assert code == 0, printed
    _assert_normals(out)


@pytest.mark.parametrize("write", [layouts.write_rana, partial(layouts.write_intrinsic_avatar, many=False)])
def test_a_layouts_own_normals_can_be_turned(tmp_path, monkeypatch, import_it, write) -> None:
    """OpenCV's axes where RANA promises OpenGL's."""
    monkeypatch.setattr(layouts, "FLIP", np.eye(3))
    (tmp_path / "source").mkdir()
    write(tmp_path / "source")
    code, printed, _ = import_it(tmp_path / "source")
    assert code == 1 and "with --normal-axes=x,-y,-z it would be 1.00" in printed
    code, printed, _ = import_it(tmp_path / "source", "--normal-axes=x,-y,-z")
    assert code == 0 and "ok normals: in 4 frames, 0° from the template" in printed, printed


# What cannot be meant


def test_options_that_would_change_nothing_are_refused(frames, import_it) -> None:
    def refusal(source: Path, *options: object) -> str:
        code, printed, _ = import_it(source, *options)
        assert code == 2
        return printed.strip().splitlines()[-1]

    (frames / "rana").mkdir()
    layouts.write_rana(frames / "rana")
    folder = frames / "frames"
    for option in ("--poses", frames / "poses.npz"), ("--person", 1), ("--distortion", 0.1, 0, 0, 0):
        assert f"{option[0]}: expected none, as rana has its own" in refusal(frames / "rana", *option)
    assert "--normal-axes: expected normals to turn" in refusal(folder, *_of_frames(frames), "--normal-axes=x,y,z")
    assert "such as x,-y,-z" in refusal(frames / "rana", "--normal-axes=x,y")
    both = ("--mask-net", frames / "net.onnx")
    assert "--masks and --mask-net: expected one of them" in refusal(folder, *_of_frames(frames), *both)
    for option in ("--held-out-every", 2), ("--train-camera", 1):
        said = f"{option[0]}: expected the default, got {option[1]} (a video has one camera, and its last 1/5 are"
        assert said in refusal(folder, *_of_frames(frames), *option)
    assert import_it(folder, *_of_frames(frames), "--train-camera", 0)[0] == 0  # the only one there is
    assert "--count: expected the default, got 5 (of a video the sharpest pictures" in refusal(
        frames / "rana", "--count", 5
    )
    assert "--as: expected zju or" in refusal(frames / "rana", "--as", "rama")
    assert "layout: expected zju" in refusal(frames / "rana", "--as", "zju")
