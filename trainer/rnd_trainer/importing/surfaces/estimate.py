"""Masks and normals for the shots of a recording: from the user's folders, from networks, or made."""

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
from rnd_trainer.checking.silhouette import DrawnMesh, draw
from rnd_trainer.importing.images import Bytes, count_shift, fitting_file, last_number, listed, read_mask
from rnd_trainer.importing.recording import Recording, Shot
from rnd_trainer.importing.write import Scene

from .masks import make_masks
from .networks import ImageNetwork
from .normals import Normals, find_axes, normal_map, normal_network, read_normals, smoothed, to_opencv

_AXIS_FRAMES = 8

Turn = Callable[[Normals], Normals]


def attached(recording: Recording, masks: Path | None, normals: Path | None) -> Recording:
    """``recording`` with masks and normals from the folders that the user names, by the picture's name or number."""
    shots, notes = list(recording.shots), list(recording.notes)
    lenses = recording.lenses
    if masks is not None:
        files, assumed = _files_of(recording, masks, (".png", ".npy", ".jpg"))
        notes += assumed
        shots = [
            replace(shot, mask=partial(fitting_file, read_mask, file, lenses[shot.camera].camera, "mask"))
            for shot, file in zip(shots, files)
        ]
    if normals is not None:
        files, assumed = _files_of(recording, normals, (".npy", ".png", ".exr"))
        notes += assumed
        shots = [
            replace(shot, normals=partial(fitting_file, read_normals, file, lenses[shot.camera].camera, "normals"))
            for shot, file in zip(shots, files)
        ]
    return replace(recording, shots=shots, notes=tuple(notes))


def _files_of(recording: Recording, folder: Path, suffixes: tuple[str, ...]) -> tuple[list[Path], list[str]]:
    """The file of every shot in ``folder``, or in that of its camera there, and what was assumed."""
    inner = {name: folder / name if (folder / name).is_dir() else folder for name in recording.lenses}
    pictures: dict[Path, list[tuple[str, int]]] = {}
    for shot in recording.shots:
        pictures.setdefault(inner[shot.camera], []).append((shot.name, shot.frame))
    film = [(name, frame) for frame, name in recording.film.items()]
    stocks = {place: _Stock(place, suffixes, film or of) for place, of in pictures.items()}
    notes = dict.fromkeys(
        f"{folder.name} are numbered from {stock.first - stock.shift}, frames from {stock.first}: taken for the same"
        for stock in stocks.values()
        if stock.shift
    )
    return [stocks[inner[shot.camera]].file_of(shot.name, shot.frame) for shot in recording.shots], [*notes]


class _Stock:
    """The masks or normals of one folder, known by the names or numbers of the ``pictures`` (name, frame) there.

    A file is called like the picture, whatever follows (but no digit), or has the number at its end that the picture
    has there; of a picture without either, such as a video's, the number of its frame, or else that place. Where not
    all pictures have a file of their name, files may be counted from elsewhere: ``shift`` is what their numbers lack.
    """

    def __init__(self, folder: Path, suffixes: tuple[str, ...], pictures: Sequence[tuple[str, int]]) -> None:
        self.folder, self.files = folder, listed(folder, suffixes)
        self.stems = {file.stem: file for file in self.files}
        self.numbered = {n: file for stem, file in self.stems.items() if (n := last_number(stem)) is not None}
        numbers = sorted({_number(name, frame) for name, frame in pictures})
        self.first, self.shift = numbers[0], 0
        shift = count_shift(numbers, sorted(self.numbered)) if self.numbered else 0
        if shift and any(self._named(name) is None for name, _ in pictures):
            self.shift = shift

    def file_of(self, name: str, frame: int) -> Path:
        """The file of a picture."""
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
        """The one file that is called like a picture; where counts differ, none that is called exactly so."""
        if name in self.stems and not self.shift:
            return self.stems[name]
        longer = [file for stem, file in self.stems.items() if _continues(stem, name)]
        return longer[0] if len(longer) == 1 else None


def _number(name: str, frame: int) -> int:
    """What a picture is known by: the number that its name ends in, else that of its frame."""
    number = last_number(name)
    return frame if number is None else number


def _continues(name: str, start: str) -> bool:
    """Whether ``name`` is ``start`` and something that begins with no digit; nothing continues an empty name."""
    rest = name[len(start) :]
    return bool(start and rest) and name.startswith(start) and not rest[0].isdigit()


class _Lazy(Sequence[Any]):
    """A sequence computed entry by entry when asked for."""

    def __init__(self, entries: Sequence[Any], compute: Callable[[Any], Any]) -> None:
        self.entries, self.compute = entries, compute

    def __len__(self) -> int:
        return len(self.entries)

    def __getitem__(self, index: Any) -> Any:
        return self.compute(self.entries[index])


def _template(shot: Shot, scene: Scene, recording: Recording) -> DrawnMesh:
    k = shot.frame - int(recording.poses.frames[0])
    vertices = posed_vertices(scene.body, scene.motion.rotations[k], scene.motion.translations[k])
    return draw(vertices, scene.body.faces, scene.cameras[shot.camera])


def with_masks(shots: list[Shot], scene: Scene, recording: Recording, net: Path | None) -> list[Shot]:
    """``shots`` with rough masks where a network ``net`` is named or there are none, made camera by camera."""
    wanted = [k for k, shot in enumerate(shots) if shot.mask is None or net is not None]
    made: dict[int, Bytes] = {}
    for camera in dict.fromkeys(shots[k].camera for k in wanted):
        numbers = [k for k in wanted if shots[k].camera == camera]
        pictures = _Lazy([shots[k] for k in numbers], lambda shot: shot.image())
        silhouettes = _Lazy([shots[k] for k in numbers], lambda shot: _template(shot, scene, recording).mask)
        made |= dict(zip(numbers, make_masks(pictures, silhouettes, net=net)))
    if made:
        how = "by a network" if net else "from the template and the pictures' colours"
        scene.notes.append(f"{len(made)} masks made {how}: rough; better ones come from SAM 2 with --masks")
    return [replace(shot, mask=partial(made.__getitem__, k)) if k in made else shot for k, shot in enumerate(shots)]


def with_normals(
    shots: list[Shot], scene: Scene, recording: Recording, *, net: Path | None, axes: str | None, found: bool
) -> tuple[list[Shot], NDArray[np.float64] | None]:
    """``shots`` with normals in our axes, and the signed permutation [3, 3] that brought them there, None for none.

    Args:
        net: a network to make them with.
        axes: such as "x,-y,-z", which of theirs are our right, down, forward; None to ask the template.
        found: the template is asked about normals that the shots bring, too; else those are in our axes already, as
            a layout's own are.
    """
    if net is not None:
        network = normal_network(net)
        shots = [replace(shot, normals=partial(_one_normal_map, shot, network)) for shot in shots]
    if axes is not None:
        matrix, turned = _as_told(axes)
        if all(shot.normals is None for shot in shots):
            raise InputError("--normal-axes", expected="normals to turn: --normals or --normal-net", got="none")
    elif found or net is not None:
        few = [shots[round(k)] for k in np.linspace(0, len(shots) - 1, min(_AXIS_FRAMES, len(shots)))]
        theirs = find_axes(_maps(few), (_template(shot, scene, recording).normals for shot in few))
        scene.notes.append(f"normals point {theirs.name}: mean cosine {theirs.agreement:.2f} to the template")
        matrix, turned = np.diag(np.array(theirs.signs, np.float64)), partial(to_opencv, axes=theirs)
    else:
        return shots, None

    def finished(read: Callable[[], Normals], shot: Shot) -> Normals:
        assert shot.mask is not None
        return smoothed(turned(read()), shot.mask())

    return [
        shot if shot.normals is None else replace(shot, normals=partial(finished, shot.normals, shot)) for shot in shots
    ], matrix


def _as_told(axes: str) -> tuple[NDArray[np.float64], Turn]:
    try:
        matrix = parse_axes(axes)
    except ValueError:
        raise InputError("--normal-axes", expected="such as x,-y,-z", got=axes) from None
    return matrix, lambda normals: (normals @ matrix.T).astype(np.float32)


def _maps(shots: list[Shot]) -> Iterator[Normals]:
    for shot in shots:
        assert shot.normals is not None
        yield shot.normals()


def _one_normal_map(shot: Shot, network: ImageNetwork) -> Normals:
    assert shot.mask is not None
    return normal_map(network, shot.image(), shot.mask())
