"""From whatever a user has to a capture: find out what it is, read it, fill in what is missing, write it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.errors import InputError
from rnd_trainer.checking.normals import parse_axes
from rnd_trainer.silhouette import draw, posed_vertices

from . import (
    arah,
    easymocap,
    humannerf,
    instant_avatar,
    intrinsic_avatar,
    nerfstudio,
    neuman,
    rana,
    snapshot,
    video,
    zju,
)
from .body_models import BodyModel, load_body_model
from .masks import make_masks
from .normals import find_axes, make_normals, read_normals, smoothed, to_opencv
from .pictures import Bytes, listed, read_mask
from .pose_files import read_poses
from .recording import Recording, Shot, straightened
from .write import Choice, Scene, chosen_shots, placed, write_capture

LAYOUTS: dict[str, Any] = {
    "zju": zju,
    "arah": arah,
    "humannerf": humannerf,
    "snapshot": snapshot,
    "instant-avatar": instant_avatar,
    "intrinsic-avatar": intrinsic_avatar,
    "rana": rana,
    "neuman": neuman,
    "nerfstudio": nerfstudio,
    "easymocap": easymocap,
    "video": video,
}
"""modules with ``detect`` and ``read``, the particular before the general: a folder of pictures may be anything"""
_AXIS_FRAMES = 8


@dataclass(frozen=True)
class ImportOptions:
    """What the user says about a source.

    Attributes:
        layout: a name of :data:`LAYOUTS`; "easymocap" or "smpl" also says how a pose file's root is meant.
        body: a file of :func:`load_body_model`.
        poses, person: body poses for sources without, and whose.
        masks, normals: folders, by picture name or frame number, in a folder a camera where there are several.
        mask_net, normal_net: ONNX networks in their place.
        normal_axes: "x,-y,-z" …; found by the template when None.
        intrinsics, distortion: of a plain video.
        count: most training pictures of a plain video.
        up: the source's axis that points up; found when None.
    """

    layout: str | None = None
    body: str | None = None
    poses: Path | None = None
    person: int | None = None
    masks: Path | None = None
    mask_net: Path | None = None
    normals: Path | None = None
    normal_net: Path | None = None
    normal_axes: str | None = None
    intrinsics: tuple[float, ...] = ()
    distortion: tuple[float, ...] = ()
    fps: float | None = None
    count: int = 100
    up: str | None = None
    choice: Choice = field(default_factory=Choice)


def find_layout(source: Path, name: str | None = None) -> tuple[str, str]:
    """(layout, what was found) of ``source``; ``name`` forces the layout.

    Raises:
        InputError: nothing known is there, or not what ``name`` says.
    """
    if not source.exists():
        raise InputError("source not found", file=source)
    if name in LAYOUTS:
        found = _detect(name, source)
        if found is None and name == "easymocap":  # then it says how a pose file is meant
            return find_layout(source)
        if found is None:
            raise InputError("layout", expected=f"{name}: {_needs(name)}", got="none of it", file=source)
        return name, found
    if name not in (None, "smpl"):
        raise InputError("--as", expected=" or ".join([*LAYOUTS, "smpl"]), got=name)
    for layout in LAYOUTS:
        found = _detect(layout, source)
        if found is not None:
            return layout, found
    raise InputError(
        "source", expected="a known layout", got="none of " + ", ".join(LAYOUTS), file=source,
        hint="docs/own-video.md lists what each one needs",
    )  # fmt: skip


def _detect(layout: str, source: Path) -> str | None:
    found: str | None = (
        LAYOUTS[layout].detect(source) if source.is_dir() or layout in ("video", "nerfstudio") else None
    )
    return found


def _needs(layout: str) -> str:
    return str(LAYOUTS[layout].detect.__doc__).rstrip(".")


def import_source(
    source: Path,
    out: Path,
    options: ImportOptions,
    *,
    on_shot: Callable[[int, int], None] = lambda done, total: None,
    on_found: Callable[[str], None] = lambda sentence: None,
) -> Scene:
    """Turn ``source`` into a capture in the folder ``out``.

    Args:
        on_shot: called with (pictures written, pictures in all).
        on_found: called with one sentence on what the source was found to be.

    Raises:
        InputError: with the file and, where there is one, the frame.
    """
    layout, found = find_layout(source, options.layout)
    on_found(f"{layout}: {found}")
    if (out / "capture.json").exists():
        raise InputError("holds a capture already", file=out, hint="choose another folder")
    if options.body is None:
        raise InputError(
            "--body", expected="SMPL, SMPL-H or SMPL-X (.npz, .pkl), a body.npz, or anny", got="none"
        )
    model = load_body_model(options.body)
    recording = straightened(_attached(_read(layout, source, model, options), options))
    if options.fps is not None:
        recording = replace(recording, fps=options.fps)
    scene = placed(recording, model, options.up)
    shots = chosen_shots(recording, options.choice)
    shots = _with_masks(shots, scene, recording, options)
    shots = _with_normals(shots, scene, recording, options)
    write_capture(out, recording, scene, shots, on_shot)
    return scene


def _read(layout: str, source: Path, model: BodyModel, options: ImportOptions) -> Recording:
    convention = options.layout if options.layout in ("easymocap", "smpl") else None
    if layout == "video":
        if options.poses is None:
            raise InputError(
                "--poses", expected="a file from WHAM, GVHMR, 4D-Humans, ROMP or EasyMocap", got="none"
            )
        poses = read_poses(options.poses, person=options.person, convention=convention)
        return video.read(
            source, model, poses, intrinsics=options.intrinsics, distortion=options.distortion,
            count=options.count, fps=options.fps,
        )  # fmt: skip
    if layout == "nerfstudio":
        return nerfstudio.read(source, poses=options.poses, convention=convention)
    if layout == "easymocap":
        return easymocap.read(source, poses=options.poses)
    recording: Recording = LAYOUTS[layout].read(source)
    return recording


def _attached(recording: Recording, options: ImportOptions) -> Recording:
    """``recording`` with masks and normals from the folders that the user names."""

    def replaced(shot: Shot) -> Shot:
        if options.masks is not None:
            shot = replace(
                shot,
                mask=partial(read_mask, _file_of(options.masks, shot, recording, (".png", ".npy", ".jpg"))),
            )
        if options.normals is not None:
            shot = replace(
                shot,
                normals=partial(
                    read_normals, _file_of(options.normals, shot, recording, (".npy", ".png", ".exr"))
                ),
            )
        return shot

    if options.masks is None and options.normals is None:
        return recording
    return replace(recording, shots=[replaced(shot) for shot in recording.shots])


def _file_of(folder: Path, shot: Shot, recording: Recording, suffixes: tuple[str, ...]) -> Path:
    """The file of ``shot``: by its number at the end of the name, in the camera's folder where there is one."""
    inner = folder / shot.camera if (folder / shot.camera).is_dir() else folder
    files = listed(inner, suffixes)
    numbered = {}
    for k, file in enumerate(files):
        digits = file.stem[len(file.stem.rstrip("0123456789")) :]
        numbered[int(digits) if digits else k] = file
    if shot.frame not in numbered:
        raise InputError(
            "file",
            expected=f"one numbered {shot.frame}",
            got=f"{files[0].name} … {files[-1].name}",
            file=inner,
        )
    return numbered[shot.frame]


class _Lazy(Sequence[Any]):
    """A sequence computed entry by entry when asked for."""

    def __init__(self, entries: Sequence[Any], compute: Callable[[Any], Any]) -> None:
        self.entries, self.compute = entries, compute

    def __len__(self) -> int:
        return len(self.entries)

    def __getitem__(self, index: Any) -> Any:
        return self.compute(self.entries[index])


def _template(shot: Shot, scene: Scene, recording: Recording):
    k = shot.frame - int(recording.poses.frames[0])
    vertices = posed_vertices(scene.body, scene.motion.rotations[k], scene.motion.translations[k])
    return draw(vertices, scene.body.faces, scene.cameras[shot.camera])


def _with_masks(shots: list[Shot], scene: Scene, recording: Recording, options: ImportOptions) -> list[Shot]:
    """``shots`` with rough masks for those that have none, made camera by camera."""
    made: dict[int, Bytes] = {}
    for camera in dict.fromkeys(shot.camera for shot in shots if shot.mask is None):
        numbers = [k for k, shot in enumerate(shots) if shot.camera == camera and shot.mask is None]
        pictures = _Lazy([shots[k] for k in numbers], lambda shot: shot.image())
        silhouettes = _Lazy([shots[k] for k in numbers], lambda shot: _template(shot, scene, recording).mask)
        made |= dict(zip(numbers, make_masks(pictures, silhouettes, net=options.mask_net)))
    if made:
        how = "by a network" if options.mask_net else "from the template and the pictures' colours"
        scene.notes.append(f"{len(made)} masks made {how}: rough; better ones come from SAM 2 with --masks")
    return [
        replace(shot, mask=partial(made.__getitem__, k)) if k in made else shot
        for k, shot in enumerate(shots)
    ]


def _with_normals(
    shots: list[Shot], scene: Scene, recording: Recording, options: ImportOptions
) -> list[Shot]:
    """``shots`` with normals of a network or of the user's folder brought to our axes; others stay as they are."""
    if options.normal_net is not None:
        shots = [replace(shot, normals=partial(_one_normal_map, shot, options.normal_net)) for shot in shots]
    elif options.normals is None:
        return shots
    if options.normal_axes is not None:
        try:
            matrix = parse_axes(options.normal_axes)
        except ValueError:
            raise InputError("--normal-axes", expected="such as x,-y,-z", got=options.normal_axes) from None

        def turned(normals: NDArray[np.float32]) -> NDArray[np.float32]:
            return (normals @ matrix.T).astype(np.float32)
    else:
        few = [shots[round(k)] for k in np.linspace(0, len(shots) - 1, min(_AXIS_FRAMES, len(shots)))]
        axes = find_axes(_maps(few), (_template(shot, scene, recording).normals for shot in few))
        scene.notes.append(f"normals point {axes.name}: mean cosine {axes.agreement:.2f} to the template")

        def turned(normals: NDArray[np.float32]) -> NDArray[np.float32]:
            return to_opencv(normals, axes)

    def finished(shot: Shot) -> NDArray[np.float32]:
        assert shot.normals is not None and shot.mask is not None
        return smoothed(turned(shot.normals()), shot.mask())

    return [replace(shot, normals=partial(finished, shot)) for shot in shots]


def _maps(shots: list[Shot]) -> Iterator[NDArray[np.float32]]:
    for shot in shots:
        assert shot.normals is not None
        yield shot.normals()


def _one_normal_map(shot: Shot, net: Path) -> NDArray[np.float32]:
    assert shot.mask is not None
    return next(make_normals([shot.image()], [shot.mask()], net=net))
