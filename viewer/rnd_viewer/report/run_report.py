"""``rnd-report``: everything about a training run on one HTML page that needs no network and no other file."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Sequence
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.avatar.file import metadata_of
from rnd_runtime.cli.extras import install_hint
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import atomic_path, sha256_of
from rnd_runtime.core.images import read_image
from rnd_runtime.motion.motion import Motion
from rnd_runtime.motion.skeleton import Skeleton
from rnd_runtime.shading.light import Up

from .bench import TITLE as BENCH
from .bench import bench_section
from .html_parts import compare, cropped, curve, data_uri, figure, missing, png, sections, strip, table
from .renders import AvatarRenders
from .run_files import read_config, read_losses, read_scores

Bytes = NDArray[np.uint8]
TILES = ("truth", "render", "normals", "albedo", "error")  # side by side in rnd-eval's strips
# Columns of rnd-eval's rows; FACTS are about the whole run.
METRICS = {
    "split": ("split", "{}"),
    "frames": ("frames", "{}"),
    "psnr": ("PSNR, dB", "{:.2f}"),
    "ssim": ("SSIM", "{:.4f}"),
    "lpips": ("LPIPS", "{:.4f}"),
    "psnr_person": ("PSNR of the person, dB", "{:.2f}"),
    "psnr_box": ("PSNR in the box, dB", "{:.2f}"),
    "psnr_n": ("PSNR of normals, dB", "{:.2f}"),
    "normal_deg": ("normal error, °", "{:.1f}"),
    "psnr_albedo": ("PSNR of albedo, dB", "{:.2f}"),
    "outline_px": ("outline error, px", "{:.2f}"),
}
FACTS = {
    "capture": "trained on {}",
    "gaussians": "{} Gaussians",
    "steps": "{}",
    "minutes": "{:.1f} minutes",
    "seed": "seed {}",
    "file_mb": "avatar.onnx {:.1f} MB",
    "fps": "plays at {:.0f} frames a second",
    "flicker": "flicker {:.2f} of 255 (change from frame to frame; most of it is moving texture)",
    "machine": "{}",
}
SCALED = "relight_albedo_scaled"  # rnd-eval's second folder of relight
WORDS = ("split", "capture", "machine")  # fields that are no numbers


def write_run_report(
    run: Path,
    out: Path,
    *,
    motion: Callable[[Skeleton], Motion] | None = None,
    hdrs: tuple[Path, ...] = (),
    hdr_up: Up = "y",
    bench: Path | None = None,
    images: int = 3,
) -> list[str]:
    """Write the report of the training in ``run`` to ``out``; it names what the run lacks.

    Args:
        motion: played in the turntable, read for the avatar's skeleton.
        hdrs, hdr_up: relit under these; which axis points up in their files.
        bench: a folder with ``crossed.svg`` or ``grid.svg``, and ``stability.json``; without it no benchmarks.
        images: shown of each held-out split.

    Returns:
        Notes on the avatar, its motion and its lights, which are on the page too.

    Raises:
        InputError: ``run`` holds no training, or a file of it is damaged.
    """
    config = read_config(run)
    rows = read_scores(run, WORDS, ({"step"} | METRICS.keys() | FACTS.keys()) - {*WORDS})
    name = run.resolve().name
    # before the avatar is rendered: damaged files are found at once
    read = {
        "Held-out quality": _metrics(rows),
        "Truth and render": _comparisons(run / "eval", images),
        "Losses": _curves(read_losses(run)),
        BENCH: bench_section(bench, run) if bench else "",
        "Configuration": _configuration(config),
    }
    if why_not := why_no_avatar(run, config):
        avatar, notes = {"The avatar": missing(why_not)}, [why_not]
    else:
        renders = AvatarRenders(run / "avatar.onnx", motion)
        avatar, notes = _avatar(renders, hdrs, hdr_up), renders.notes
    body = f"<h1>{escape(name)}</h1>{_facts(rows)}{sections(avatar | read)}"
    page = Template(files("rnd_viewer.report").joinpath("page.html").read_text(encoding="utf-8"))
    with atomic_path(out) as temporary:
        text = page.substitute(title=escape(f"{name} · RnD-Avatar"), body=body)
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")  # names that are not UTF-8
    return notes


def _facts(rows: Sequence[dict[str, Any]]) -> str:
    row = rows[0] | {"steps": _steps(rows[0])} if rows else {}
    facts = [form.format(row[key]) for key, form in FACTS.items() if row.get(key) is not None]
    return f'<p class="facts">{escape(" · ".join(facts))}</p>' if facts else ""


def _steps(row: dict[str, Any]) -> str | None:
    """``steps`` counts those with an image; ``step``, where known, those of unseen poses too."""
    asked, taken = row.get("steps"), row.get("step")
    if asked is None or taken in (None, asked):
        return None if asked is None else f"{asked} steps"
    return f"{taken} of {asked} steps" if taken < asked else f"{taken} steps, {asked} of them with an image"


def why_no_avatar(run: Path, config: dict[str, Any]) -> str:
    """Why the avatar is not shown; empty where it is."""
    avatar, checkpoint = run / "avatar.onnx", run / "avatar.ckpt"
    if not avatar.is_file():
        ablated = config.get("light") == "none"
        how = "--light none is not exported" if ablated else f"rnd-export {checkpoint} makes it"
        return f"no avatar.onnx in the run: {how}"
    if checkpoint.is_file() and metadata_of(avatar).checkpoint_sha256 != sha256_of(checkpoint):
        return f"avatar.onnx is of another checkpoint than avatar.ckpt: rnd-export {checkpoint} makes it anew"
    return ""


def _avatar(renders: AvatarRenders, hdrs: tuple[Path, ...], hdr_up: Up) -> dict[str, str]:
    """Sections by title: lights and materials, with notes, and close-ups."""
    lit, materials = list(renders.relights(hdrs, hdr_up)), list(renders.materials())
    words = [caption for caption, _ in lit] + [f"its {caption}" for caption, _ in materials]
    images = cropped([image for _, image in lit + materials])
    pictures = [png(image, f"the avatar from the front: {caption}") for caption, image in zip(words, images)]
    figures = [figure(picture, caption) for picture, (caption, _) in zip(pictures, lit + materials)]
    if importlib.util.find_spec("av"):
        what = "the avatar, around which the camera orbits once"
        clip = f'aria-label="{what}" src="{data_uri(renders.turntable(), "video/mp4")}"'
        video = f"<video {clip} autoplay loop muted playsinline controls></video>"
        turntable = figure(video, "turntable, learned light")
    else:
        turntable = missing(f"The turntable needs PyAV: {install_hint('video')}")
    lights = strip(figures[: len(lit)], "the avatar in other lights", "body")
    surfaces = strip(figures[len(lit) :], "the avatar's materials", "body")
    html = f'<div class="row">{turntable}{lights}</div><h3>Materials</h3>{surfaces}'
    notes = "".join(f"<p>Note: {escape(note)}</p>" for note in renders.notes)
    close_ups = [figure(png(image, f"{caption}: albedo"), caption) for caption, image in renders.close_ups()]
    small = f'<p>Albedo, at rest.</p><div class="grid small">{"".join(close_ups)}</div>' if close_ups else ""
    return {"The avatar": html + notes, "What videos seldom show": small}


def _metrics(rows: Sequence[dict[str, Any]]) -> str:
    if not rows:
        return missing("no eval.json in the run: rnd-eval RUN CAPTURE --json RUN/eval.json")
    names = [name for name in METRICS if any(row.get(name) is not None for row in rows)]
    cells = [["" if row.get(name) is None else METRICS[name][1].format(row[name]) for name in names] for row in rows]
    box = "<p>In the box: in the rectangle around the person.</p>" if "psnr_box" in names else ""
    return table([METRICS[name][0] for name in names], cells) + box


def _comparisons(folder: Path, count: int) -> str:
    if count == 0:
        return ""
    splits = sorted(path for path in folder.iterdir() if path.is_dir()) if folder.is_dir() else []
    if not splits:
        return missing("no images: rnd-eval RUN CAPTURE --strips RUN/eval")
    how = "Drag across an image: truth to the left, render to the right; then normals, albedo, error × 4."
    parts = [f"<p>{how}</p>"]
    seen = set()
    for split in splits:
        paths = sorted(split.glob("*.png"))
        shown = min(count, len(paths))
        chosen = [paths[k * len(paths) // shown] for k in range(shown)]
        hashes = tuple((path.name, sha256_of(path)) for path in chosen)
        if hashes in seen:
            continue
        seen.add(hashes)
        title, note = split.name.replace("_", " "), ""
        if split.name == SCALED:
            title = "relight, albedo scaled"
            note = "<p>The same frames, with the learned albedo brought to the scale of the true one.</p>"
        parts.append(f"<h3>{escape(title)}</h3>{note}{strip([_tiles(path) for path in chosen], title, 'shots')}")
    return "".join(parts)


def _tiles(path: Path) -> str:
    """One strip of rnd-eval, cropped to the person: a slider between truth and render, then the other tiles."""
    pixels = read_image(path)[..., :3]
    if pixels.dtype != np.uint8 or pixels.shape[1] % len(TILES):
        raise InputError("strip of rnd-eval", expected="five 8-bit tiles", got=pixels.shape, file=path)
    tiles = cropped(np.split(pixels.astype(np.uint8), len(TILES), axis=1))
    truth, render, *others = (png(tile, f"{what}, {path.stem}") for what, tile in zip(TILES, tiles))
    pair = compare(truth, render, f"truth or render of {path.stem}")
    return figure(f'<div class="shot">{pair}{"".join(others)}</div>', path.stem)


def _curves(rows: Sequence[dict[str, Any]]) -> str:
    if not rows:
        return missing("no metrics.jsonl in the run")
    terms = dict.fromkeys(name for row in rows for name in row)
    terms = dict.fromkeys(["image", *terms])
    for name in ("step", "stage", "seconds", "skipped"):
        terms.pop(name, None)
    mark = next((row["step"] for row in rows if row.get("stage") == 2), None)
    figures = []
    for term in terms:
        having = [row for row in rows if row.get(term) is not None]
        if having:
            figures.append(curve([row["step"] for row in having], [row[term] for row in having], term, mark))
    skipped = sum(bool(row.get("skipped")) for row in rows)
    note = f" {skipped} steps were not finite and were skipped." if skipped else ""
    dashed = "" if mark is None else "; the dashed line marks the second stage, the light"
    return f"<p>Weighted loss terms on a logarithmic scale{dashed}.{note}</p>{strip(figures, 'losses', 'curves')}"


def _configuration(config: dict[str, Any]) -> str:
    flat = {key: value for key, value in config.items() if not isinstance(value, dict)}
    nested = {
        f"{outer}.{key}": value
        for outer, inner in config.items()
        if isinstance(inner, dict)
        for key, value in inner.items()
    }
    rows = [(key, str(value)) for key, value in (flat | nested).items()]
    content = table(("option", "value"), rows, words=(0, 1))
    return f"<details><summary>{len(rows)} options</summary>{content}</details>"
