"""The manifest of a capture: capture.json, a README with its provenance, a contact sheet."""

from __future__ import annotations

import json
import shlex
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from rnd_runtime.capture.capture import Capture, CaptureLight, load_capture, save_capture
from rnd_runtime.capture.format import Frame
from rnd_runtime.core.arrays import spaced_indices
from rnd_runtime.core.errors import flag
from rnd_runtime.core.files import atomic_path, write_json
from rnd_runtime.core.images import to_bytes, write_image
from rnd_runtime.core.npz import save_npz
from rnd_runtime.motion.motion import save_motion
from rnd_runtime.playback.doctor import machine

from .estimates import estimated_motion
from .film import Production
from .plan import image_count, missing

ESTIMATED = "capture_estimated.json"
_TILE, _COLUMNS = 128, 10  # pixels, images in a row


def write_manifest(production: Production, folder: Path, variant: str, cpu_seconds_per_image: float | None) -> bool:
    """Write the manifest if no image is missing; return whether it was written.

    If ``cpu_seconds_per_image`` is None, nothing was rendered: existing capture.json and README are kept.
    """
    if any(missing(folder, view, production.recipe.visibility) for view in production.views):
        return False
    frames = tuple(row for view in production.views for row in view.records(estimated=False))
    lights = {light.name: CaptureLight(f"lights/{light.name}.exr", (light.scale,) * 3) for light in production.lights}
    dressed, recipe = production.dressed, production.recipe

    def stays(*names: str) -> bool:
        return cpu_seconds_per_image is None and all((folder / name).exists() for name in names)

    if not stays("capture.json", "body.npz", "motion.npz"):
        capture = Capture(folder, production.cameras, lights, dressed.body, production.motion, frames)
        save_capture(capture, subject=production.title, recipe=asdict(recipe), engine=_engine(variant))
    noisy = estimated_motion(production.motion, recipe.estimate_seed, recipe.estimate_strength)
    save_motion(folder / "motion_noisy.npz", noisy)
    _estimated_record(production, folder)
    save_npz(
        folder / "surface/rest.npz",
        {
            "vertices": dressed.vertices.astype(np.float32),
            "faces": dressed.faces.astype(np.int32),
            "albedo": dressed.colour.astype(np.float32),
            "roughness": dressed.roughness.astype(np.float32),
        },
    )
    if not stays("README.md"):
        with atomic_path(folder / "README.md") as temporary:
            temporary.write_text(_readme(production, variant, cpu_seconds_per_image), encoding="utf-8")
    contact_sheet(folder)
    return True


def contact_sheet(folder: Path) -> None:
    """``contact.png``: a row for each split, and the train camera's normals and albedo."""
    capture = load_capture(folder)
    rows = []
    for split in ("train", "novel_view", "novel_pose", "relight"):
        frames = _evenly(capture.split(split))
        if frames:
            rows.append([_tile(capture.load_frame(frame).image_srgb) for frame in frames])
    train = _evenly(capture.split("train"))
    shown = [capture.load_frame(frame) for frame in train]
    for kind in ("normal_gt", "normal"):
        rows.append([_tile(0.5 * (getattr(s, kind) + 1) * (s.mask[..., None] > 0.05)) for s in shown])
    rows.append([_tile(s.albedo_srgb) for s in shown])
    width = max(len(row) for row in rows)
    blank = np.zeros_like(rows[0][0])
    sheet = [np.concatenate([*row, *[blank] * (width - len(row))], axis=1) for row in rows]
    write_image(folder / "contact.png", to_bytes(np.concatenate(sheet)))


def _evenly(frames: list[Frame]) -> list[Frame]:
    return [frames[k] for k in spaced_indices(len(frames), _COLUMNS)]


def _tile(image: NDArray[np.floating] | None) -> NDArray[np.floating]:
    assert image is not None
    return cv2.resize(np.asarray(image, np.float32), (_TILE, _TILE), interpolation=cv2.INTER_AREA)


def _estimated_record(production: Production, folder: Path) -> None:
    """The same capture with estimated poses and masks."""
    record = json.loads((folder / "capture.json").read_text(encoding="utf-8"))
    rows = [row for view in production.views for row in view.records(estimated=True)]
    for frame, row in zip(record["frames"], rows):
        frame["mask"] = row.mask
    record["motion"] = "motion_noisy.npz"
    write_json(folder / ESTIMATED, record)


def _engine(variant: str) -> dict[str, str]:
    return {"name": "mitsuba", "version": version("mitsuba"), "variant": variant}


def _readme(production: Production, variant: str, seconds: float | None) -> str:
    recipe = production.recipe
    options = " ".join(
        shlex.join([flag(key), *map(str, value if isinstance(value, list | tuple) else (value,))])
        for key, value in asdict(recipe).items()
        if value not in (None, ()) and not isinstance(value, bool)
    )
    options += "" if recipe.visibility else " --no-visibility"
    cost = "" if seconds is None else f" {seconds:.2f} s of processor time an image with its truth, cloth included."
    counts = {s: sum(use[0] == s for view in production.views for use in view.uses) for s in _SPLITS}
    splits = ", ".join(f"{name} {count}" for name, count in counts.items())
    trained = " and ".join(recipe.train_lights)
    return f"""# {production.title}

Made by `rnd-stage` (RnD-Avatar): all images are rendered. To reproduce:

    rnd-stage OUT {options}

Mitsuba {version("mitsuba")}, `{variant}`, {recipe.samples} paths a pixel, at most {recipe.max_depth} deep (with
self-shadowing and interreflection), distant light only, no ground. {image_count(production.views)} images:
{splits}.{cost}
Machine: {machine()}.

Format `rnd-capture/1`. Trained under {trained}: the first four fifths of `cam00`; the same instants from the other
cameras are the novel views, the last fifth from all cameras the novel poses, those under the other lights are relit.

| path | what |
|---|---|
| `capture.json` | exact poses and masks, `normals/` as an estimator would give them for the train split |
| `{ESTIMATED}` | the same with `motion_noisy.npz` and `masks_estimated/`, as estimators would give them |
| `images/LIGHT/` | sRGB of linear radiance, on black, premultiplied, clipped at 1 |
| `masks/`, `normals_gt/`, `albedo/`, `roughness/` | exact; roughness is 8 bit linear |
| `depth/*.exr` | metres along the camera's z, 0 outside |
| `visibility/*.npz` | `visibility` [19, H, W], 255 where the module is visible; from the top down |
| `surface/rest.npz`, `surface/FRAME.npz` | the dressed surface at rest and its vertices [V, 3] in every frame, metres |
| `lights/*.exr` | linear lat-long radiance, image light = file × `scale` |

Material: Lambert plus GGX, F0 0.04, no metal. Cloth is simulated by position-based dynamics (points 1 cm apart,
inertia, gravity, contact with the body below and the legs; cloth does not touch cloth), from the first frame on, after
a second in which the person goes from the rest pose into the first one. Skin follows linear blend skinning.

The person, the clothes, the dance and the stage's lights are generated by code and CC0; a character, a motion or HDR
files that were given keep their own licence.
"""


_SPLITS = ("train", "novel_view", "novel_pose", "relight")
