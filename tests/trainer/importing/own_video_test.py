"""Every command of docs/own-video.md, run as it stands there."""

from __future__ import annotations

import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest

from rnd_runtime.capture.capture import load_capture
from rnd_runtime.core.images import to_bytes, write_image
from support import layouts
from support.doc_commands import blocks, exit_code
from support.known_scene import BETAS, FRAMES, HEIGHT, WIDTH, view_of
from support.paths import ROOT
from trainer.importing.pose_files_test import write_wham

COMMANDS = [
    words
    for block in blocks(ROOT / "docs" / "own-video.md")
    if block.kind == "sh" and block.reason is None
    for words in block.commands()
]
SHORT = ("--steps", "10", "--gaussians", "300")


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Path:
    """A folder with everything that the page's commands name."""
    pytest.importorskip("joblib")
    folder = tmp_path_factory.mktemp("own")
    layouts.body_file(folder).rename(folder / "SMPL_NEUTRAL.npz")
    layouts.write_zju(folder / "CoreView_377")
    write_wham(folder)
    wham, plain = layouts.video_camera(np.hypot(WIDTH, HEIGHT)), layouts.video_camera(77.0)
    images = []
    (folder / "normals").mkdir()
    for k in range(FRAMES):
        for camera, kept in ((wham, images), (plain, [])):
            view = view_of(camera, k)
            kept.append(np.where(view.mask[..., None], to_bytes(0.2 + 0.35 * (view.normals + 1)), 90).astype(np.uint8))
        write_image(folder / "frames" / f"{k:05d}.png", kept[0])
        seen = view_of(wham, k)
        write_image(folder / "masks" / f"{k:05d}.png", (255 * seen.mask).astype(np.uint8))
        np.save(folder / "normals" / f"{k:05d}.npy", (seen.normals * [1, -1, -1]).astype(np.float32))
    layouts.write_video(folder / "me.mp4", images)
    world = layouts.camera_world()
    np.savez(folder / "poses.npz", thetas=world.thetas, trans=world.trans, betas=BETAS)
    return folder


def test_every_command_of_the_page_runs(place, monkeypatch, capsys) -> None:
    monkeypatch.chdir(place)
    assert [words[:2] for words in COMMANDS] == [
        *(["rnd-data", name] for name in ("convert-body", "import", "import", "import", "check")),
        ["rnd-train", "me"],
    ]
    for command in COMMANDS:
        assert exit_code(command, monkeypatch) == 0, (command, capsys.readouterr())
    printed = capsys.readouterr().out
    expected = (
        "SMPL, 2340 vertices",
        "found video: a video",
        "found video: a folder of frames",
        "found zju: annots.npy",
        "masks made from the template",
        "up, towards the viewer",
        "silhouette: mean IoU",
    )
    for words in expected:
        assert words in printed, words
    assert len(load_capture(place / "me").frames) == FRAMES
    splits = {(frame.camera, frame.split) for frame in load_capture(place / "zju377").frames}
    assert splits == {("Camera_B1", "train"), ("Camera_B1", "novel_pose"), ("Camera_B2", "novel_view")}


def test_every_command_of_the_readme_runs(place, monkeypatch, capsys) -> None:
    monkeypatch.chdir(place)
    shutil.copyfile("SMPL_NEUTRAL.npz", "smpl.npz")
    shutil.rmtree("runs", ignore_errors=True)  # the page's
    page = blocks(ROOT / "README.md")
    (block,) = (b for b in page if b.reason and b.reason.startswith("tests/own_video_test.py"))
    assert [words[0] for words in block.commands()] == ["rnd-data", "rnd-data", "rnd-train"]
    for words in block.commands():
        more = SHORT if words[0] == "rnd-train" else ()
        assert exit_code([*words, *more], monkeypatch) == 0, (words, capsys.readouterr())
    assert (place / "runs" / "video" / "avatar.ckpt").is_file()


def test_a_capture_is_not_overwritten(place, monkeypatch, capsys) -> None:
    monkeypatch.chdir(place)
    if not (place / "me" / "capture.json").exists():
        (place / "me").mkdir(exist_ok=True)
        (place / "me" / "capture.json").write_text("{}")
    assert exit_code(COMMANDS[1], monkeypatch) == 2
    line = capsys.readouterr().err.strip().splitlines()[-1]
    assert line.startswith("rnd-data: me: holds a capture already")


def test_a_poor_root_is_named_and_mended_by_the_flag_it_names(place, monkeypatch, capsys, tmp_path) -> None:
    """The issue's own sentence: Rh and Th under SMPL's names import badly, and --as easymocap mends it."""
    monkeypatch.chdir(place)
    world = layouts.camera_world()
    np.savez(tmp_path / "em.npz", poses=world.thetas, trans=world.Th, betas=BETAS)
    words = f"import frames {tmp_path}/%s --body SMPL_NEUTRAL.npz --poses {tmp_path}/em.npz"
    words += f" --intrinsics 77 77 24 32 --masks {tmp_path}/masks"
    for k in range(FRAMES):
        mask = view_of(layouts.video_camera(77.0), k).mask
        write_image(tmp_path / "masks" / f"{k:05d}.png", (255 * mask).astype(np.uint8))
    assert exit_code(["rnd-data", *shlex.split(words % "wrong")], monkeypatch) == 1
    assert "EasyMocap's Rh/Th; try --as easymocap" in capsys.readouterr().out
    assert exit_code(["rnd-data", *shlex.split(words % "right"), "--as", "easymocap"], monkeypatch) == 0
