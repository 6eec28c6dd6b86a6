"""What ``rnd-bench study filmed`` scores on: exact poses and other cameras, in the imported capture's world."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rnd_bench.lifter.pose2sim import Calibrated
from rnd_bench.studies.film_truth import WHAM_PA_MM, _placed, exact_poses, in_capture_of, wham_like
from rnd_bench.studies.filmed import EXACT, METHODS, WHAM, Film
from rnd_bench.studies.video import LIMBS, pa_mm
from rnd_runtime.capture.capture import Capture
from rnd_runtime.core.camera import Camera
from rnd_runtime.core.errors import InputError
from support.tiny import motion, write_capture

TURN = Rotation.from_euler("xyz", [0.2, 1.1, -0.3]).as_matrix()


def _pixels(capture: Capture, camera: str, frame: int) -> np.ndarray:
    """Where the joints [J, 2] of a capture's frame are in the image of a camera."""
    view, motion = capture.cameras[camera], capture.motion
    joints = capture.body.skeleton.joint_transforms(motion.rotations[frame], motion.translations[frame])[:, :3, 3]
    seen = joints @ view.world_to_camera[:3, :3].T + view.world_to_camera[:3, 3]
    return (seen @ view.K.T)[:, :2] / seen[:, 2:]


@pytest.fixture
def truth(tmp_path: Path) -> Capture:
    return write_capture(tmp_path / "truth")


@pytest.fixture
def imported(truth: Capture) -> Capture:
    """As if of a video of the truth's training frames: one camera, in another world, and no pose of the truth's."""
    name = truth.split("train")[0].camera
    frames = [msgspec.structs.replace(f, frame=k, camera="0") for k, f in enumerate(truth.split("train"))]
    moved = np.eye(4)
    moved[:3, :3], moved[:3, 3] = TURN, (0.4, -1.0, 2.0)
    motion = truth.motion
    motion = replace(
        motion, rotations=motion.rotations[: len(frames)], translations=motion.translations[: len(frames)] + 9
    )
    return replace(truth, cameras={"0": truth.cameras[name].in_frame(moved)}, motion=motion, frames=tuple(frames))


def test_truth_looks_the_same_from_its_cameras_in_the_imported_world(truth, imported) -> None:
    scored = in_capture_of(truth, imported, ("novel_view", "train"))
    assert {frame.split for frame in scored.frames} == {"novel_view", "train"}
    assert all(frame.light is None for frame in scored.frames)
    for frame in scored.frames:
        expected = _pixels(truth, frame.camera, frame.frame)
        np.testing.assert_allclose(_pixels(scored, frame.camera, frame.frame), expected, atol=1e-6)
    assert not np.allclose(scored.motion.translations, truth.motion.translations, atol=0.1)


def test_exact_poses_fit_the_imported_camera(truth, imported) -> None:
    exact = exact_poses(truth, imported)
    name = truth.split("train")[0].camera
    for mine, frame in zip(exact.frames, truth.split("train")):
        np.testing.assert_allclose(_pixels(exact, "0", mine.frame), _pixels(truth, name, frame.frame), atol=1e-6)


def test_a_video_that_misses_frames_has_no_exact_poses(truth, imported) -> None:
    motion = imported.motion
    short = replace(motion, rotations=motion.rotations[1:], translations=motion.translations[1:])
    with pytest.raises(InputError, match="the person in all"):
        exact_poses(truth, replace(imported, motion=short))


def test_noise_is_as_large_and_as_smooth_as_whams_errors(truth) -> None:
    capture = replace(truth, motion=motion(truth.body, 60))
    noisy = wham_like(capture)
    skeleton = capture.body.skeleton
    index = [skeleton.names.index(name) for name in LIMBS]
    joints, moved = (
        skeleton.joint_transforms(one.rotations, one.translations)[:, index][..., :3, 3]
        for one in (capture.motion, noisy.motion)
    )
    assert pa_mm(moved, joints) == pytest.approx(WHAM_PA_MM, rel=0.01)
    acceleration = np.diff(moved - joints, 2, axis=0) * capture.motion.fps**2
    assert 5 < np.linalg.norm(acceleration, axis=-1).mean() < 9  # m/s²


def test_another_camera_stands_where_it_was_in_a_world_of_another_size() -> None:
    K = np.array([[900.0, 0, 300], [0, 900, 400], [0, 0, 1]])
    here = Calibrated(TURN, np.array([0.1, 0.2, 3.0]), K, np.zeros(4))
    other = Calibrated(TURN.T, np.array([-0.3, 0.0, 4.0]), K, np.zeros(4))
    own = SimpleNamespace(
        world_to_camera=Camera.look_at([1, 2, 3], [0, 1, 0], width=8, height=8, fov_y=1).world_to_camera
    )
    size, point = 1.07, np.array([0.2, -0.1, 0.3])
    seen_here = here.rotation @ point + here.translation
    inside = np.linalg.inv(own.world_to_camera) @ [*(size * seen_here), 1]  # as one camera finds it
    camera = _placed(other, here, size, own, (600, 800))  # type: ignore[arg-type]
    found = (camera.world_to_camera @ inside)[:3]
    np.testing.assert_allclose(found, size * (other.rotation @ point + other.translation), atol=1e-9)


def test_a_film_is_trained_by_the_methods_that_are_for_it(truth, imported) -> None:
    every = (*METHODS, EXACT, WHAM)
    assert Film("rendered", imported, truth, truth).methods(every) == [*METHODS, EXACT]
    assert Film("cam01", imported, truth).methods(every) == [*METHODS, WHAM]
    assert Film("cam03", imported, truth).methods((WHAM,)) == []
