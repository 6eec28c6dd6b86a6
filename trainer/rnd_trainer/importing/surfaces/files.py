"""Masks, normals and albedos from the user's folders, matched to images by name or number."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from rnd_runtime.core.errors import InputError
from rnd_trainer.importing.dataset import ImportedDataset
from rnd_trainer.importing.images import (
    IMAGE_SUFFIXES,
    count_shift,
    last_number,
    list_files,
    read_mask,
    read_rgb,
    read_sized,
)
from rnd_trainer.importing.options import ImportOptions

from .normals import read_normals


def attach_files(dataset: ImportedDataset, options: ImportOptions) -> ImportedDataset:
    """``dataset`` with masks, normals and albedos of the options' folders, by the images' names or numbers."""
    if options.masks is not None:
        dataset = _attach(dataset, "mask", options.masks, (".png", ".npy", ".jpg"), read_mask)
    if options.normals is not None:
        dataset = _attach(dataset, "normals", options.normals, (".npy", ".png", ".exr"), read_normals)
    if options.albedos is not None:
        dataset = _attach(dataset, "albedo", options.albedos, IMAGE_SUFFIXES, read_rgb)
    return dataset


def _attach(
    dataset: ImportedDataset, what: str, folder: Path, suffixes: tuple[str, ...], read: Callable[[Path], NDArray[Any]]
) -> ImportedDataset:
    """``dataset`` with files of ``folder``, or of its folders per camera, as ``what``."""
    inner = {name: folder / name if (folder / name).is_dir() else folder for name in dataset.lenses}
    images: dict[Path, list[tuple[str, int]]] = {}
    for sample in dataset.samples:
        images.setdefault(inner[sample.camera], []).append((sample.name, sample.frame))
    every = [(name, frame) for frame, name in dataset.image_names.items()]
    folders = {path: _NumberedFiles(path, suffixes, every or own) for path, own in images.items()}
    samples = []
    for sample in dataset.samples:
        file = folders[inner[sample.camera]].find(sample.name, sample.frame)
        reader: Any = partial(read_sized, read, file, dataset.lenses[sample.camera].camera, what)
        samples.append(replace(sample, **{what: reader}))
    notes = dict.fromkeys(
        f"{folder.name} are numbered from {files.first - files.shift}, frames from {files.first}: taken for the same"
        for files in folders.values()
        if files.shift
    )
    return replace(dataset, samples=samples, notes=(*dataset.notes, *notes))


class _NumberedFiles:
    """Masks, normals or albedos of one folder, by name or number of ``images`` (name, frame).

    A file's name is the image's, followed by anything but a digit, or has the image's number; for images without a
    number, the frame's, or else the frame's position in the folder. ``shift`` is the numbers' offset
    (``images.count_shift``) if not all images have a file of their name.
    """

    def __init__(self, folder: Path, suffixes: tuple[str, ...], images: Sequence[tuple[str, int]]) -> None:
        self.folder, self.files = folder, list_files(folder, suffixes)
        self.stems = {file.stem: file for file in self.files}
        self.numbered = {n: file for stem, file in self.stems.items() if (n := last_number(stem)) is not None}
        numbers = sorted({_number(name, frame) for name, frame in images})
        self.first, self.shift = numbers[0], 0
        shift = count_shift(numbers, sorted(self.numbered)) if self.numbered else 0
        if shift and any(self._named(name) is None for name, _ in images):
            self.shift = shift

    def find(self, name: str, frame: int) -> Path:
        """The file of an image."""
        if (file := self._named(name)) is not None:
            return file
        number = _number(name, frame) - self.shift
        numbered = self.numbered
        if last_number(name) is None and not numbered:
            numbered = dict(enumerate(self.files))
        if number not in numbered:
            got = f"{self.files[0].name} … {self.files[-1].name}"
            raise InputError("file", expected=f"one numbered {number}", got=got, file=self.folder)
        return numbered[number]

    def _named(self, name: str) -> Path | None:
        """The only file with an image's name; with a shift, only longer names."""
        if name in self.stems and not self.shift:
            return self.stems[name]
        longer = [file for stem, file in self.stems.items() if _continues(stem, name)]
        return longer[0] if len(longer) == 1 else None


def _number(name: str, frame: int) -> int:
    number = last_number(name)
    return frame if number is None else number


def _continues(name: str, start: str) -> bool:
    """Whether ``name`` is ``start`` followed by a non-digit; False for an empty ``start``."""
    rest = name[len(start) :]
    return bool(start and rest) and name.startswith(start) and not rest[0].isdigit()
