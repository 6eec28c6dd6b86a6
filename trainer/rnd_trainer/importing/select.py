"""Selection of frames: splits of a data set's samples, and the sharpest frame of each pose of a video."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from rnd_runtime.capture.format import TRAIN_SHARE
from rnd_runtime.core.errors import InputError, refuse_changed
from rnd_runtime.motion.motion import Motion
from rnd_runtime.motion.skeleton import Skeleton

from .dataset import ImportedDataset, Sample
from .options import FrameSelection


def select_samples(dataset: ImportedDataset, selection: FrameSelection) -> list[Sample]:
    """Samples that ``selection`` keeps, each with its split.

    Samples keep the split that they have. Otherwise the first 4/5 of the training camera's frames train and its last
    1/5 are novel poses; every ``held_out_every``-th frame of other cameras is a novel view, or there a novel pose.

    Raises:
        InputError: no sample left, no image of the training camera, or camera options without effect.
    """
    first, last = int(dataset.poses.frames[0]), int(dataset.poses.frames[-1])
    selected = [sample for sample in dataset.samples if first <= sample.frame <= last and selection.keeps(sample.frame)]
    if not selected:
        raise InputError("images", expected=f"some in the {last - first + 1} frames that have poses", got="none")
    cameras = list(dict.fromkeys(sample.camera for sample in selected))
    if all(sample.split is not None for sample in selected):
        refuse_cameras(selection, cameras, "the images' splits are given")
        return selected
    single = len({sample.frame for sample in selected}) == len(selected)  # one camera, which may move
    camera = selection.train_camera or selected[0].camera
    if camera not in cameras:
        known = " or ".join(cameras[:8])
        raise InputError("--train-camera", expected=f"one with images in range: {known}", got=camera)
    if single:
        why = "there is one image a frame: the first 4/5 train, the rest are novel poses"
        refuse_cameras(selection, cameras, why)
    train = sorted(sample.frame for sample in selected if single or sample.camera == camera)
    border = train[max(0, round(TRAIN_SHARE * len(train)) - 1)]
    order = {frame: k for k, frame in enumerate(sorted({sample.frame for sample in selected}))}
    result = []
    for sample in selected:
        early = sample.frame <= border
        if single or sample.camera == camera:
            result.append(replace(sample, split="train" if early else "novel_pose"))
        elif order[sample.frame] % selection.held_out_every == 0:
            result.append(replace(sample, split="novel_view" if early else "novel_pose"))
    return result


def refuse_cameras(selection: FrameSelection, cameras: Sequence[str], why: str) -> None:
    """Refuse camera options without effect; the name of the only camera is allowed."""
    if [selection.train_camera] == list(cameras):
        selection = replace(selection, train_camera=None)
    refuse_changed(selection, ("train_camera", "held_out_every"), why)


def sharpness(image: NDArray[np.uint8], mask: NDArray[np.uint8] | None = None) -> float:
    """Sharpness of ``image`` [H, W, 3] on ``mask`` [H, W]; larger is sharper.

    Mean square of the Laplacian over the variance of the grey image.

    Source: Pertuz et al. 2013, Analysis of focus measure operators.
    """
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    inside = np.ones(grey.shape, bool) if mask is None else cv2.erode(mask, np.ones((5, 5), np.uint8)) > 127
    if not inside.any():
        return 0.0
    return float((cv2.Laplacian(grey, cv2.CV_32F)[inside] ** 2).mean() / (grey[inside].var() + 1))


def select_frames(
    motion: Motion, skeleton: Skeleton, sharpnesses: NDArray[np.float64], count: int
) -> NDArray[np.int64]:
    """Ascending indices of at most ``count`` frames: the sharpest frame of each of the most different poses.

    Poses are compared by joint positions about the root. Bins are the Voronoi cells of the farthest-point sample that
    starts at the first frame.

    Args:
        motion: F poses of ``skeleton``.
        sharpnesses: [F], larger is sharper; −inf for frames to leave out.
        count: at least 1.

    Source: Gonzalez 1985, Clustering to minimize the maximum intercluster distance.
    """
    if sharpnesses.shape != (motion.frame_count,) or count < 1:
        expected = f"{motion.frame_count} sharpnesses, at least 1 of them"
        raise InputError("frames to select from", expected=expected, got=f"{sharpnesses.shape}, {count}")
    usable = np.flatnonzero(sharpnesses > -np.inf)
    if len(usable) <= count:
        return usable
    joints = skeleton.joint_transforms(motion.rotations[usable], np.zeros(3))[..., :3, 3]
    features = (joints - joints[:, :1]).reshape(len(usable), -1)
    distances = np.full(len(usable), np.inf)
    bins, newest = np.zeros(len(usable), np.int64), 0
    for number in range(count):
        to_newest = np.linalg.norm(features - features[newest], axis=1)
        nearer = to_newest < distances
        distances[nearer], bins[nearer] = to_newest[nearer], number
        newest = int(distances.argmax())
    indices = (np.flatnonzero(bins == number) for number in range(count))
    return np.sort(usable[[part[sharpnesses[usable[part]].argmax()] for part in indices if len(part)]])
