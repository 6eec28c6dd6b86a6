"""Masks and normals for the shots of a recording: from the user's folders, from networks, or made."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.body import posed_vertices
from rnd_runtime.errors import InputError
from rnd_trainer.checking.normals import parse_axes
from rnd_trainer.silhouette import DrawnMesh, draw

from .masks import make_masks
from .networks import ImageNetwork
from .normals import Normals, find_axes, normal_map, normal_network, read_normals, smoothed, to_opencv
from .pictures import Bytes, fitting_file, last_number, listed, read_mask
from .recording import Recording, Shot
from .write import Scene

_AXIS_FRAMES = 8

Turn = Callable[[Normals], Normals]


def attached(recording: Recording, masks: Path | None, normals: Path | None) -> Recording:
    """``recording`` with masks and normals from the folders that the user names, by the picture's name or number."""
    length, notes = recording.film_length, set()

    def file_of(folder: Path, shot: Shot, suffixes: tuple[str, ...]) -> Path:
        file, counted = _file_of(folder, shot, suffixes, length)
        if counted:
            notes.add(f"{folder.name} are numbered from 1, frames from 0: taken for the same")
        return file

    def replaced(shot: Shot) -> Shot:
        camera = recording.lenses[shot.camera].camera
        if masks is not None:
            file = file_of(masks, shot, (".png", ".npy", ".jpg"))
            shot = replace(shot, mask=partial(fitting_file, read_mask, file, camera, "mask"))
        if normals is not None:
            file = file_of(normals, shot, (".npy", ".png", ".exr"))
            shot = replace(shot, normals=partial(fitting_file, read_normals, file, camera, "normals"))
        return shot

    shots = [replaced(shot) for shot in recording.shots]
    return replace(recording, shots=shots, notes=(*recording.notes, *sorted(notes)))


def _file_of(folder: Path, shot: Shot, suffixes: tuple[str, ...], length: int) -> tuple[Path, bool]:
    """The file of ``shot`` in the camera's folder, where there is one, and whether frames are counted from 1 there.

    It is called like the picture, whatever follows (but no digit), or has the number at its end that the picture has
    there; of a picture without either, such as a video's, the number of its frame, or else that place. Where a film of
    ``length`` frames has as many files, from 1 on, its first frame is 1.
    """
    inner = folder / shot.camera if (folder / shot.camera).is_dir() else folder
    files = listed(inner, suffixes)
    named = {file.stem: file for file in files}
    if shot.name in named:
        return named[shot.name], False
    longer = [file for file in files if _continues(file.name, shot.name)]
    if len(longer) == 1:
        return longer[0], False
    number = last_number(shot.name)
    numbered = {n: file for file in files if (n := last_number(file.stem)) is not None}
    if number is None and not numbered:
        numbered = dict(enumerate(files))
    from_one = number is None and sorted(numbered) == list(range(1, length + 1))
    number = shot.frame + from_one if number is None else number
    if number not in numbered:
        raise InputError(
            "file", expected=f"one numbered {number}", got=f"{files[0].name} … {files[-1].name}", file=inner
        )
    return numbered[number], from_one


def _continues(name: str, start: str) -> bool:
    return name.startswith(start) and not name[len(start) :][:1].isdigit()


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
    return [
        replace(shot, mask=partial(made.__getitem__, k)) if k in made else shot
        for k, shot in enumerate(shots)
    ]


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
            raise InputError(
                "--normal-axes", expected="normals to turn: --normals or --normal-net", got="none"
            )
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
        shot if shot.normals is None else replace(shot, normals=partial(finished, shot.normals, shot))
        for shot in shots
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
