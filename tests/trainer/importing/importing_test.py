"""Every layout of one known scene imports to the same capture."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from rnd_runtime.capture.body import posed_vertices
from rnd_runtime.capture.capture import Capture, load_capture
from rnd_runtime.core.camera import Camera
from rnd_runtime.core.errors import InputError
from rnd_trainer.checking.check import check_capture
from rnd_trainer.checking.silhouette import overlap
from rnd_trainer.importing.importer import find_layout, import_source
from rnd_trainer.importing.layouts import instant_avatar, nerfstudio
from rnd_trainer.importing.options import Choice, ImportOptions
from rnd_trainer.importing.surfaces.estimate import attached
from support import layouts
from support.known_scene import BETAS, FRAMES, HEIGHT, WIDTH, cameras, motion, see, shaped_body

# Measured over all layouts: 3e-7 m, nothing, nothing, cosine 0.99997
PLACE = 1e-6  # m: some layouts store float32, transforms are float32
PIXEL = 1e-9  # of K: nothing but half a pixel is added
COLOUR = 0.5 / 255  # where no lens is undone: as it was
NORMAL = 0.9999  # cosine: 8 bits

# Pictures whose lens is undone, against the definition of k1. Measured: IoU 0.951 (half a pixel off: 0.944, one fifth
# of the bend left: 0.926, all of it: 0.861), mean colour 0.015 (all of the bend left: 0.023)
BENT_MASK = 0.95
BENT_COLOUR = 0.018

EVERYTHING = Choice(held_out_every=1)


def _imported(write: Callable[[Path], None], tmp_path: Path, **options: object) -> Capture:
    source, out = tmp_path / "source", tmp_path / "capture"
    source.mkdir()
    write(source)
    given = {"body": str(layouts.body_file(tmp_path))} | options
    import_source(source, out, ImportOptions(**given))
    return load_capture(out)


def assert_the_scene(capture: Capture, camera_of: Callable[[str, int], str], *, bent: bool, fps: float) -> None:
    """``capture`` is the known scene up to a choice of world; ``camera_of`` (camera, frame) is the scene's camera."""
    assert capture.fps == fps and capture.motion.frame_count == FRAMES
    assert_allclose(capture.body.vertices, shaped_body().vertices, atol=PLACE)
    assert (capture.motion.rotations[:, 0, 1, 1]).mean() > 0.8  # stands upright
    for frame in capture.frames:
        name, camera = camera_of(frame.camera, frame.frame), capture.cameras[frame.camera]
        truth = cameras()[name]
        assert_allclose(camera.K, truth.K, atol=PIXEL)
        theirs = posed_vertices(
            capture.body, capture.motion.rotations[frame.frame], capture.motion.translations[frame.frame]
        )
        ours = posed_vertices(shaped_body(), motion().rotations[frame.frame], motion().translations[frame.frame])
        assert_allclose(_before(camera, theirs), _before(truth, ours), atol=PLACE)
        images, seen = capture.load_frame(frame), see(name, frame.frame)
        if bent:
            straight, mask = _straight(name, frame.frame)
            assert overlap(images.mask > 0.5, mask) > BENT_MASK
            inside = mask & (images.mask > 0.99)
            assert np.abs(images.image_srgb - straight / 255)[inside].mean() < BENT_COLOUR
        else:
            assert ((images.mask > 0.5) == seen.mask).all()
            assert np.abs(images.image_srgb - seen.image / 255)[seen.mask].max() < COLOUR
        assert images.image_srgb[images.mask == 0].max() == 0
        if images.normal is not None:
            known = seen.mask & (np.abs(images.normal).max(-1) > 0)
            assert (known == seen.mask).all()
            assert (images.normal * seen.normals).sum(-1)[known].min() > NORMAL


def _before(camera: Camera, points: np.ndarray) -> np.ndarray:
    """``points`` [n, 3] in the camera's axes."""
    return points @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]


def _straight(name: str, k: int) -> tuple[np.ndarray, np.ndarray]:
    """The bent picture and mask undone by the definition of k1, nearest pixel by nearest pixel."""
    bent, K = see(name, k, layouts.K1), cameras()[name].K
    rows, columns = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    x, y = (columns - K[0, 2]) / K[0, 0], (rows - K[1, 2]) / K[1, 1]
    factor = 1 + layouts.K1 * (x * x + y * y)
    u = np.floor(x * factor * K[0, 0] + K[0, 2]).astype(int).clip(0, WIDTH - 1)
    v = np.floor(y * factor * K[1, 1] + K[1, 2]).astype(int).clip(0, HEIGHT - 1)
    return bent.image[v, u], bent.mask[v, u]


def _either(camera: str, frame: int) -> str:
    """The scene's name of a camera called 00, 01, 1, 2, Camera_B1, …"""
    return {
        "00": "0",
        "01": "1",
        "0000": "0",
        "0001": "1",
        "Camera_B1": "0",
        "Camera_B2": "1",
        "Camera (1)": "0",
        "Camera (2)": "1",
    }[camera]


def _only(camera: str, frame: int) -> str:
    return "0"


def _counted_from_one(camera: str, frame: int) -> str:
    return str(int(camera) - 1)


def _moving(camera: str, frame: int) -> str:
    return layouts.neuman_camera(frame)


ONE_A_MOMENT = (_only, _moving)
"""no other camera to hold out pictures of"""
_prepared, _neuman, _easymocap = layouts.write_intrinsic_avatar, layouts.write_neuman, layouts.write_easymocap
LAYOUTS: dict[str, tuple[str, Callable[[Path], None], Callable[[str, int], str], bool, float]] = {
    # layout, writer, the scene's camera, whether a lens is undone, fps
    "ZJU-MoCap": ("zju", layouts.write_zju, _either, True, 50),
    "ZJU-MoCap refined": ("zju", partial(layouts.write_zju, refined=True), _either, True, 50),
    "ZJU-MoCap, 313": ("zju", partial(layouts.write_zju, early=True), _either, True, 50),
    "ARAH": ("arah", layouts.write_arah, _counted_from_one, True, 50),
    "HumanNeRF": ("humannerf", layouts.write_humannerf, _only, True, 30),
    "PeopleSnapshot": ("snapshot", layouts.write_snapshot, _only, True, 30),
    "InstantAvatar": ("instant-avatar", layouts.write_instant_avatar, _only, False, 30),
    "RANA prepared": ("intrinsic-avatar", partial(_prepared, many=False), _only, False, 30),
    "SyntheticHuman": ("intrinsic-avatar", partial(_prepared, many=True), _either, False, 30),
    "RANA": ("rana", layouts.write_rana, _only, False, 30),
    "NeuMan": ("neuman", _neuman, _moving, False, 30),
    "NeuMan, HUGS": ("neuman", partial(_neuman, hugs=True), _moving, False, 30),
    "nerfstudio": ("nerfstudio", layouts.write_nerfstudio, _either, True, 30),
    "EasyMocap": ("easymocap", _easymocap, _counted_from_one, True, 30),
    "EasyVolcap": ("easymocap", partial(_easymocap, volcap=True), _counted_from_one, True, 30),
}


@pytest.mark.parametrize("name", LAYOUTS)
def test_every_layout_is_the_same_scene(tmp_path, name) -> None:
    layout, write, camera_of, bent, fps = LAYOUTS[name]
    if "NeuMan" in name:
        pytest.importorskip("joblib")
    if name == "PeopleSnapshot":
        pytest.importorskip("h5py")
    choice = Choice() if camera_of in ONE_A_MOMENT else EVERYTHING
    capture = _imported(write, tmp_path, choice=choice)
    assert find_layout(tmp_path / "source")[0] == layout
    assert_the_scene(capture, camera_of, bent=bent, fps=fps)
    report = check_capture(tmp_path / "capture")
    assert not [f for f in report.findings if f.level == "wrong"], report.findings


@pytest.mark.parametrize("name", LAYOUTS)
def test_a_layout_can_be_named_and_not_another(tmp_path, name) -> None:
    layout, write, *_ = LAYOUTS[name]
    if "NeuMan" in name:
        pytest.importorskip("joblib")
    if name == "PeopleSnapshot":
        pytest.importorskip("h5py")
    write(tmp_path)
    assert find_layout(tmp_path, layout) == find_layout(tmp_path)
    other = "arah" if layout != "arah" else "zju"
    with pytest.raises(InputError, match=f"layout: expected {other}"):
        find_layout(tmp_path, other)


def test_a_picture_beside_folders_is_no_video_and_a_capture_no_source(tmp_path) -> None:
    (tmp_path / "00000.png").touch()
    (tmp_path / ".hidden").mkdir()
    assert find_layout(tmp_path)[1] == "a folder of frames"
    (tmp_path / "images").mkdir()
    with pytest.raises(InputError, match="source: expected a known layout"):
        find_layout(tmp_path)
    (tmp_path / "capture.json").touch()
    with pytest.raises(InputError, match="a capture already"):
        find_layout(tmp_path)


def test_a_layout_and_a_root_may_both_be_said(tmp_path) -> None:
    """EasyMocap's Rh and Th under SMPL's names, in a folder that could be frames of a video as well."""
    source = tmp_path / "source"
    source.mkdir()
    layouts.write_nerfstudio(source)
    world = layouts.World(layouts.Z_UP, (0.3, -0.2, 0.1))
    angles = np.concatenate([world.Rh, world.thetas[:, 3:]], 1)
    np.savez(source / "poses.npz", poses=angles, trans=world.Th, betas=BETAS, fps=30)
    (source / "0.png").write_bytes((source / "images" / "0_0.png").read_bytes())
    options = ImportOptions(body=str(layouts.body_file(tmp_path)), layout="nerfstudio,easymocap", choice=EVERYTHING)
    import_source(source, tmp_path / "out", options)
    assert_the_scene(load_capture(tmp_path / "out"), _either, bent=True, fps=30)
    for said in ("nerfstudio,", "nerfstudio,zju", "smpl,easymocap", ",smpl"):
        with pytest.raises(InputError, match="--as: expected a layout, a comma and smpl or easymocap"):
            import_source(source, tmp_path / "more", replace(options, layout=said))


# InstantAvatar's own split of PeopleSnapshot: first and last frame and the step, as its configurations have them
SPLITS = {
    "male-3-casual": ((0, 455, 4), (456, 675, 4)),
    "male-4-casual": ((0, 659, 6), (660, 872, 6)),
    "female-3-casual": ((0, 445, 4), (446, 647, 4)),
    "female-4-casual": ((0, 335, 4), (335, 523, 4)),
}


@pytest.mark.parametrize("subject", SPLITS)
def test_instant_avatars_split_is_kept(tmp_path, subject) -> None:
    """Optimised poses hold one row for each of a split's frames; poses.npz, wrong here, is not used for those."""
    source = tmp_path / subject
    source.mkdir()
    parts = [range(first, last + 1, step) for first, last, step in SPLITS[subject]]
    layouts.write_snapshot_split(source, *parts)
    options = ImportOptions(body=str(layouts.body_file(tmp_path)))
    scene = import_source(source, tmp_path / "capture", options)
    assert any("InstantAvatar's own frames" in note for note in scene.notes)
    capture = load_capture(tmp_path / "capture")
    for split, part in zip(("train", "novel_pose"), parts):
        assert [frame.frame for frame in capture.split(split)] == list(part)
    assert len(capture.frames) == sum(map(len, parts))
    for frame in capture.frames[:: len(capture.frames) // 9]:
        k = frame.frame % FRAMES
        posed = posed_vertices(
            capture.body, capture.motion.rotations[frame.frame], capture.motion.translations[frame.frame]
        )
        truth = posed_vertices(shaped_body(), motion().rotations[k], motion().translations[k])
        assert_allclose(_before(capture.cameras["0"], posed), _before(cameras()["0"], truth), atol=PLACE)
        assert ((capture.load_frame(frame).mask > 0.5) == see("0", k).mask).all()


def test_instant_avatars_subjects_are_known_wherever_one_stands(tmp_path, monkeypatch) -> None:
    """In the folder, by a link to it or by one called so; of any other, optimised poses cannot be used, and a note
    says so."""
    source, other = tmp_path / "female-4-casual", tmp_path / "subject"
    source.mkdir()
    layouts.write_snapshot_split(source, *(range(a, b + 1, step) for a, b, step in SPLITS[source.name]))
    other.symlink_to(source)
    monkeypatch.chdir(source)
    whole = instant_avatar.read(source)
    for place in (Path(), Path("..", source.name), other):
        found = instant_avatar.read(place)
        assert [shot.split for shot in found.shots] == [shot.split for shot in whole.shots]
        assert found.notes == whole.notes and "optimised" in found.notes[0]
    other.unlink()
    source.rename(other)
    found = instant_avatar.read(other)
    assert {shot.split for shot in found.shots} == {None}
    assert len(found.notes) == 1 and "poses/anim_nerf_*.npz are left out" in found.notes[0]
    source.symlink_to(other)
    assert instant_avatar.read(source).notes == whole.notes


def test_masks_of_a_split_are_counted_among_those_of_all_pictures(tmp_path) -> None:
    source = tmp_path / "female-4-casual"
    source.mkdir()
    layouts.write_snapshot_split(source, *(range(a, b + 1, step) for a, b, step in SPLITS[source.name]))
    (tmp_path / "masks").mkdir()
    for k in range(len(list((source / "images").iterdir()))):
        (tmp_path / "masks" / f"{k + 1}.npy").hardlink_to(source / "masks" / f"mask_{k % FRAMES:04d}.npy")
    found = attached(instant_avatar.read(source), tmp_path / "masks", None)
    assert "masks are numbered from 1, frames from 0: taken for the same" in found.notes
    for shot in found.shots[::9]:
        assert ((shot.mask() > 127) == see("0", shot.frame % FRAMES).mask).all()


def test_poses_that_do_not_fill_a_split_are_refused(tmp_path) -> None:
    source = tmp_path / "female-3-casual"
    source.mkdir()
    layouts.write_snapshot_split(source, range(0, 446, 4), range(446, 640, 4))
    with pytest.raises(InputError, match=r"expected 51 in the test split .*, got 49"):
        import_source(source, tmp_path / "out", ImportOptions(body=str(layouts.body_file(tmp_path))))


# ARAH's files, and what is chosen of several cameras


def _arah(tmp_path: Path) -> tuple[Path, Callable[..., str]]:
    """The layout's folder, and what its import is refused with."""
    source = tmp_path / "source"
    source.mkdir()
    layouts.write_arah(source)
    body = str(layouts.body_file(tmp_path))

    def refusal(**options: object) -> str:
        with pytest.raises(InputError) as caught:
            import_source(source, tmp_path / "out", ImportOptions(body=body, **options))
        return str(caught.value)

    return source, refusal


def test_an_arah_camera_without_jpegs_is_named(tmp_path) -> None:
    source, refusal = _arah(tmp_path)
    for picture in (source / "2").glob("*.jpg"):
        picture.unlink()
    assert refusal() == f"{source / '2'}: pictures: expected .jpg or .jpeg files, got none"


@pytest.mark.parametrize("name", ["ARAH", "RANA"])
def test_what_a_source_lacks_is_named(tmp_path, name) -> None:
    write = LAYOUTS[name][1]
    source = tmp_path / "source"
    source.mkdir()
    write(source)
    if name == "ARAH":
        record, lacking = json.loads((source / "cam_params.json").read_text()), "D"
        del record["1"]["D"]
        (source / "cam_params.json").write_text(json.dumps(record))
    else:
        file, lacking = sorted(source.glob("frame_*.json"))[1], "skeleton_0"
        file.write_text(json.dumps({"frame": 1}))
    with pytest.raises(InputError, match=f"'{lacking}'"):
        import_source(source, tmp_path / "out", ImportOptions(body=str(layouts.body_file(tmp_path))))


OTHERS = {
    "transforms.json": ("3", "null", '"frames"', '["frames"]', "{}"),
    "frame_000000.json": (
        "3",
        "[]",
        "{}",
        '{"skeleton_0": null}',
        '{"skeleton_0": "smpl_data"}',
        '{"skeleton_0": ["smpl_data"]}',
    ),
    "cameras.json": ("3", '["intrinsic"]', "null"),
}


@pytest.mark.parametrize(("name", "content"), [(name, text) for name in OTHERS for text in OTHERS[name]])
def test_a_file_that_is_only_called_like_a_layouts_is_none(tmp_path, name, content) -> None:
    (tmp_path / name).write_text(content)
    np.savez(tmp_path / "poses.npz", poses=np.zeros(3))
    with pytest.raises(InputError, match="source: expected a known layout"):
        find_layout(tmp_path)
    (tmp_path / "0.png").touch()
    assert find_layout(tmp_path) == ("video", "a folder of frames")


@pytest.mark.parametrize("content", ["{", "[" * 100_000])
@pytest.mark.parametrize("name", OTHERS)
def test_a_damaged_file_of_a_layout_is_named(tmp_path, name, content) -> None:
    (tmp_path / name).write_text(content)
    np.savez(tmp_path / "poses.npz", poses=np.zeros(3))
    with pytest.raises(InputError, match=f"{name}: cannot be read: expected JSON"):
        find_layout(tmp_path)


@pytest.mark.parametrize("key", ["w", "time_index"])
def test_a_width_or_a_time_that_is_endless_is_refused(tmp_path, key) -> None:
    source = tmp_path / "source"
    source.mkdir()
    layouts.write_nerfstudio(source)
    record = json.loads((source / "transforms.json").read_text())
    record["frames"][0][key] = float("inf")
    (source / "transforms.json").write_text(json.dumps(record))
    with pytest.raises(InputError, match=r"source.*: expected .*, got .*infinity to integer"):
        import_source(source, tmp_path / "out", ImportOptions(body=str(layouts.body_file(tmp_path))))


def test_records_of_another_kind_than_the_first_are_named(tmp_path) -> None:
    source, refusal = _arah(tmp_path)
    (source / "cam_params.json").write_text('["1", "2"]')
    assert refusal() == f"{source / 'cam_params.json'}: cameras: expected a dict by name, got list"
    layouts.write_rana(rana := tmp_path / "rana")
    (rana / "frame_000002.json").write_text("[]")
    with pytest.raises(InputError, match=r"frame_000002\.json: frame 2: smpl_data"):
        import_source(rana, tmp_path / "out", ImportOptions(body=str(layouts.body_file(tmp_path))))


@pytest.mark.parametrize("inner", ["models/shape.npz", "1/cover.jpg"])
def test_an_arah_file_without_a_number_is_named(tmp_path, inner) -> None:
    source, refusal = _arah(tmp_path)
    file = source / inner
    file.write_bytes(next(file.parent.glob(f"*{file.suffix}")).read_bytes())
    assert refusal() == f"{file}: file name: expected a frame number, got {file.name}"


def test_a_training_camera_without_pictures_in_range_is_refused(tmp_path) -> None:
    source, refusal = _arah(tmp_path)
    expected = "--train-camera: expected one with pictures in range: 1 or 2, got 3"
    assert refusal(choice=Choice(train_camera="3")) == expected
    for name, theirs in (("3", "1"), ("2", "2")):  # a third camera; the second missed the first frames
        for picture in (source / theirs).glob("*"):
            if name == "3":
                (source / name).mkdir(exist_ok=True)
                (source / name / picture.name).hardlink_to(picture)
            elif picture.stem < "000002":
                picture.unlink()
    record = json.loads((source / "cam_params.json").read_text())
    record["all_cam_names"].append("3")
    (source / "cam_params.json").write_text(json.dumps(record | {"3": record["1"]}))
    assert refusal(choice=Choice(train_camera="2", stop=2)) == (
        "--train-camera: expected one with pictures in range: 1 or 3, got 2"
    )


# nerfstudio's frames without a time

UNTIMED = {
    # where each picture was taken from, its frame
    "one that moves": ([0, 1, 2, 3, 4, 5], [0, 1, 2, 3, 4, 5]),
    "one that comes to rest": ([0, 1, 2, 3, 4, 4], [0, 1, 2, 3, 4, 5]),
    "one that comes back": ([0, 1, 2, 0, 1, 3], [0, 1, 2, 3, 4, 5]),
    "one that stands": ([0, 0, 0, 0], [0, 1, 2, 3]),
    "two that stand": ([0, 0, 0, 1, 1, 1], [0, 1, 2, 0, 1, 2]),
    "two in turn": ([0, 1, 0, 1, 0, 1], [0, 0, 1, 1, 2, 2]),
}
"""pictures listed backwards, as nerfstudio lists them in any order"""


@pytest.mark.parametrize("name", UNTIMED)
@pytest.mark.parametrize("null", [True, False])
def test_nerfstudios_frames_without_times_are_counted(tmp_path, name, null) -> None:
    places, frames = UNTIMED[name]
    layouts.write_nerfstudio(tmp_path)
    record = json.loads((tmp_path / "transforms.json").read_text())
    entry = record["frames"][0]
    del entry["time_index"]
    record["frames"] = []
    for k, place in reversed(list(enumerate(places))):
        pose = np.array(entry["transform_matrix"])
        pose[0, 3] += place
        more = {"time_index": None} if null else {}
        (tmp_path / f"images/{8 + k}.png").hardlink_to(tmp_path / "images/0_0.png")
        named = {"file_path": f"images/{8 + k}.png", "transform_matrix": pose.tolist()}
        record["frames"].append(entry | more | named)
    (tmp_path / "transforms.json").write_text(json.dumps(record))
    shots = nerfstudio.read(tmp_path).shots
    assert [shot.camera for shot in shots] == [f"{place:04d}" for place in places]
    assert [shot.frame for shot in shots] == frames


def _one_camera(tmp_path: Path, name: str) -> tuple[Path, str]:
    """A layout without a choice between cameras, and why a choice would change nothing."""
    source, why = tmp_path / "female-3-casual", "the pictures' splits are given"
    source.mkdir()
    if name == "a split of its own":
        layouts.write_snapshot_split(source, *(range(a, b + 1, step) for a, b, step in SPLITS[source.name]))
    elif name == "NeuMan":
        pytest.importorskip("joblib")
        layouts.write_neuman(source)
    else:
        layouts.write_rana(source)
        why = "there is one picture a moment: the first 4/5 train, the rest are novel poses"
    return source, why


@pytest.mark.parametrize(
    ("name", "choice", "said"),
    [
        *(
            (name, Choice(held_out_every=2), "--held-out-every: expected the default, got 2")
            for name in ("RANA", "NeuMan", "a split of its own")
        ),
        ("NeuMan", Choice(train_camera="00001"), "--train-camera: expected the default, got 00001"),
        ("a split of its own", Choice(train_camera="1"), "--train-camera: expected the default, got 1"),
    ],
)
def test_a_choice_between_cameras_where_there_is_none_is_refused(tmp_path, name, choice, said) -> None:
    source, why = _one_camera(tmp_path, name)
    body = str(layouts.body_file(tmp_path))
    with pytest.raises(InputError) as caught:
        import_source(source, tmp_path / "out", ImportOptions(body=body, choice=choice))
    assert str(caught.value) == f"{said} ({why})"
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["RANA", "a split of its own"])
def test_the_only_camera_may_be_named(tmp_path, name) -> None:
    """Whether splits are chosen or given."""
    source, _ = _one_camera(tmp_path, name)
    options = ImportOptions(body=str(layouts.body_file(tmp_path)), choice=Choice(train_camera="0"))
    import_source(source, tmp_path / "out", options)
    assert set(load_capture(tmp_path / "out").cameras) == {"0"}
