"""Rows R5, R6 and a part of L9: broken captures and their refusals."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio

from rnd_bench.scenes.subject import Subject
from rnd_bench.stability.figures import Figure, Result, at_most, holds, not_measured, refusal, result
from rnd_runtime.capture.capture import load_capture
from rnd_runtime.core.images import read_image, write_image
from rnd_trainer.training.data import load_views

FRAME = 2  # index in capture.json of the broken frame
COPIED = 6  # training frames of a copy
_FEW = f"fewer than {COPIED} training images in this capture"


def _copy(subject: Subject, name: str) -> Path:
    """A copy of the subject's capture with its first training frames."""
    source, folder = subject.capture.folder, subject.work / f"capture_{name}"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    record = json.loads(subject.capture.file.read_text(encoding="utf-8"))
    chosen = [frame for frame in record["frames"] if frame["split"] == "train"][:COPIED]
    record["frames"] = chosen
    used = {frame.get("light") for frame in chosen}
    record["lights"] = {name: light for name, light in record.get("lights", {}).items() if name in used}
    kinds = ("image", "mask", "normal", "normal_gt", "albedo", "albedo_estimate")
    files = {frame[kind] for frame in chosen for kind in kinds if frame.get(kind)}
    files |= {light["file"] for light in record["lights"].values()} | {record["body"], record["motion"]}
    for file in files:
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source / file, folder / file)
    _save(folder, record)
    return folder


def _save(folder: Path, record: dict[str, Any]) -> None:
    (folder / "capture.json").write_text(json.dumps(record), encoding="utf-8")


def _record(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "capture.json").read_text(encoding="utf-8"))


def broken_captures(subject: Subject) -> Result:
    """R5: different sizes, a missing mask, 16 bits, alpha, EXIF rotation, a frame that does not exist."""
    what = "broken captures not refused with frame and values"
    if len(subject.capture.split("train")) < COPIED:
        return result(not_measured(what, _FEW))
    wrong: list[str] = []

    def case(name: str, breaker: Callable[[Path, dict[str, Any]], None], *words: str) -> None:
        folder = _copy(subject, "broken")
        record = _record(folder)
        breaker(folder, record)
        _save(folder, record)
        wrong.extend(refusal(name, load_capture, folder, words=words))

    frame = _record(_copy(subject, "broken"))["frames"][FRAME]
    number, camera = f"frame {frame['frame']}", subject.capture.cameras[frame["camera"]]
    image, mask = frame["image"], frame["mask"]
    size = f"{camera.width} x {camera.height}"

    def resize(folder: Path, record: dict[str, Any]) -> None:
        write_image(folder / image, read_image(folder / image)[:-3, :-5])

    def add_alpha(folder: Path, record: dict[str, Any]) -> None:
        pixels = read_image(folder / image)
        write_image(folder / image, np.dstack([pixels, np.full_like(pixels[..., :1], 255)]))

    def rotate(folder: Path, record: dict[str, Any]) -> None:
        pixels = np.ascontiguousarray(read_image(folder / image))
        spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], 3, "uint8")
        spec.attribute("Orientation", 6)
        target: Any = oiio.ImageOutput.create(str(folder / image))
        target.open(str(folder / image), spec)
        target.write_image(pixels)
        target.close()

    def later(folder: Path, record: dict[str, Any]) -> None:
        record["frames"][FRAME]["frame"] = 10**6

    case("sizes that differ", resize, number, size, f"{camera.width - 5} x {camera.height - 3}", image)
    case("missing mask", lambda folder, record: (folder / mask).unlink(), number, mask)
    case("alpha PNG", add_alpha, number, "3", "4", image)
    case("EXIF rotation", rotate, number, "1", "6", image)
    case("missing frame", later, "1000000", str(subject.capture.motion.frame_count))

    folder = _copy(subject, "deep")
    before = load_capture(folder)
    eight = before.load_frame(before.frames[FRAME]).image_srgb
    deep = read_image(folder / image).astype(np.uint16) * 257
    write_image(folder / image, deep)
    after = load_capture(folder)
    if np.abs(after.load_frame(after.frames[FRAME]).image_srgb - eight).max() > 1e-6:
        wrong.append("16 bits: not the same image")
    return result(holds(what, wrong))


def bad_masks(subject: Subject) -> Result:
    """R6: one empty mask of six is skipped and counted; two, above a fifth, are refused."""
    whats = "masks not skipped, counted or refused", "empty masks used"
    if len(subject.capture.split("train")) < COPIED:
        return result(*(not_measured(what, _FEW) for what in whats))
    folder, wrong = _copy(subject, "masks"), []
    record = _record(folder)
    camera = subject.capture.cameras[record["frames"][0]["camera"]]
    empty = np.zeros((camera.height, camera.width, 1), np.uint8)
    write_image(folder / record["frames"][1]["mask"], empty)
    views, bad = load_views(load_capture(folder), "train")
    if len(views) != 5 or bad != [record["frames"][1]["frame"]]:
        wrong.append(f"one empty: {len(views)} views, counted {bad}")
    write_image(folder / record["frames"][4]["mask"], empty + 255)
    wrong += refusal("two of six", lambda: load_views(load_capture(folder), "train"), words=("20%", "2 of 6"))
    return result(holds(whats[0], wrong), at_most(whats[1], len(views) - 5, 0))


def flipped_normals(subject: Subject) -> Figure:
    """L9: a capture whose normals all point away from the camera is refused."""
    what = "a capture whose normals are all flipped is not refused"
    folder = _copy(subject, "flipped")
    normals = [folder / frame["normal"] for frame in _record(folder)["frames"] if frame.get("normal")]
    if not normals:
        return not_measured(what)
    for file in normals:
        write_image(file, np.asarray(255 - read_image(file), np.uint8))
    return holds(what, refusal("flipped", lambda: load_views(load_capture(folder), "train"), words=("normal",)))
