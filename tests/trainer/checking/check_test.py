"""rnd-data check: a sound capture passes, and every usual mistake is called by its name."""

from __future__ import annotations

import dataclasses
import json
from types import SimpleNamespace

import numpy as np
import pytest

import rnd_trainer.checking.report
from rnd_runtime.capture.capture import load_capture, save_capture
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.images import read_image, write_image
from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_runtime.motion.motion import Motion
from rnd_trainer.checking import hypotheses
from rnd_trainer.checking.check import check_capture
from rnd_trainer.checking.normals import judge, parse_axes
from rnd_trainer.checking.overlay import CAPTION, TILE
from rnd_trainer.checking.report import check_and_report
from rnd_trainer.commands.data import check
from rnd_trainer.training.data import load_views
from support.known_scene import write_true_capture

SOUND = 0.97  # IoU of the silhouette with a mask that the same mesh made: pixels on the edge when scaled


@pytest.fixture
def folder(tmp_path):
    write_true_capture(tmp_path)
    return tmp_path


def _edit(folder, change) -> None:
    """Rewrite capture.json after ``change`` has had its way with it."""
    path = folder / "capture.json"
    record = json.loads(path.read_text())
    change(record)
    path.write_text(json.dumps(record))


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


def test_a_capture_may_be_named_by_its_file(folder, monkeypatch) -> None:
    asked = []
    monkeypatch.setattr(rnd_trainer.checking.report, "check_and_report", lambda *paths: asked.append(paths))
    for place in (folder, folder / "capture.json"):
        check(place)
    assert asked == [(folder, folder / "check"), (folder / "capture.json", folder / "check")]


def test_a_sound_capture_passes(folder) -> None:
    report = check_capture(folder)
    assert not report.wrong, report.findings
    assert len(report.overlaps) == 8 and min(entry.iou for entry in report.overlaps) > SOUND
    assert {finding.subject for finding in report.findings} >= {
        "files",
        "units",
        "cameras",
        "masks",
        "silhouette",
        "normals",
    }


def test_easymocaps_root_taken_for_smpls_is_named(folder) -> None:
    def easymocap(rotations, translations, joint):
        return rotations, translations + joint - rotations[:, 0] @ joint  # Th of the same poses

    _move(folder, easymocap)
    sentence = _wrong(folder)["silhouette"]
    assert "the root rotation looks like EasyMocap's Rh/Th; try --as easymocap" in sentence
    assert sentence.startswith("mean IoU 0.")


MISTAKES = {
    "read as EasyMocap's": lambda r, t, j: (r, t - j + r[:, 0] @ j),
    "the pelvis's place": lambda r, t, j: (r, t + j),
    "root rotation looks transposed": lambda r, t, j: (np.concatenate([r[:, :1].swapaxes(2, 3), r[:, 1:]], 1), t),
    "millimetres": lambda r, t, j: (r, 900 * t),
}


@pytest.mark.parametrize("words", MISTAKES)
def test_mistakes_in_the_root_are_named(folder, words) -> None:
    _move(folder, MISTAKES[words])
    assert words in " ".join(_wrong(folder).values())


def test_a_motion_of_another_up_axis_is_named(folder) -> None:
    quarter = axis_angle_to_matrix([np.pi / 2, 0, 0])

    def lie_down(rotations, translations, joint):
        rotations[:, 0] = quarter @ rotations[:, 0]
        return rotations, (joint + translations) @ quarter.T - joint

    _move(folder, lie_down)
    wrong = _wrong(folder)
    assert "stands along z" in wrong["world"]
    assert "Z up where the cameras are Y up" in wrong["silhouette"]


FLIP = np.diag([1.0, -1, -1, 1])
CAMERAS = {
    "camera-to-world: invert it": np.linalg.inv,
    "cameras look like OpenGL's": lambda m: FLIP @ m,
    "OpenGL's camera-to-world": lambda m: np.linalg.inv(m) @ FLIP,
    "translations look like millimetres": lambda m: m * np.array([[1, 1, 1, 1000]] * 3 + [[1, 1, 1, 1]]),
}


@pytest.mark.parametrize("words", CAMERAS)
def test_mistakes_in_the_cameras_are_named(folder, words) -> None:
    def change(record):
        for camera in record["cameras"].values():
            camera["world_to_camera"] = CAMERAS[words](np.array(camera["world_to_camera"])).tolist()

    _edit(folder, change)
    assert words in _wrong(folder)["silhouette"]


def test_intrinsics_of_another_size_are_named(folder) -> None:
    def change(record):
        for camera in record["cameras"].values():
            camera["K"] = (np.diag([2, 2, 1]) @ camera["K"]).tolist()

    _edit(folder, change)
    assert "twice the size: halve it" in _wrong(folder)["silhouette"]


def test_a_template_in_millimetres_is_named(folder) -> None:
    with np.load(folder / "body.npz") as archive:
        arrays = dict(archive)
    arrays["vertices"], arrays["rest_joints"] = 1000 * arrays["vertices"], 1000 * arrays["rest_joints"]
    np.savez(folder / "body.npz", **arrays)
    assert "millimetres" in _wrong(folder)["units"]


def test_the_flip_of_normals_is_suggested(folder) -> None:
    for path in (folder / "normals").iterdir():
        pixels = read_image(path).astype(int)
        flipped = np.where(
            pixels.any(-1, keepdims=True), np.concatenate([pixels[..., :1], 255 - pixels[..., 1:]], -1), 0
        )
        write_image(path, flipped.astype(np.uint8))
    assert "--normal-axes=x,-y,-z" in _wrong(folder)["normals"]


def test_any_signed_permutation_of_normals_is_found() -> None:
    normals = np.random.default_rng(0).normal(size=(500, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    for text in ("x,y,z", "x,-y,-z", "-z,y,x", "y,x,-z"):
        axes = judge([(normals @ np.linalg.inv(parse_axes(text)).T, normals)])
        assert axes.best_axes == text and axes.best_cosine == pytest.approx(1)
    for text in ("x,y", "x,x,z", "x,y,w", "2x,y,z", ""):
        with pytest.raises(ValueError):
            parse_axes(text)


def test_pictures_of_another_time_are_named(tmp_path) -> None:
    capture = write_true_capture(tmp_path)
    fine = capture.motion.at(np.arange(7) / 60)  # the same motion at 60 per second, frames still counted at 30
    motion = Motion(fine.rotations, fine.translations, capture.fps, capture.motion.joint_names)
    save_capture(dataclasses.replace(capture, motion=motion))
    assert "2 times the rate of the pictures" in _wrong(tmp_path)["timing"]


def test_pictures_one_frame_late_are_named(folder) -> None:
    _move(folder, lambda turns, places, rest: (turns[[0, 0, 1, 2]], places[[0, 0, 1, 2]]))
    assert "the motion looks 1 frame late: picture k shows motion frame k+1" in _wrong(folder)["timing"]


@pytest.mark.parametrize(("gain", "named"), [(0.03, True), (0.015, False)])
def test_another_timing_must_win_two_hundredths(monkeypatch, gain, named) -> None:
    """A frame costs a walker at 30 per second three."""
    sights = [SimpleNamespace(frame=SimpleNamespace(frame=k)) for k in range(8)]
    monkeypatch.setattr(hypotheses, "posed", lambda capture, seen, k: k - seen.frame.frame)
    monkeypatch.setattr(hypotheses, "mean_overlap", lambda seen: 0.9 + gain * all(shift == 1 for shift in seen))
    verdict = hypotheses.explain_timing(SimpleNamespace(motion=SimpleNamespace(frame_count=8)), sights)
    assert (verdict is not None and "1 frame late" in verdict.sentence) is named


def test_a_frame_rate_that_no_body_reaches_is_named(folder) -> None:
    capture = load_capture(folder)
    save_capture(dataclasses.replace(capture, motion=dataclasses.replace(capture.motion, fps=3000.0)))
    assert "frame rate 3000 is too high" in _wrong(folder)["frame rate"]


def test_a_lens_that_was_not_undone_is_named(tmp_path) -> None:
    write_true_capture(tmp_path, k1=-0.4)
    findings = {f.subject: f for f in check_capture(tmp_path).findings}
    assert findings["lens"].level == "note" and "k1 near -0." in findings["lens"].sentence
    for told, words in ((-0.3, "never undone"), (0.3, "undone twice")):
        _edit(tmp_path, lambda record, told=told: record.update({"import": {"distortion": {"0": [told, 0, 0, 0]}}}))
        assert words in _wrong(tmp_path)["lens"]


@pytest.mark.parametrize(
    "told",
    [
        {"turn": "none"},
        {"turn": [1, 0, 0]},
        {"turn": None},
        {"distortion": 5},
        {"distortion": {"0": "none"}},
        {"distortion": {"0": ["none"]}},
        {"normal_axes": "x,-y,-z"},
        {"normal_axes": [["x"]]},
        "by hand",
    ],
    ids=str,
)
def test_an_import_that_somebody_noted_by_hand_is_no_matter(tmp_path, told) -> None:
    """Keys at the top of capture.json are free."""
    write_true_capture(tmp_path, k1=-0.4)
    before = check_capture(tmp_path).findings
    _edit(tmp_path, lambda record: record.update({"import": told}))
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
    """Of the training pictures a fifth may be bad; held-out ones do not weigh them up."""
    _edit(
        folder,
        lambda record: [f.update(split="train" if k < 4 else "novel_pose") for k, f in enumerate(record["frames"])],
    )
    empty = sorted((folder / "masks").iterdir())
    write_image(empty[7], np.zeros_like(read_image(empty[7])))
    assert "masks" not in _wrong(folder)
    write_image(empty[0], np.zeros_like(read_image(empty[0])))
    with pytest.raises(InputError, match="masks: expected at most 20% empty or full, got 1 of 4"):
        load_views(load_capture(folder), "train")
    assert "2 of 8" in _wrong(folder)["masks"]


def test_what_would_not_train_is_named(folder) -> None:
    def relit(record) -> None:
        record["lights"] = {"noon": {"file": "body.npz"}, "dusk": {"file": "body.npz"}}
        for number, frame in enumerate(record["frames"]):
            frame.update(split="train", light=["noon", "dusk"][number % 2])

    _edit(folder, relit)
    wrong = _wrong(folder)
    assert "2 lights (dusk, noon)" in wrong["training"] and "an .exr or .hdr file" in wrong["lights"]
    _edit(folder, lambda record: [frame.update(split="relight") for frame in record["frames"]])
    assert _wrong(folder)["training"].startswith("no picture trains: none of 8")


def test_the_command_prints_writes_and_exits(folder, capsys) -> None:
    assert check_and_report(folder, folder / "out") == 0
    printed = capsys.readouterr().out
    assert "silhouette: mean IoU" in printed and "check.png" in printed
    record = json.loads((folder / "out" / "check.json").read_text())
    assert len(record["frames"]) == 8 and record["mean_iou"] > SOUND
    assert read_image(folder / "out" / "check.png").shape == (2 * 274, 4 * 256, 3)
    _move(folder, MISTAKES["the pelvis's place"])
    assert check_and_report(folder, folder / "out") == 1
    (folder / "capture.json").unlink()
    with pytest.raises(InputError, match="capture not found"):
        check_and_report(folder, folder / "out")


def test_findings_that_cannot_be_saved_are_shown(folder, capsys) -> None:
    (folder / "out").write_text("")
    with pytest.raises(InputError, match="output folder cannot be made"):
        check_and_report(folder, folder / "out")
    assert "silhouette: mean IoU" in capsys.readouterr().out


def test_the_overlay_looks_at_the_person(folder) -> None:
    """A person of 42 pixels in 64 fills the height of a tile, but for the margin on both sides."""
    check_and_report(folder, folder / "out")
    picture = read_image(folder / "out" / "check.png")
    for left in range(0, 4 * TILE, TILE):
        tile = picture[CAPTION : CAPTION + TILE, left : left + TILE]
        rows = np.flatnonzero((tile == 255).all(-1).any(1))
        assert 0.8 * TILE < np.ptp(rows) < 0.95 * TILE


def test_the_overlay_shows_what_differs(folder) -> None:
    """Red where only the mask is, blue where only the template is."""
    _move(folder, lambda r, t, j: (r, t + np.array([0.25, 0, 0])))
    check_and_report(folder, folder / "out")
    picture = read_image(folder / "out" / "check.png").astype(int)
    red = (picture[..., 0] > picture[..., 2] + 90).sum()
    blue = (picture[..., 2] > picture[..., 0] + 90).sum()
    assert red > 300 and blue > 300
