"""rnd-data check: a correct capture passes, usual mistakes are named."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from rnd_runtime.capture.capture import load_capture, save_capture
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.images import read_image, write_image
from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_runtime.motion.motion import Motion
from rnd_trainer.checking.check import check_capture
from rnd_trainer.checking.normals import compare_axes, parse_axes
from rnd_trainer.checking.overlay import CAPTION, TILE
from rnd_trainer.checking.report import check_and_report
from rnd_trainer.commands import data as data_cli
from rnd_trainer.training.data import load_views
from support.known_scene import write_true_capture

SOUND = 0.97  # IoU of the silhouette with a mask of the same mesh: scaled edge pixels differ


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    return write_true_capture(tmp_path_factory.mktemp("sound")).folder


@pytest.fixture
def folder(tmp_path):
    write_true_capture(tmp_path)
    return tmp_path


def _edit(folder, change) -> None:
    """Apply ``change`` to capture.json."""
    path = folder / "capture.json"
    record = json.loads(path.read_text())
    change(record)
    path.write_text(json.dumps(record))


def _edit_cameras(folder, key: str, change) -> None:
    def edit(record):
        for camera in record["cameras"].values():
            camera[key] = change(np.array(camera[key])).tolist()

    _edit(folder, edit)


def _move(folder, change) -> None:
    """Save the capture with its motion changed."""
    capture = load_capture(folder)
    rotations, translations = capture.motion.rotations.copy(), capture.motion.translations.copy()
    rotations, translations = change(rotations, translations, capture.body.skeleton.rest_joints[0])
    motion = Motion(rotations, translations, capture.fps, capture.motion.joint_names)
    save_capture(dataclasses.replace(capture, motion=motion))


def _wrong(folder) -> dict[str, str]:
    """Subject and sentence of everything that is wrong."""
    return {f.subject: f.sentence for f in check_capture(folder).findings if f.level == "wrong"}


def test_a_correct_capture_passes(sound) -> None:
    report = check_capture(sound)
    assert not report.wrong, report.findings
    assert len(report.ious) == 8 and min(entry.iou for entry in report.ious) > SOUND
    subjects = {finding.subject for finding in report.findings}
    assert subjects >= {"files", "units", "cameras", "masks", "silhouette", "normals"}


FLIP = np.diag([1.0, -1, -1, 1])
QUARTER = axis_angle_to_matrix([np.pi / 2, 0, 0])
MILLIMETRES = np.array([[1, 1, 1, 1000]] * 3 + [[1, 1, 1, 1]])


def _lying(rotations, translations, joint):
    rotations[:, 0] = QUARTER @ rotations[:, 0]
    return rotations, (joint + translations) @ QUARTER.T - joint


MISTAKES = {
    # subject, words, change of the capture
    "Th for trans": (
        "silhouette",
        "EasyMocap's Rh/Th; try --root easymocap",
        lambda f: _move(f, lambda r, t, j: (r, t + j - r[:, 0] @ j)),
    ),
    "trans for Th": ("silhouette", "try --root smpl", lambda f: _move(f, lambda r, t, j: (r, t - j + r[:, 0] @ j))),
    "pelvis": ("silhouette", "pelvis position", lambda f: _move(f, lambda r, t, j: (r, t + j))),
    "transposed": (
        "silhouette",
        "root rotation looks transposed",
        lambda f: _move(f, lambda r, t, j: (np.concatenate([r[:, :1].swapaxes(2, 3), r[:, 1:]], 1), t)),
    ),
    "trans in mm": ("silhouette", "millimetres", lambda f: _move(f, lambda r, t, j: (r, 900 * t))),
    "Z up": ("silhouette", "Z up where the cameras are Y up", lambda f: _move(f, _lying)),
    "lying": ("world", "stands along z", lambda f: _move(f, _lying)),
    "camera-to-world": ("silhouette", "invert it", lambda f: _edit_cameras(f, "world_to_camera", np.linalg.inv)),
    "OpenGL": (
        "silhouette",
        "cameras look like OpenGL's",
        lambda f: _edit_cameras(f, "world_to_camera", lambda m: FLIP @ m),
    ),
    "OpenGL inverted": (
        "silhouette",
        "OpenGL's camera-to-world",
        lambda f: _edit_cameras(f, "world_to_camera", lambda m: np.linalg.inv(m) @ FLIP),
    ),
    "cameras in mm": (
        "silhouette",
        "translations look like millimetres",
        lambda f: _edit_cameras(f, "world_to_camera", lambda m: m * MILLIMETRES),
    ),
    "K": ("silhouette", "twice the size: halve it", lambda f: _edit_cameras(f, "K", lambda K: np.diag([2, 2, 1]) @ K)),
    "late": (
        "timing",
        "1 frame late: image k shows motion frame k+1",
        lambda f: _move(f, lambda r, t, j: (r[[0, 0, 1, 2]], t[[0, 0, 1, 2]])),
    ),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_every_usual_mistake_is_named(folder, name) -> None:
    subject, words, change = MISTAKES[name]
    change(folder)
    assert words in _wrong(folder)[subject]


def test_a_template_in_millimetres_is_named(folder) -> None:
    with np.load(folder / "body.npz") as archive:
        arrays = dict(archive)
    arrays["vertices"], arrays["rest_joints"] = 1000 * arrays["vertices"], 1000 * arrays["rest_joints"]
    np.savez(folder / "body.npz", **arrays)
    assert "millimetres" in _wrong(folder)["units"]


def test_the_axes_of_normals_are_suggested(folder) -> None:
    for path in (folder / "normals").iterdir():
        pixels = read_image(path).astype(int)
        flipped = np.concatenate([pixels[..., :1], 255 - pixels[..., 1:]], -1)
        write_image(path, np.where(pixels.any(-1, keepdims=True), flipped, 0).astype(np.uint8))
    assert "--normal-axes=x,-y,-z" in _wrong(folder)["normals"]


def test_any_signed_permutation_of_normals_is_found() -> None:
    normals = np.random.default_rng(0).normal(size=(500, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    for text in ("x,y,z", "x,-y,-z", "-z,y,x", "y,x,-z"):
        axes = compare_axes([(normals @ np.linalg.inv(parse_axes(text)).T, normals)])
        assert axes.best_axes == text and axes.best_cosine == pytest.approx(1)
    for text in ("x,y", "x,x,z", "x,y,w", "2x,y,z", ""):
        with pytest.raises(ValueError):
            parse_axes(text)


def test_frame_rates_of_another_motion_are_named(folder) -> None:
    capture = load_capture(folder)
    fine = capture.motion.at(np.arange(7) / 60)  # the same motion at 60 per second, frames still counted at 30
    motion = Motion(fine.rotations, fine.translations, capture.fps, capture.motion.joint_names)
    save_capture(dataclasses.replace(capture, motion=motion))
    assert "2 times the rate of the images" in _wrong(folder)["timing"]
    save_capture(dataclasses.replace(capture, motion=dataclasses.replace(capture.motion, fps=3000.0)))
    assert "frame rate 3000 is too high" in _wrong(folder)["frame rate"]


def test_a_distorted_lens_is_explained_by_the_imports_notes(tmp_path) -> None:
    """Other notes in capture.json have no effect."""
    write_true_capture(tmp_path, k1=-0.4)
    before = check_capture(tmp_path).findings
    found = {f.subject: f for f in before}
    assert found["lens"].level == "note" and "k1 near -0." in found["lens"].sentence
    for k1, words in ((-0.3, "never undone"), (0.3, "undone twice")):
        _edit(tmp_path, lambda record, k1=k1: record.update({"import": {"distortion": {"0": [k1, 0, 0, 0]}}}))
        assert words in _wrong(tmp_path)["lens"]
    for note in ({"turn": "none"}, {"distortion": {"0": ["none"]}}, {"normal_axes": "x,-y,-z"}, "by hand"):
        _edit(tmp_path, lambda record, note=note: record.update({"import": note}))
        assert check_capture(tmp_path).findings == before


def test_bad_masks_and_backgrounds_are_counted(folder) -> None:
    for path in sorted((folder / "masks").iterdir())[:2]:
        write_image(path, read_image(path) // 255)  # 0 and 1
    bright = next((folder / "images").iterdir())
    write_image(bright, np.maximum(read_image(bright), 40))
    findings = {f.subject: f for f in check_capture(folder).findings}
    assert findings["masks"].level == "wrong" and "2 of 8" in findings["masks"].sentence
    assert "they look like 0 and 1" in findings["masks"].sentence
    assert findings["background"].level == "note" and bright.name in findings["background"].sentence


def test_masks_are_counted_as_a_training_counts_them(folder) -> None:
    """A fifth of the training images may be bad; held-out ones do not count."""

    def split(record) -> None:
        for k, frame in enumerate(record["frames"]):
            frame.update(split="train" if k < 4 else "novel_pose")

    _edit(folder, split)
    files = sorted((folder / "masks").iterdir())
    write_image(files[7], np.zeros_like(read_image(files[7])))
    assert "masks" not in _wrong(folder)
    write_image(files[0], np.zeros_like(read_image(files[0])))
    with pytest.raises(InputError, match="masks: expected at most 20% empty or full, got 1 of 4"):
        load_views(load_capture(folder), "train")
    assert "2 of 8" in _wrong(folder)["masks"]


def test_lights_without_maps_are_named_and_wrong_captures_too(folder) -> None:
    def relit(record) -> None:
        record["lights"] = {"noon": {"file": "body.npz"}, "dusk": {}}
        for number, frame in enumerate(record["frames"]):
            frame.update(split="train", light=["noon", "dusk"][number % 2])

    _edit(folder, relit)
    findings = {f.subject: f for f in check_capture(folder).findings}
    assert findings["training"].level == "ok" and "2 lights (noon, dusk)" in findings["training"].sentence
    assert findings["lights"].level == "wrong" and "body.npz" in findings["lights"].sentence
    with pytest.raises(InputError, match="light: expected one with a map, got dusk"):
        load_capture(folder).load_light("dusk")
    _edit(folder, lambda record: [frame.update(split="relight") for frame in record["frames"]])
    assert _wrong(folder)["training"].startswith("none of 8 images")


def test_the_command_prints_writes_and_exits(folder, tmp_path, capsys) -> None:
    def check(*words: object) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as ended:
            data_cli.main(["check", *map(str, words)])
        printed = capsys.readouterr()
        return int(ended.value.code or 0), printed.out, printed.err

    for capture in (folder, folder / "capture.json"):
        code, printed, _ = check(capture)
        assert code == 0 and "silhouette: mean IoU" in printed and "next: rnd-train" in printed
    record = json.loads((folder / "check" / "check.json").read_text())
    assert len(record["frames"]) == 8 and record["mean_iou"] > SOUND
    assert read_image(folder / "check" / "check.png").shape == (2 * 274, 4 * 256, 3)
    (folder / "out").write_text("")
    code, printed, error = check(folder, "--out", folder / "out")
    assert code == 2 and "silhouette: mean IoU" in printed and "output folder cannot be made" in error
    assert check(folder, "--quiet") == (0, f"{folder / 'check' / 'check.png'}\n", "")
    _move(folder, lambda r, t, j: (r, t + j))
    assert check(folder)[0] == 1
    (folder / "capture.json").unlink()
    assert check(folder)[0] == 2


def test_the_overlay_shows_the_person_and_the_differences(folder) -> None:
    """Close up, the mask alone in red, the template alone in blue."""
    check_and_report(folder, folder / "out")
    image = read_image(folder / "out" / "check.png")
    for left in range(0, 4 * TILE, TILE):
        tile = image[CAPTION : CAPTION + TILE, left : left + TILE]
        rows = np.flatnonzero((tile == 255).all(-1).any(1))
        assert 0.8 * TILE < np.ptp(rows) < 0.95 * TILE  # 42 of 64 pixels before
    _move(folder, lambda r, t, j: (r, t + np.array([0.25, 0, 0])))
    check_and_report(folder, folder / "out")
    image = read_image(folder / "out" / "check.png").astype(int)
    assert (image[..., 0] > image[..., 2] + 90).sum() > 300
    assert (image[..., 2] > image[..., 0] + 90).sum() > 300


INVERTED = Path(__file__).parents[2] / "cases/masks_inverted"


def _invert(folder) -> None:
    for file in (folder / "masks").iterdir():
        write_image(file, 255 - read_image(file))


def test_inverted_masks_are_the_first_explanation(folder) -> None:
    assert "the masks look inverted: invert them (mean IoU 1.00 then)" in _wrong(INVERTED)["silhouette"]
    _invert(folder)
    assert "the masks look inverted" in _wrong(folder)["silhouette"]


def test_of_inverted_masks_and_wrong_cameras_no_cause_is_named(folder) -> None:
    """Nothing that is tried reaches an IoU of 0.4."""
    _invert(folder)
    _edit_cameras(folder, "world_to_camera", lambda m: np.linalg.inv(m) @ FLIP)
    assert "for no usual reason" in _wrong(folder)["silhouette"]
