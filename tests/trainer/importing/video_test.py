"""A video, or a folder of its frames, with body poses becomes a capture."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest

from rnd_runtime.capture.capture import load_capture
from rnd_runtime.core.camera import Camera
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.images import write_image
from rnd_runtime.motion.motion import Motion, load_motion, save_motion
from rnd_trainer.checking.check import check_capture
from rnd_trainer.checking.silhouette import mask_iou
from rnd_trainer.importing.importer import find_layout, import_source
from rnd_trainer.importing.options import FrameSelection, ImportOptions
from support import layouts
from support.imported import assert_posed, import_scene
from support.known_scene import FRAMES, HEIGHT, WIDTH, motion, shaped_body, view_of
from support.pose_programs import (
    FOCALS,
    INTRINSICS,
    LENS,
    write_easymocap_folder,
    write_film,
    write_frames,
    write_gvhmr,
    write_phalp,
    write_poses,
    write_romp,
    write_romp_video,
    write_wham,
)

ATOL = 2e-5  # m: float32 in the files and in bone transforms
ROUGH = 0.7  # IoU of a made mask at 48×64 pixels, where limbs are two wide
ROMP = layouts.video_camera(FOCALS["romp"])
FAR = 52.0  # m: distance that PHALP's long lens adds for an image of the same size
REST = shaped_body().skeleton.rest_joints[0]
FILMED: dict[str, tuple[Callable[[Path], Path], float, float, Callable[[Path], Path], tuple[float, ...]]] = {
    # writer, focal length, metres farther away, the body's writer, what the user has to add
    "wham": (write_wham, FOCALS["wham"], 0.0, layouts.body_file, ()),
    "gvhmr": (partial(write_gvhmr, rest=REST), FOCALS["gvhmr"], 0.0, layouts.smplx_body_file, ()),
    "phalp": (partial(write_phalp, push=FAR), FOCALS["phalp"], FAR, layouts.body_file, ()),
    "romp": (write_romp, FOCALS["romp"], 0.0, layouts.body_file, ()),
    "easymocap": (write_easymocap_folder, 77.0, 0.0, layouts.body_file, INTRINSICS),
}


@pytest.mark.parametrize("program", FILMED)
def test_a_video_becomes_a_capture(tmp_path, program) -> None:
    write, focal, far, write_body, intrinsics = FILMED[program]
    truth = layouts.video_camera(focal)
    truth.world_to_camera[2, 3] += far
    write_frames(tmp_path, truth)
    film = write_film(tmp_path, truth)
    (tmp_path / "normals").mkdir()
    for k in range(FRAMES):
        normals = view_of(truth, k).normals * [1, -1, -1]  # right, up, to the viewer
        np.save(tmp_path / "normals" / f"{k:05d}.npy", normals.astype(np.float32))
    assert find_layout(film) == ("video", "a video")
    options = ImportOptions(
        body=str(write_body(tmp_path)),
        poses=write(tmp_path),
        intrinsics=intrinsics,
        masks=tmp_path / "masks",
        normals=tmp_path / "normals",
    )
    scene = import_source(film, tmp_path / "out", options)
    assert any("up, towards the viewer" in note for note in scene.notes)
    capture = load_capture(tmp_path / "out")
    assert capture.fps == 25 and [f.split for f in capture.frames] == ["train"] * 3 + ["novel_pose"]
    for frame in capture.frames:
        np.testing.assert_allclose(capture.cameras["0"].K, truth.K, rtol=1e-6)  # GVHMR stores float32
        assert_posed(capture, frame, truth, frame.frame, ATOL)
        images, view = capture.load_frame(frame), view_of(truth, frame.frame)
        assert ((images.mask > 0.5) == view.mask).all()
        known = view.mask & (np.abs(images.normal).max(-1) > 0)
        assert (known == view.mask).all()
        facing = known & (view.normals[..., 2] < 0)  # at the rim, smooth normals may face away: stored at 90°
        assert (images.normal * view.normals).sum(-1)[facing].min() > 0.999
    report = check_capture(tmp_path / "out")
    assert not report.wrong, report.findings


def test_poses_of_our_own_body_are_read_as_the_players_read_them(tmp_path) -> None:
    """``save_motion``'s: ``trans`` is from the body's own pelvis, as its joints' names tell."""
    body, axes = shaped_body(), LENS.world_to_camera
    rotations, rest = motion().rotations.copy(), body.skeleton.rest_joints[0]
    rotations[:, 0] = axes[:3, :3] @ rotations[:, 0]
    shifts = (rest + motion().translations) @ axes[:3, :3].T + axes[:3, 3] - rest
    body.save(tmp_path / "body.npz")
    poses = tmp_path / "poses.npz"
    save_motion(poses, Motion(rotations, shifts, 25.0, body.skeleton.names))
    np.testing.assert_allclose(load_motion(poses, body.skeleton).translations, shifts, atol=ATOL)
    frames = write_frames(tmp_path)
    notes = _import(tmp_path, frames, poses, body=str(tmp_path / "body.npz"), intrinsics=INTRINSICS)
    assert not [note for note in notes if "pelvis" in note]
    _assert_together(tmp_path, LENS, WHOLE, FRAMES)
    assert check_capture(tmp_path / "out").mean_iou > 0.95


PAIRED = {
    # number of each image → pose of the scene, number of each pose file → pose of the scene, images kept, noted
    "ffmpeg's, both from 1": ({1: 0, 2: 1, 3: 2, 4: 3}, {1: 0, 2: 1, 3: 2, 4: 3}, 4, ""),
    "no person in some": ({8: 0, 9: 1, 10: 2, 11: 3}, {9: 1, 11: 3}, 2, ""),
    "each lacks one": ({1: 0, 2: 1, 4: 3}, {2: 1, 3: 2, 4: 3}, 2, ""),
    "poses from 0": ({1: 0, 2: 1, 3: 2, 4: 3}, {0: 0, 1: 1, 2: 2, 3: 3}, 4, "from 0, frames from 1"),
    "poses from 0, one missing": ({1: 0, 2: 1, 3: 2, 4: 3}, {0: 0, 2: 2}, 2, "from 0, frames from 1"),
    "images from 0": ({0: 0, 1: 1, 2: 2, 3: 3}, {1: 0, 2: 1, 4: 3}, 3, "from 1, frames from 0"),
    "a part, poses from 0": ({51: 0, 52: 1, 53: 2, 54: 3}, {0: 0, 1: 1, 2: 2, 3: 3}, 4, "from 0, frames from 51"),
}
WHOLE = {k: k for k in range(FRAMES)}


def _fits(folder: Path, numbers: dict[int, int]) -> Path:
    """ROMP's files of the scene's poses, by number."""
    written = write_romp(folder)
    (folder / "fits").mkdir()
    for number, k in numbers.items():
        (folder / "fits" / f"{number:05d}.npz").hardlink_to(written / f"{k:08d}.npz")
    return folder / "fits"


def _import(folder: Path, source: Path, poses: Path, **more: object) -> list[str]:
    """Import ``source`` into out/; the notes."""
    options = {"body": str(layouts.body_file(folder)), "poses": poses, "masks": folder / "masks"} | more
    return import_source(source, folder / "out", ImportOptions(**options)).notes


def _assert_together(folder: Path, camera: Camera, pose_of: dict[int, int], count: int) -> None:
    """The capture in out/ shows and poses the scene's poses, by the numbers in its images' names."""
    capture = load_capture(folder / "out")
    assert len(capture.frames) == count
    for frame in capture.frames:
        k = pose_of[int(Path(frame.image).stem.split("_")[1])]
        assert ((capture.load_frame(frame).mask > 0.5) == view_of(camera, k).mask).all()
        assert_posed(capture, frame, camera, k, ATOL)


@pytest.mark.parametrize("name", PAIRED)
def test_numbered_images_and_poses_are_paired_by_number(tmp_path, name) -> None:
    images, poses, kept, noted = PAIRED[name]
    source = write_frames(tmp_path, ROMP, {f"f{number}": k for number, k in images.items()})
    notes = [note for note in _import(tmp_path, source, _fits(tmp_path, poses)) if "taken for the same" in note]
    assert len(notes) == bool(noted) and noted in "".join(notes)
    _assert_together(tmp_path, ROMP, images, kept)


@pytest.mark.parametrize("write", [write_wham, write_romp_video])
def test_poses_in_one_file_belong_to_the_images_in_their_order(tmp_path, write) -> None:
    """Whatever the images' first number."""
    camera = layouts.video_camera(FOCALS[write.__name__.split("_")[1]])
    source = write_frames(tmp_path, camera, {f"{k + 1:05d}": k for k in range(FRAMES)})
    _import(tmp_path, source, write(tmp_path))
    _assert_together(tmp_path, camera, WHOLE, FRAMES)


@pytest.mark.parametrize("film", [True, False])
def test_numbered_poses_of_frames_without_numbers_may_count_from_one(tmp_path, film) -> None:
    source = write_frames(tmp_path, ROMP, {f"f{k}{'' if film else 'x'}": k for k in range(FRAMES)})
    poses = _fits(tmp_path, {k + 1: k for k in range(FRAMES)})
    notes = _import(tmp_path, write_film(tmp_path, ROMP) if film else source, poses)
    assert any("from 1, frames from 0" in note for note in notes)
    _assert_together(tmp_path, ROMP, WHOLE, FRAMES)


@pytest.mark.parametrize(
    ("count", "fps", "noted"),
    [
        (FRAMES, 25.1, ""),
        (8, 50, "poses end with frame 7, images with frame 3"),
        (8, 50, "poses have 50 frames per second, images 25"),
        (3, 25, "poses end with frame 2, images with frame 3"),
    ],
)
def test_another_rate_or_count_of_poses_is_noted(tmp_path, count, fps, noted) -> None:
    poses = write_poses(tmp_path, np.arange(count) % FRAMES, fps=fps)
    notes = _import(tmp_path, write_film(tmp_path), poses, masks=None, intrinsics=INTRINSICS)
    found = [note for note in notes if "poses end" in note or "per second" in note]
    assert noted in " ".join(found) and bool(found) == bool(noted)


def test_poses_of_other_frames_and_numbers_that_count_none_are_refused(tmp_path) -> None:
    source = write_frames(tmp_path, ROMP, {"f1": 0, "f2": 1, "f3": 2})
    with pytest.raises(InputError, match=r"frames: body poses: expected some of frames 1 … 3, got 7 … 8"):
        _import(tmp_path, source, _fits(tmp_path, {7: 0, 8: 1}))
    microseconds = {1767225600000000: 0, 1767225600033333: 1, 1767225600066666: 2, 1767229200000000: 3}
    (later := tmp_path / "later").mkdir()
    source = write_frames(later, ROMP, {str(time): k for time, k in microseconds.items()})
    with pytest.raises(InputError, match="frames of the poses: expected at most 100000 missing, got 3599999997 "):
        _import(later, source, _fits(later, microseconds))


def test_missing_masks_are_estimated(tmp_path) -> None:
    camera = ROMP.resized(4 * WIDTH, 4 * HEIGHT)
    notes = _import(tmp_path, write_film(tmp_path, camera), write_romp(tmp_path), masks=None)
    assert any("masks made from the template" in note and "rough" in note for note in notes)
    capture = load_capture(tmp_path / "out")
    for frame in capture.frames:
        assert mask_iou(capture.load_frame(frame).mask > 0.5, view_of(camera, frame.frame).mask) > ROUGH


def test_the_sharpest_frame_of_a_pose_is_kept(tmp_path) -> None:
    """Ten frames of two alternating poses, one sharp image of each: those two are chosen."""
    poses, sharp = [0, 3, 0, 3, 0, 3, 0, 3, 0, 3], {4, 5}
    write_frames(tmp_path, ROMP, {f"{k:03d}": pose for k, pose in enumerate(poses)})
    cloth = np.random.default_rng(0).integers(0, 80, (HEIGHT, WIDTH, 1))
    for k, pose in enumerate(poses):
        image = np.where(view_of(ROMP, pose).mask[..., None], 100 + cloth, 90).repeat(3, 2).astype(np.uint8)
        blurred = image if k in sharp else cv2.GaussianBlur(image, (0, 0), 2.0)
        write_image(tmp_path / "frames" / f"{k:03d}.png", blurred)
    K = (ROMP.K[0, 0], ROMP.K[1, 1], WIDTH / 2, HEIGHT / 2)
    _import(tmp_path, tmp_path / "frames", write_poses(tmp_path, poses), intrinsics=K, count=2)
    capture = load_capture(tmp_path / "out")
    assert {f.frame for f in capture.frames if f.split == "train"} == sharp


@pytest.mark.parametrize(
    ("selection", "frames"),
    [
        (FrameSelection(start=1), {1: "train", 2: "train", 3: "novel_pose"}),
        (FrameSelection(stop=3), {0: "train", 1: "train", 2: "novel_pose"}),
        (FrameSelection(every=3), {0: "train", 3: "novel_pose"}),
    ],
)
def test_splits_are_of_the_selected_frames(tmp_path, selection, frames) -> None:
    source = write_frames(tmp_path)
    poses = write_poses(tmp_path)
    _import(tmp_path, source, poses, intrinsics=INTRINSICS, selection=selection)
    assert {frame.frame: frame.split for frame in load_capture(tmp_path / "out").frames} == frames


def test_missing_options_of_a_video_are_named(tmp_path) -> None:
    film, poses = write_film(tmp_path), write_poses(tmp_path)

    def refusal(source: Path = film, **options: object) -> str:
        with pytest.raises(InputError) as caught:
            import_scene(source, tmp_path / "out", **options)
        assert "\n" not in str(caught.value) and not (tmp_path / "out").exists()
        return str(caught.value)

    assert "--body" in refusal(body=None)
    assert "--poses" in refusal()
    assert "--intrinsics" in refusal(poses=poses)
    assert "source not found" in refusal(tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    assert "known layout" in refusal(tmp_path / "empty")
    assert "--as: expected zju" in refusal(layout="zoo")
    (tmp_path / "cut.mp4").write_bytes(film.read_bytes()[:300])
    assert "cut.mp4" in refusal(tmp_path / "cut.mp4", poses=poses)
