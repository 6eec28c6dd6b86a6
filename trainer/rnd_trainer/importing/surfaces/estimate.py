"""Estimated masks, normals and albedos."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.capture.body import posed_vertices
from rnd_runtime.core.errors import InputError
from rnd_trainer.checking.normals import parse_axes
from rnd_trainer.checking.silhouette import RenderedMesh, render_mesh
from rnd_trainer.importing.dataset import ImportedDataset, Sample
from rnd_trainer.importing.images import Bytes
from rnd_trainer.importing.options import ImportOptions, OnProgress, no_progress
from rnd_trainer.importing.scene import PlacedScene

from .albedo import albedo_map, albedo_network
from .masks import make_masks
from .networks import ImageNetwork
from .normals import Normals, fill_holes, find_axes, normal_map, normal_network, to_opencv

_AXIS_FRAMES = 8


class _Lazy(Sequence[Any]):
    """A sequence computed entry by entry on demand."""

    def __init__(self, entries: Sequence[Any], compute: Callable[[Any], Any]) -> None:
        self.entries, self.compute = entries, compute

    def __len__(self) -> int:
        return len(self.entries)

    def __getitem__(self, index: Any) -> Any:
        return self.compute(self.entries[index])


def _template(sample: Sample, scene: PlacedScene, dataset: ImportedDataset) -> RenderedMesh:
    k = sample.frame - int(dataset.poses.frames[0])
    vertices = posed_vertices(scene.body, scene.motion.rotations[k], scene.motion.translations[k])
    return render_mesh(vertices, scene.body.faces, scene.cameras[sample.camera])


def add_masks(
    samples: list[Sample],
    scene: PlacedScene,
    dataset: ImportedDataset,
    net: Path | None,
    on_progress: OnProgress = no_progress,
) -> list[Sample]:
    """``samples`` with estimated masks, for samples without one or by the network ``net`` for all."""
    missing = [k for k, sample in enumerate(samples) if sample.mask is None or net is not None]
    made: dict[int, Bytes] = {}
    for camera in dict.fromkeys(samples[k].camera for k in missing):
        numbers = [k for k in missing if samples[k].camera == camera]
        images = _Lazy([samples[k] for k in numbers], lambda sample: sample.image())
        silhouettes = _Lazy([samples[k] for k in numbers], lambda sample: _template(sample, scene, dataset).mask)
        for k, mask in zip(numbers, make_masks(images, silhouettes, net=net)):
            made[k] = mask
            on_progress("making masks", len(made), len(missing))
    if made:
        how = "by a network" if net else "from the template and the images' colours"
        scene.notes.append(f"{len(made)} masks made {how}: rough; better ones come from SAM 2 with --masks")
    return [
        replace(sample, mask=partial(made.__getitem__, k)) if k in made else sample for k, sample in enumerate(samples)
    ]


def add_normals(
    samples: list[Sample], scene: PlacedScene, dataset: ImportedDataset, options: ImportOptions
) -> tuple[list[Sample], NDArray[np.float64] | None]:
    """``samples`` with normals in OpenCV camera axes, and the signed permutation [3, 3] applied to them, or None.

    By default the template decides on the axes of the user's or a network's maps; a layout's are in OpenCV axes.
    """
    if options.normal_net is not None:
        network = normal_network(options.normal_net)
        samples = [replace(sample, normals=partial(_predict, normal_map, sample, network)) for sample in samples]
    permute: Callable[[Normals], Normals]
    if options.normal_axes is not None:
        matrix = _parse_axes(options.normal_axes)
        if all(sample.normals is None for sample in samples):
            raise InputError("--normal-axes", expected="normals to permute: --normals or --normal-net", got="none")
        permute = lambda normals: (normals @ matrix.T).astype(np.float32)  # noqa: E731
    elif options.normals is not None or options.normal_net is not None:
        few = [samples[round(k)] for k in np.linspace(0, len(samples) - 1, min(_AXIS_FRAMES, len(samples)))]
        axes = find_axes(_maps(few), (_template(sample, scene, dataset).normals for sample in few))
        scene.notes.append(f"normals point {axes.name}: mean cosine {axes.agreement:.2f} to the template")
        matrix, permute = np.diag(np.array(axes.signs, np.float64)), partial(to_opencv, axes=axes)
    else:
        return samples, None

    def finished(read: Callable[[], Normals], sample: Sample) -> Normals:
        assert sample.mask is not None
        return fill_holes(permute(read()), sample.mask())

    return [
        sample if sample.normals is None else replace(sample, normals=partial(finished, sample.normals, sample))
        for sample in samples
    ], matrix


def add_albedos(samples: list[Sample], net: Path | None) -> list[Sample]:
    """``samples`` with albedos estimated by the network ``net``, if there is one."""
    if net is None:
        return samples
    network = albedo_network(net)
    return [replace(sample, albedo=partial(_predict, albedo_map, sample, network)) for sample in samples]


def _parse_axes(axes: str) -> NDArray[np.float64]:
    try:
        return parse_axes(axes)
    except ValueError:
        raise InputError("--normal-axes", expected="such as x,-y,-z", got=axes) from None


def _maps(samples: list[Sample]) -> Iterator[Normals]:
    for sample in samples:
        assert sample.normals is not None
        yield sample.normals()


def _predict(estimator: Callable[..., NDArray[Any]], sample: Sample, network: ImageNetwork) -> NDArray[Any]:
    assert sample.mask is not None
    return estimator(network, sample.image(), sample.mask())
