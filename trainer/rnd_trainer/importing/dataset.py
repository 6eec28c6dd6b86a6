"""Data set as read from its layout: lenses, samples and body poses in the source's world."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.capture.format import Split
from rnd_runtime.core.camera import Camera

from .images import Bytes, check_size, undistort_image
from .poses import Poses


@dataclass(frozen=True, eq=False)
class Lens:
    """A calibrated camera of a source."""

    camera: Camera  # pixel centres at +0.5, metres, in the source's world
    distortion: tuple[float, ...] = ()  # OpenCV's k1 k2 p1 p2 [k3 …]; empty for undistorted images
    undone: tuple[float, ...] = ()  # coefficients removed by ``undistort_dataset``


@dataclass(frozen=True, eq=False)
class Sample:
    """One image with its labels, read on demand."""

    camera: str  # name of the lens
    frame: int  # number of the frame in ``Poses``
    image: Callable[[], Bytes]  # [H, W, 3] uint8 sRGB
    mask: Callable[[], Bytes] | None = None  # [H, W] uint8 coverage
    normals: Callable[[], NDArray[np.float32]] | None = None  # [H, W, 3] OpenCV camera axes, zero where unknown
    albedo: Callable[[], Bytes] | None = None  # [H, W, 3] uint8 sRGB, estimated; black where unknown
    split: Split | None = None  # None: chosen by ``select_samples``
    name: str = ""  # stem of the image file; empty for a video's frame


@dataclass(frozen=True, eq=False)
class ImportedDataset:
    """A source as read."""

    kind: str  # name of the format
    lenses: dict[str, Lens]  # by camera name
    samples: Sequence[Sample]
    poses: Poses
    fps: float = 30.0
    notes: tuple[str, ...] = ()  # assumptions, one sentence each
    image_names: Mapping[int, str] = field(default_factory=dict)  # by frame, of all images if ``samples`` is a subset


def undistort_dataset(dataset: ImportedDataset) -> ImportedDataset:
    """``dataset`` with images, masks, normals and albedos undistorted on reading."""

    def undistort(read: Callable[[], NDArray] | None, lens: Lens, what: str) -> Callable[[], NDArray] | None:
        if read is None:
            return None
        return lambda: undistort_image(check_size(read(), lens.camera, what), lens.camera, lens.distortion)

    samples = []
    for sample in dataset.samples:
        lens = dataset.lenses[sample.camera]
        if any(lens.distortion):
            image = undistort(sample.image, lens, "image")
            assert image is not None
            mask, normals = undistort(sample.mask, lens, "mask"), undistort(sample.normals, lens, "normals")
            albedo = undistort(sample.albedo, lens, "albedo")
            sample = replace(sample, image=image, mask=mask, normals=normals, albedo=albedo)
        samples.append(sample)
    lenses = {name: Lens(lens.camera, (), lens.distortion) for name, lens in dataset.lenses.items()}
    return replace(dataset, lenses=lenses, samples=samples)
