"""Writing of a placed data set as a capture: images on black, masks, normals, albedos."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rnd_runtime.capture.capture import Capture, Frame, save_capture
from rnd_runtime.core.camera import Camera
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import output_folder
from rnd_runtime.core.images import linear_to_srgb, srgb_to_linear, to_bytes, write_image
from rnd_runtime.core.threads import ahead

from .dataset import ImportedDataset, Sample
from .images import Bytes, check_size
from .options import OnProgress, no_progress
from .scene import PlacedScene
from .surfaces.masks import Floats32, bounding_box, colour_around, share_of_person

_TO_LINEAR: Floats32 = srgb_to_linear(np.arange(256) / 255).astype(np.float32)
_COVERED = 0.98  # coverage above which a pixel shows the person alone
_REACH = 2.5  # pixels, a quarter of the distance from which colours are taken


def write_capture(
    folder: Path,
    dataset: ImportedDataset,
    scene: PlacedScene,
    samples: Sequence[Sample],
    on_progress: OnProgress = no_progress,
    *,
    normal_axes: NDArray[np.float64] | None = None,
) -> None:
    """Write ``samples`` of an undistorted ``dataset`` in ``scene`` as a capture.

    ``normal_axes`` [3, 3] is the permutation applied to the normals, for ``rnd-data check``.
    """
    output_folder(folder)
    first = int(dataset.poses.frames[0])
    read = (_maps(sample, scene.cameras[sample.camera]) for sample in samples)
    frames = []
    for frame in ahead(partial(_write_sample, folder, first), samples, read):
        frames.append(frame)
        on_progress("writing images", len(frames), len(samples))
    used = {name: scene.cameras[name] for name in dict.fromkeys(frame.camera for frame in frames)}
    undone = {name: list(lens.undone) for name in used if any((lens := dataset.lenses[name]).undone)}
    notes = {"kind": dataset.kind, "notes": scene.notes, "distortion": undone, "turn": scene.rotation.tolist()}
    if normal_axes is not None:
        notes["normal_axes"] = normal_axes.tolist()
    capture = Capture(folder, used, {}, scene.body, scene.motion, tuple(frames))
    save_capture(capture, **{"import": notes})


def _maps(sample: Sample, camera: Camera) -> dict[str, NDArray[Any]]:
    """The sample's image, mask and what else it has, of the camera's size."""
    if sample.mask is None:
        raise InputError("mask", expected="one for every image", got="none", frame=sample.frame)
    read = {"image": sample.image, "mask": sample.mask, "normals": sample.normals, "albedo": sample.albedo}
    try:
        return {what: check_size(pixels(), camera, what) for what, pixels in read.items() if pixels is not None}
    except InputError as error:
        raise error.at(frame=sample.frame) from error


def _write_sample(folder: Path, first: int, sample: Sample, maps: dict[str, NDArray[Any]]) -> Frame:
    name = f"{sample.camera}_{sample.frame:06d}.png".replace(" ", "_").replace("/", "_")
    mask, normals, albedo = maps["mask"], maps.get("normals"), maps.get("albedo")
    write_image(folder / "images" / name, premultiplied(maps["image"], mask))
    write_image(folder / "masks" / name, mask)
    if albedo is not None:
        write_image(folder / "albedo_estimates" / name, premultiplied(albedo, mask))
    if normals is not None:
        length = np.linalg.norm(normals, axis=-1, keepdims=True)
        known = (length > 0.1) & (mask[..., None] > 0)
        unit = normals / np.where(known, length, 1)
        write_image(folder / "normals" / name, np.where(known, to_bytes((unit + 1) / 2), 0).astype(np.uint8))
    assert sample.split is not None
    normal = None if normals is None else f"normals/{name}"
    estimate = None if albedo is None else f"albedo_estimates/{name}"
    files, number = (f"images/{name}", f"masks/{name}"), sample.frame - first
    return Frame(*files, sample.camera, number, sample.split, normal=normal, albedo_estimate=estimate)


def premultiplied(image_srgb: Bytes, mask: Bytes) -> Bytes:
    """``image_srgb`` [H, W, 3] on black, multiplied by the coverage ``mask`` [H, W] in linear space."""
    result = np.zeros_like(image_srgb)
    if mask.any():
        window = bounding_box(mask > 0, 0)
        coverage = np.asarray(mask[window] / 255, np.float32)
        linear = _without_background(_TO_LINEAR[image_srgb[window]], coverage)
        result[window] = to_bytes(linear_to_srgb(linear * coverage[..., None]))
    return result


def _without_background(linear: Floats32, coverage: Floats32) -> Floats32:
    """``linear`` [H, W, 3] with the background's share taken out of a soft outline's pixels.

    That share is measured between the colours of person and background nearby, and at most what ``coverage`` leaves.
    The more there is, the more the person's colour nearby takes its place: what remains is the codec's noise.
    """
    least = cv2.erode(np.where(coverage > 0, coverage, np.float32(1)), np.ones((3, 3), np.uint8))  # of soft edges alone
    if least.min() == 1:
        return linear
    person, known = colour_around(linear, (coverage > 0) & (least > _COVERED), _REACH)
    behind, seen = colour_around(linear, coverage == 0, _REACH)
    edge = (least < 1) & (known > 0) & (seen > 0)
    mixed, person, behind = linear[edge], person[edge], behind[edge]
    taken = np.minimum(1 - share_of_person(mixed, person, behind), 1 - least[edge])
    share = np.maximum(taken, 0)[:, None]
    own = mixed + share * (person - behind)
    result = linear.copy()
    result[edge] = own + share * (person - own)
    return result
