"""Every layout of one known scene imports to the same capture."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from rnd_runtime.core.errors import InputError
from rnd_trainer.checking.check import check_capture
from rnd_trainer.importing.importer import find_layout
from rnd_trainer.importing.layouts import instant_avatar, nerfstudio
from rnd_trainer.importing.options import FrameSelection, ImportOptions
from rnd_trainer.importing.surfaces.files import attach_files
from support import layouts
from support.imported import EVERYTHING, LAYOUTS, POSITION, assert_posed, assert_the_scene, import_scene
from support.known_scene import BETAS, FRAMES, cameras, see


@pytest.mark.parametrize("name", LAYOUTS)
def test_every_layout_is_the_same_scene(tmp_path, name) -> None:
    layout = LAYOUTS[name]
    source = layout.write_into(tmp_path / "source")
    assert find_layout(source)[0] == layout.name
    assert find_layout(source, layout.name) == find_layout(source)
    other = "arah" if layout.name != "arah" else "zju"
    with pytest.raises(InputError, match=f"layout: expected {other}"):
        find_layout(source, other)
    assert_the_scene(import_scene(source, tmp_path / "capture", selection=layout.selection), layout)
    report = check_capture(tmp_path / "capture")
    assert not report.wrong, report.findings


def test_an_image_beside_folders_and_a_capture_are_not_sources(tmp_path) -> None:
    (tmp_path / "00000.png").touch()
    (tmp_path / ".hidden").mkdir()
    assert find_layout(tmp_path)[1] == "a folder of frames"
    (tmp_path / "images").mkdir()
    with pytest.raises(InputError, match="source: expected a known layout"):
        find_layout(tmp_path)
    (tmp_path / "capture.json").touch()
    with pytest.raises(InputError, match="a capture already"):
        find_layout(tmp_path)


def test_layout_and_root_can_be_given(tmp_path) -> None:
    """EasyMocap's Rh and Th under SMPL's names, in a folder that could be frames of a video as well."""
    source = LAYOUTS["nerfstudio"].write_into(tmp_path / "source")
    world = layouts.World(layouts.Z_UP, (0.3, -0.2, 0.1))
    angles = np.concatenate([world.Rh, world.thetas[:, 3:]], 1)
    np.savez(source / "poses.npz", poses=angles, trans=world.Th, betas=BETAS, fps=30)
    (source / "0.png").write_bytes((source / "images" / "0_0.png").read_bytes())
    options = {"layout": "nerfstudio", "root": "easymocap", "selection": EVERYTHING}
    assert_the_scene(import_scene(source, tmp_path / "out", **options), LAYOUTS["nerfstudio"])


# InstantAvatar's own split of PeopleSnapshot: first and last frame and the step, as its configurations have them
SPLITS = {
    "male-3-casual": ((0, 455, 4), (456, 675, 4)),
    "male-4-casual": ((0, 659, 6), (660, 872, 6)),
    "female-3-casual": ((0, 445, 4), (446, 647, 4)),
    "female-4-casual": ((0, 335, 4), (335, 523, 4)),
}


def _write_split(folder: Path) -> list[range]:
    """A subject of InstantAvatar's in ``folder``; the frames of its training and test split."""
    folder.mkdir()
    parts = [range(first, last + 1, step) for first, last, step in SPLITS[folder.name]]
    layouts.write_snapshot_split(folder, *parts)
    return parts


@pytest.mark.parametrize("subject", SPLITS)
def test_instant_avatars_split_is_kept(tmp_path, subject) -> None:
    """Optimised poses hold one row for each frame of a split; poses.npz, wrong here, is not used."""
    parts = _write_split(tmp_path / subject)
    capture = import_scene(tmp_path / subject, tmp_path / "capture")
    for split, part in zip(("train", "novel_pose"), parts):
        assert [frame.frame for frame in capture.split(split)] == list(part)
    assert len(capture.frames) == sum(map(len, parts))
    for frame in capture.frames[:: len(capture.frames) // 9]:
        k = frame.frame % FRAMES
        assert_posed(capture, frame, cameras()["0"], k, POSITION)
        assert ((capture.load_frame(frame).mask > 0.5) == see("0", k).mask).all()


def test_instant_avatars_subjects_are_known_by_any_path(tmp_path, monkeypatch) -> None:
    """Optimised poses of other folders cannot be used, which is noted."""
    source, other = tmp_path / "female-4-casual", tmp_path / "subject"
    _write_split(source)
    other.symlink_to(source)
    monkeypatch.chdir(source)
    whole = instant_avatar.read(source)
    assert "optimised" in whole.notes[0]
    for path in (Path(), Path("..", source.name), other):
        found = instant_avatar.read(path)
        assert [sample.split for sample in found.samples] == [sample.split for sample in whole.samples]
    other.unlink()
    source.rename(other)
    found = instant_avatar.read(other)
    assert {sample.split for sample in found.samples} == {None} and "are left out" in found.notes[0]
    source.symlink_to(other)
    assert instant_avatar.read(source).notes == whole.notes


def test_masks_of_a_split_are_counted_among_all_images(tmp_path) -> None:
    source = tmp_path / "female-4-casual"
    _write_split(source)
    (tmp_path / "masks").mkdir()
    for k in range(len(list((source / "images").iterdir()))):
        (tmp_path / "masks" / f"{k + 1}.npy").hardlink_to(source / "masks" / f"mask_{k % FRAMES:04d}.npy")
    found = attach_files(instant_avatar.read(source), ImportOptions(masks=tmp_path / "masks"))
    assert "masks are numbered from 1, frames from 0: taken for the same" in found.notes
    for sample in found.samples[::9]:
        assert ((sample.mask() > 127) == see("0", sample.frame % FRAMES).mask).all()


# Damaged sources


def _without_jpegs(source: Path) -> None:
    for image in (source / "2").glob("*.jpg"):
        image.unlink()


def _without_distortion(source: Path) -> None:
    record = json.loads((source / "cam_params.json").read_text())
    del record["1"]["D"]
    (source / "cam_params.json").write_text(json.dumps(record))


def _copy(source: Path, name: str) -> None:
    file = source / name
    file.write_bytes(next(file.parent.glob(f"*{file.suffix}")).read_bytes())


def _endless(source: Path, key: str) -> None:
    record = json.loads((source / "transforms.json").read_text())
    record["frames"][0][key] = float("inf")
    (source / "transforms.json").write_text(json.dumps(record))


DAMAGED = {
    # layout, damage, words of the refusal
    "no JPEGs": ("ARAH", _without_jpegs, ("2: images", ".jpg")),
    "a key": ("ARAH", _without_distortion, ("source", "'D'")),
    "cameras in a list": ("ARAH", lambda s: (s / "cam_params.json").write_text("[]"), ("cam_params.json", "list")),
    "a model's number": ("ARAH", lambda s: _copy(s, "models/shape.npz"), ("shape.npz", "a frame number")),
    "an image's number": ("ARAH", lambda s: _copy(s, "1/cover.jpg"), ("cover.jpg", "a frame number")),
    "RANA's person": ("RANA", lambda s: (s / "frame_000002.json").write_text("[]"), ("frame_000002.json", "frame 2")),
    "RANA's skeleton": ("RANA", lambda s: (s / "frame_000001.json").write_text("{}"), ("'skeleton_0'",)),
    "no frames": ("nerfstudio", lambda s: (s / "transforms.json").write_text('{"frames": []}'), ("frames", "list")),
    "an endless width": ("nerfstudio", lambda s: _endless(s, "w"), ("source", "infinity")),
    "an endless time": ("nerfstudio", lambda s: _endless(s, "time_index"), ("source", "infinity")),
}


@pytest.mark.parametrize("name", DAMAGED)
def test_missing_parts_of_a_source_are_named(tmp_path, name) -> None:
    layout, damage, words = DAMAGED[name]
    source = LAYOUTS[layout].write_into(tmp_path / "source")
    damage(source)
    with pytest.raises(InputError) as caught:
        import_scene(source, tmp_path / "out")
    message = str(caught.value)
    assert "\n" not in message and all(word in message for word in words), message


OTHERS = {
    "transforms.json": ("3", '["frames"]', "{}"),
    "frame_000000.json": ("[]", "{}", '{"skeleton_0": null}', '{"skeleton_0": "smpl_data"}'),
    "cameras.json": ('["intrinsic"]', "null"),
}


@pytest.mark.parametrize(("name", "content"), [(name, text) for name in OTHERS for text in OTHERS[name]])
def test_json_of_other_programs_is_not_a_layout(tmp_path, name, content) -> None:
    (tmp_path / name).write_text(content)
    np.savez(tmp_path / "poses.npz", poses=np.zeros(3))
    with pytest.raises(InputError, match="source: expected a known layout"):
        find_layout(tmp_path)
    (tmp_path / "0.png").touch()
    assert find_layout(tmp_path) == ("video", "a folder of frames")
    for damaged in ("{", "[" * 100_000):
        (tmp_path / name).write_text(damaged)
        with pytest.raises(InputError, match=f"{name}: cannot be read"):
            find_layout(tmp_path)


def test_a_training_camera_needs_images_in_range(tmp_path) -> None:
    source = LAYOUTS["ARAH"].write_into(tmp_path / "source")
    for image in (source / "2").glob("*"):
        if image.stem < "000002":
            image.unlink()
    for camera in ("3", "2"):
        with pytest.raises(InputError, match="--train-camera: expected one with images in range: 1, got"):
            import_scene(source, tmp_path / "out", selection=FrameSelection(train_camera=camera, stop=2))


# nerfstudio's frames without a time

UNTIMED = {
    # camera position of each image, its frame
    "one that moves": ([0, 1, 2, 3, 4, 5], [0, 1, 2, 3, 4, 5]),
    "one that comes back": ([0, 1, 2, 0, 1, 3], [0, 1, 2, 3, 4, 5]),
    "one that stands": ([0, 0, 0, 0], [0, 1, 2, 3]),
    "two that stand": ([0, 0, 0, 1, 1, 1], [0, 1, 2, 0, 1, 2]),
    "two alternating": ([0, 1, 0, 1, 0, 1], [0, 0, 1, 1, 2, 2]),
}
"""images are listed backwards, as nerfstudio lists them in any order"""


@pytest.mark.parametrize("name", UNTIMED)
def test_nerfstudios_frames_without_times_are_counted(tmp_path, name) -> None:
    positions, frames = UNTIMED[name]
    layouts.write_nerfstudio(tmp_path)
    record = json.loads((tmp_path / "transforms.json").read_text())
    entry = record["frames"][0] | {"time_index": None}
    record["frames"] = []
    for k, position in reversed(list(enumerate(positions))):
        pose = np.array(entry["transform_matrix"])
        pose[0, 3] += position
        (tmp_path / f"images/{8 + k}.png").hardlink_to(tmp_path / "images/0_0.png")
        record["frames"].append(entry | {"file_path": f"images/{8 + k}.png", "transform_matrix": pose.tolist()})
    (tmp_path / "transforms.json").write_text(json.dumps(record))
    samples = nerfstudio.read(tmp_path).samples
    assert [sample.camera for sample in samples] == [f"{position:04d}" for position in positions]
    assert [sample.frame for sample in samples] == frames


@pytest.mark.parametrize(
    ("name", "selection"),
    [
        ("RANA", FrameSelection(held_out_every=2)),
        ("NeuMan", FrameSelection(train_camera="00001")),
        ("female-3-casual", FrameSelection(train_camera="1")),
    ],
)
def test_a_choice_between_cameras_needs_several(tmp_path, name, selection) -> None:
    """Of a single camera its own name is allowed, whether splits are chosen or given."""
    source = tmp_path / name
    if name in SPLITS:
        _write_split(source)
    else:
        LAYOUTS[name].write_into(source)
    with pytest.raises(InputError, match=r"--(held-out-every|train-camera): expected the default, got"):
        import_scene(source, tmp_path / "out", selection=selection)
    assert not (tmp_path / "out").exists()
    if name != "NeuMan":
        capture = import_scene(source, tmp_path / "out", selection=FrameSelection(train_camera="0"))
        assert set(capture.cameras) == {"0"}
