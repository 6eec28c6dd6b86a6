"""``rnd-bench ground``: what a shadow on the ground costs, and its error against Mitsuba."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from typing import Any

import numpy as np

from rnd_bench.options import Ground
from rnd_runtime import __version__
from rnd_runtime.capture.body import Body
from rnd_runtime.cli.command import show
from rnd_runtime.core.errors import check_option
from rnd_runtime.core.files import existing_file, write_json
from rnd_runtime.core.threads import check_threads, max_threads
from rnd_runtime.playback.doctor import machine

ALBEDO = 0.5
"""of the ground that lights the body"""
EDGE_SIZE = 192
"""pixels of the image in which a sun's shadow is compared edge by edge"""


def run(options: Ground) -> None:
    for name in ("size", "pairs", "samples"):
        check_option(getattr(options, name) >= 1, f"--{name}", "at least 1", getattr(options, name))
    if options.threads is not None:
        check_threads(options.threads)
    from .cost import cost

    files = [options.assets / name for name in ("avatar.onnx", "walk.npz", "sky.exr")]
    for file in files:
        existing_file(file, what="file of the benchmark")
    threads = options.threads or min(2, max_threads())
    avatar, motion, hdr = files
    rows = [cost(avatar, motion, hdr, size=options.size, threads=threads, pairs=options.pairs)]
    show(f"added by the ground: {rows[0]['added_ms']:.2f} ms a frame of {options.size}², {threads} threads")
    if importlib.util.find_spec("mitsuba") is None:
        show("mitsuba is not installed: no comparison with it")
    else:
        for row in _judged(Body.load(options.assets / "body.npz"), options.samples):
            rows.append(row)
            edge = f", edge {row['edge_px']:.2f} pixels (largest {row['edge_px_max']:.1f})" if "edge_px" in row else ""
            show(f"{row['light']}, {row['pose']}: {row['psnr_db']:.1f} dB{edge}")
        for row in _bounces(Body.load(options.assets / "body.npz"), options.samples):
            rows.append(row)
            show(f"{row['light']}: the ground's light on the body is {row['ratio']:.3f} of Mitsuba's")
    if options.json is not None:
        write_json(options.json, [row | {"machine": machine(), "version": __version__} for row in rows])


def _bounces(template: Body, samples: int) -> Iterator[dict[str, Any]]:
    """A row for each of two lights: ratio of the mean radiances, and the RMS of their difference over the mean."""
    from .judge import lights, played_bounce, posed_body, traced_bounce

    body = posed_body(template, 0.0)
    for name in ("sky", "sun and sky"):
        theirs = traced_bounce(lights()[name], *body, ALBEDO, samples)
        inside = theirs[..., 3] > 0.99
        ours, truth = played_bounce(lights()[name], *body, ALBEDO)[inside], theirs[inside][:, :3]
        row = {"what": "bounce", "light": name, "albedo": ALBEDO, "samples": samples}
        rms = float(np.sqrt(np.mean((ours - truth) ** 2)))
        yield row | {"ratio": float(ours.mean() / truth.mean()), "rms": rms / float(truth.mean())}


def _judged(template: Body, samples: int) -> Iterator[dict[str, Any]]:
    """A row for each light and pose."""
    from .judge import TURNS, edge_pixels, lights, played, posed_body, shadow_db, traced, view

    for name, light in lights().items():
        for pose, turn in TURNS.items():
            camera = view(EDGE_SIZE if name == "sun" else EDGE_SIZE // 2)
            body = posed_body(template, turn)
            theirs = traced(light, *body, camera, samples)
            ours = played(light, *body, camera)
            row = {"what": "shadow", "light": name, "pose": pose, "size": camera.width, "samples": samples}
            row["psnr_db"] = shadow_db(ours, theirs)
            if name == "sun":
                row["edge_px"], row["edge_px_max"] = edge_pixels(ours, theirs)
            yield row
