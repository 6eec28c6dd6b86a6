"""Files of the wrong kind are recognised, and each refusal helps."""

from __future__ import annotations

import numpy as np
import pytest

from rnd_runtime.avatar.avatar import Avatar
from rnd_runtime.capture.body import Body
from rnd_runtime.capture.capture import load_capture
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.kinds import kind_of
from rnd_runtime.motion.motion import load_motion
from rnd_runtime.shading.files.load import load_light
from support.tiny import ASSETS, body


@pytest.fixture(scope="module")
def files(tmp_path_factory, tiny_avatar, tiny_checkpoint, tiny_capture, tiny_run):
    """A path by its kind."""
    folder = tmp_path_factory.mktemp("kinds")
    np.savez(folder / "SMPL.npz", v_template=np.zeros((4, 3)), kintree_table=np.zeros((2, 24)))
    (folder / "clip.mp4").write_bytes(b"\0\0\0 ftypisom")
    (folder / "notes.txt").write_text("hello")
    return {
        "avatar": tiny_avatar,
        "checkpoint": tiny_checkpoint,
        "capture": tiny_capture.folder,
        "run": tiny_run,
        "body": ASSETS / "body.npz",
        "body model": folder / "SMPL.npz",
        "motion": ASSETS / "walk.npz",
        "light": ASSETS / "sky.exr",
        "image": tiny_capture.folder / tiny_capture.frames[0].image,
        "video": folder / "clip.mp4",
        "folder": folder,
        "unknown": folder / "notes.txt",
    }


def test_kinds(files, tmp_path):
    assert {kind: kind_of(path) for kind, path in files.items()} == {kind: kind for kind in files}
    assert kind_of(tmp_path / "nowhere") == kind_of("\0") == "unknown"


@pytest.mark.parametrize("kind", ["avatar", "capture", "body", "motion", "light"])
def test_a_cut_file_of_the_right_kind_keeps_its_readers_line(files, tmp_path, kind):
    path = files[kind] / "capture.json" if kind == "capture" else files[kind]
    cut = tmp_path / path.name
    cut.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(InputError) as caught:
        _readers()[kind](cut)
    assert "got a " not in str(caught.value) and str(cut) in str(caught.value)


@pytest.mark.parametrize(
    ("wanted", "kind", "hint"),
    [
        *[("avatar", "checkpoint", "rnd-export"), ("avatar", "run", "rnd-export"), ("avatar", "motion", "--motion")],
        *[("avatar", "body model", "rnd-train"), ("avatar", "light", "--hdr"), ("avatar", "capture", "rnd-train")],
        *[("motion", "body", "no poses"), ("motion", "body model", "no poses"), ("motion", "capture", "motion.npz")],
        *[("light", "motion", "--motion"), ("light", "image", "radiance"), ("capture", "motion", "rnd-data")],
        *[
            ("capture", "run", "the capture's folder"),
            ("capture", "video", "rnd-data"),
            ("body", "motion", "got a motion"),
        ],
    ],
)
def test_a_refusal_says_what_the_file_is_and_what_helps(files, wanted, kind, hint):
    with pytest.raises(InputError) as caught:
        _readers()[wanted](files[kind])
    line = str(caught.value)
    assert line.startswith(f"{files[kind]}: expected a") and hint in line and "\n" not in line


def _readers():
    return {
        "avatar": Avatar.load,
        "body": Body.load,
        "capture": load_capture,
        "light": load_light,
        "motion": lambda path: load_motion(path, body().skeleton),
    }
