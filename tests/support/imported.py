"""Imports of the known scene: each layout's writer, and what each has to come out as."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.ndimage import binary_erosion

from rnd_runtime.capture.body import posed_vertices
from rnd_runtime.capture.capture import Capture, Frame, load_capture
from rnd_runtime.core.camera import Camera
from rnd_trainer.checking.silhouette import mask_iou
from rnd_trainer.importing.importer import import_source
from rnd_trainer.importing.options import FrameSelection, ImportOptions
from support import layouts
from support.known_scene import FRAMES, HEIGHT, WIDTH, cameras, motion, see, shaped_body

# Measured over all layouts: 3e-7 m, 0, 0, cosine 0.99997
POSITION = 1e-6  # m: some layouts store float32, transforms are float32
PIXEL = 1e-9  # of K
COLOUR = 0.5 / 255  # of undistorted sources
NORMAL = 0.9999  # cosine: 8 bits
# Of undistorted lenses, against the definition of k1: IoU 0.951 (half a pixel off: 0.944, a fifth of the distortion
# left: 0.926, all of it: 0.861), mean colour 0.015 (all of the distortion left: 0.023)
UNDISTORTED_IOU = 0.95
UNDISTORTED_COLOUR = 0.018

EVERYTHING = FrameSelection(held_out_every=1)


class Layout(NamedTuple):
    """A writer of the scene; ``camera_of`` (camera, frame) is the scene's camera, None for one image a frame."""

    name: str
    write: Callable[[Path], None]
    camera_of: Callable[[str, int], str] | None
    distorted: bool
    fps: float
    package: str = ""

    @property
    def selection(self) -> FrameSelection:
        return FrameSelection() if self.camera_of is None else EVERYTHING

    def write_into(self, folder: Path) -> Path:
        """``folder``, made, with the scene."""
        if self.package:
            pytest.importorskip(self.package)
        folder.mkdir(exist_ok=True)
        self.write(folder)
        return folder


_NAMES = {"00": "0", "01": "1", "0000": "0", "0001": "1", "Camera_B1": "0", "Camera_B2": "1"}
_NAMES |= {"Camera (1)": "0", "Camera (2)": "1"}


def _from_zero(camera: str, frame: int) -> str:
    return _NAMES[camera]


def _from_one(camera: str, frame: int) -> str:
    return str(int(camera) - 1)


_prepared, _neuman, _easymocap = layouts.write_intrinsic_avatar, layouts.write_neuman, layouts.write_easymocap
LAYOUTS: dict[str, Layout] = {
    "ZJU-MoCap": Layout("zju", layouts.write_zju, _from_zero, True, 50),
    "ZJU-MoCap refined": Layout("zju", partial(layouts.write_zju, refined=True), _from_zero, True, 50),
    "ZJU-MoCap, 313": Layout("zju", partial(layouts.write_zju, early=True), _from_zero, True, 50),
    "ARAH": Layout("arah", layouts.write_arah, _from_one, True, 50),
    "HumanNeRF": Layout("humannerf", layouts.write_humannerf, None, True, 30),
    "PeopleSnapshot": Layout("snapshot", layouts.write_snapshot, None, True, 30, "h5py"),
    "InstantAvatar": Layout("instant-avatar", layouts.write_instant_avatar, None, False, 30),
    "RANA prepared": Layout("intrinsic-avatar", partial(_prepared, many=False), None, False, 30),
    "SyntheticHuman": Layout("intrinsic-avatar", partial(_prepared, many=True), _from_zero, False, 30),
    "RANA": Layout("rana", layouts.write_rana, None, False, 30),
    "NeuMan": Layout("neuman", _neuman, None, False, 30, "joblib"),
    "NeuMan, HUGS": Layout("neuman", partial(_neuman, hugs=True), None, False, 30, "joblib"),
    "nerfstudio": Layout("nerfstudio", layouts.write_nerfstudio, _from_zero, True, 30),
    "EasyMocap": Layout("easymocap", _easymocap, _from_one, True, 30),
    "EasyVolcap": Layout("easymocap", partial(_easymocap, volcap=True), _from_one, True, 30),
}


def import_scene(source: Path, out: Path, **options: object) -> Capture:
    """The capture that ``source`` is imported as into ``out``."""
    given = {"body": str(layouts.body_file(out.parent))} | options
    import_source(source, out, ImportOptions(**given))
    return load_capture(out)


def assert_the_scene(capture: Capture, layout: Layout) -> None:
    """``capture`` is the known scene up to a choice of world."""
    assert capture.fps == layout.fps and capture.motion.frame_count == FRAMES
    assert_allclose(capture.body.vertices, shaped_body().vertices, atol=POSITION)
    assert (capture.motion.rotations[:, 0, 1, 1]).mean() > 0.8  # stands upright
    for frame in capture.frames:
        moving = layouts.neuman_camera(frame.frame) if layout.name == "neuman" else "0"
        name = layout.camera_of(frame.camera, frame.frame) if layout.camera_of else moving
        assert_allclose(capture.cameras[frame.camera].K, cameras()[name].K, atol=PIXEL)
        assert_posed(capture, frame, cameras()[name], frame.frame, POSITION)
        images, truth = capture.load_frame(frame), see(name, frame.frame)
        if layout.distorted:
            straight, mask = _undistorted(name, frame.frame)
            assert mask_iou(images.mask > 0.5, mask) > UNDISTORTED_IOU
            inside = mask & binary_erosion(images.mask > 0.99, np.ones((3, 3)))  # a soft outline's are unmixed
            assert np.abs(images.image_srgb - straight / 255)[inside].mean() < UNDISTORTED_COLOUR
        else:
            assert ((images.mask > 0.5) == truth.mask).all()
            assert np.abs(images.image_srgb - truth.image / 255)[truth.mask].max() < COLOUR
        assert images.image_srgb[images.mask == 0].max() == 0
        if images.normal is not None:
            known = truth.mask & (np.abs(images.normal).max(-1) > 0)
            assert (known == truth.mask).all()
            assert (images.normal * truth.normals).sum(-1)[known].min() > NORMAL


def assert_posed(capture: Capture, frame: Frame, camera: Camera, k: int, atol: float) -> None:
    """``capture``'s body at ``frame`` is, in camera axes, the scene's in pose ``k`` before ``camera``."""
    moved = capture.motion
    ours = posed_vertices(capture.body, moved.rotations[frame.frame], moved.translations[frame.frame])
    truth = posed_vertices(shaped_body(), motion().rotations[k], motion().translations[k])
    assert_allclose(_in_camera(capture.cameras[frame.camera], ours), _in_camera(camera, truth), atol=atol)


def _in_camera(camera: Camera, points: np.ndarray) -> np.ndarray:
    return points @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]


def _undistorted(name: str, k: int) -> tuple[np.ndarray, np.ndarray]:
    """The distorted image and mask undone by the definition of k1, nearest pixel by nearest pixel."""
    truth, K = see(name, k, layouts.K1), cameras()[name].K
    rows, columns = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    x, y = (columns - K[0, 2]) / K[0, 0], (rows - K[1, 2]) / K[1, 1]
    factor = 1 + layouts.K1 * (x * x + y * y)
    u = np.floor(x * factor * K[0, 0] + K[0, 2]).astype(int).clip(0, WIDTH - 1)
    v = np.floor(y * factor * K[1, 1] + K[1, 2]).astype(int).clip(0, HEIGHT - 1)
    return truth.image[v, u], truth.mask[v, u]
