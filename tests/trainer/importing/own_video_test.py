"""Every command of docs/own-video.md, run as written."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from rnd_runtime.capture.capture import load_capture
from rnd_runtime.core.images import write_image
from support import layouts
from support.doc_commands import blocks, exit_code
from support.known_scene import FRAMES, view_of
from support.paths import ROOT
from support.pose_programs import FOCALS, frame_image, write_frames, write_poses, write_wham

pytestmark = pytest.mark.slow
COMMANDS = [
    words
    for block in blocks(ROOT / "docs" / "own-video.md")
    if block.kind == "sh" and block.reason is None
    for words in block.commands()
]
SHORT = ("--steps", "10", "--gaussians", "300")


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A folder with everything that the page's commands name."""
    pytest.importorskip("joblib")
    folder = tmp_path_factory.mktemp("own")
    layouts.body_file(folder).rename(folder / "SMPL_NEUTRAL.npz")
    layouts.write_zju(folder / "CoreView_377")
    write_wham(folder)
    write_frames(folder)
    write_poses(folder)
    wham = layouts.video_camera(FOCALS["wham"])
    (folder / "normals").mkdir()
    for k in range(FRAMES):
        view = view_of(wham, k)
        write_image(folder / "masks" / f"{k:05d}.png", (255 * view.mask).astype(np.uint8))
        np.save(folder / "normals" / f"{k:05d}.npy", (view.normals * [1, -1, -1]).astype(np.float32))
    layouts.write_video(folder / "me.mp4", [frame_image(wham, k) for k in range(FRAMES)])
    return folder


def test_every_command_of_the_page_runs(folder, monkeypatch, capsys) -> None:
    monkeypatch.chdir(folder)
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
    assert len(load_capture(folder / "me").frames) == FRAMES
    splits = {(frame.camera, frame.split) for frame in load_capture(folder / "zju377").frames}
    assert splits == {("Camera_B1", "train"), ("Camera_B1", "novel_pose"), ("Camera_B2", "novel_view")}


def test_every_command_of_the_readme_runs(folder, monkeypatch, capsys) -> None:
    monkeypatch.chdir(folder)
    shutil.copyfile("SMPL_NEUTRAL.npz", "smpl.npz")
    shutil.rmtree("runs", ignore_errors=True)  # the page's
    page = blocks(ROOT / "README.md")
    (block,) = (b for b in page if b.reason and b.reason.startswith("tests/trainer/importing/own_video_test.py"))
    assert [words[0] for words in block.commands()] == ["rnd-data", "rnd-data", "rnd-train"]
    for words in block.commands():
        more = SHORT if words[0] == "rnd-train" else ()
        assert exit_code([*words, *more], monkeypatch) == 0, (words, capsys.readouterr())
    assert (folder / "runs" / "video" / "avatar.ckpt").is_file()
