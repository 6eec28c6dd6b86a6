"""Pieces of an HTML page that needs no other file: tables, curves as SVG, images and clips as data URIs."""

from __future__ import annotations

import base64
import math
from collections.abc import Collection, Mapping, Sequence
from html import escape

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.images import write_image
from rnd_runtime.core.signals import temporary_folder

WIDTH, HEIGHT = 320, 150  # of a curve, in its own units
LEFT, RIGHT, TOP, BOTTOM = 42, 8, 8, 16  # margins for ticks
POINTS = 300  # of a curve
LARGEST = 1e300  # value of a curve: ticks and margins stay finite
MARGIN = 8  # pixels kept around the person
DARK = 8  # of 255; what is brighter in any image is the person


def table(head: Sequence[str], rows: Sequence[Sequence[object]], words: Collection[int] = (0,)) -> str:
    """A table of anything; numbers as of ``number``. The columns ``words`` are left-aligned."""
    titles = _cells("th", head, words)
    body = "".join(f"<tr>{_cells('td', row, words)}</tr>" for row in rows)
    return f'<div class="wide" tabindex="0"><table><thead><tr>{titles}</tr></thead><tbody>{body}</tbody></table></div>'


def _cells(tag: str, row: Sequence[object], words: Collection[int]) -> str:
    kinds = (' class="words"' if k in words else "" for k in range(len(row)))
    return "".join(f"<{tag}{kind}>{escape(number(value))}</{tag}>" for kind, value in zip(kinds, row))


def number(value: object) -> str:
    """Four digits of a float, nothing for None, anything else as it is."""
    if value is None:
        return ""
    if isinstance(value, float):
        return f"{value:.4g}"
    return str(value)


def png(pixels: NDArray[np.uint8], alt: str) -> str:
    """An ``img`` of [H, W, 3 or 4] pixels, lossless."""
    with temporary_folder() as folder:
        path = folder / "a.png"
        write_image(path, pixels)
        return f'<img alt="{escape(alt)}" src="{data_uri(path.read_bytes(), "image/png")}">'


def cropped(images: Sequence[NDArray[np.uint8]]) -> list[NDArray[np.uint8]]:
    """``images`` [H, W, 3] of one size, cut to what any of them shows and a margin."""
    rows, columns = np.nonzero(np.max([image.max(axis=2) for image in images], axis=0) > DARK)
    if not len(rows):
        return list(images)
    window = tuple(slice(max(int(at.min()) - MARGIN, 0), int(at.max()) + 1 + MARGIN) for at in (rows, columns))
    return [np.ascontiguousarray(image[window]) for image in images]


def data_uri(content: bytes, kind: str) -> str:
    """``content`` inside the page."""
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def figure(content: str, caption: str) -> str:
    """``content`` with ``caption`` below it."""
    return f"<figure>{content}<figcaption>{escape(caption)}</figcaption></figure>"


def strip(figures: Sequence[str], label: str, kind: str) -> str:
    """``figures`` side by side; on a narrow screen they scroll, by the keyboard too. ``kind``: a class of page.html."""
    content = "".join(figures)
    return f'<div class="strip {kind}" tabindex="0" role="group" aria-label="{escape(label)}">{content}</div>'


def missing(reason: str) -> str:
    """What stands in a section whose content is missing."""
    return f'<p class="missing">{escape(reason)}</p>'


def sections(contents: Mapping[str, str]) -> str:
    """A list of links, then ``contents`` by title; what is empty is left out."""
    named = {f"s{number}": entry for number, entry in enumerate(contents.items()) if entry[1]}
    links = "".join(f'<li><a href="#{name}">{escape(title)}</a></li>' for name, (title, _) in named.items())
    parts = (f'<section id="{name}"><h2>{escape(title)}</h2>{part}</section>' for name, (title, part) in named.items())
    return f'<nav aria-label="contents"><ul>{links}</ul></nav>\n' + "\n".join(parts)


def compare(left: str, right: str, label: str) -> str:
    """Two ``img`` of one size on top of each other, with a slider between them."""
    slider = f'<input type="range" min="0" max="100" value="50" aria-label="{escape(label)}">'
    return f'<div class="ab">{left}{right}{slider}</div>'


def curve(steps: Sequence[int], values: Sequence[float], name: str, mark: int | None) -> str:
    """``values`` over ``steps`` on a logarithmic scale, as SVG; ``mark``: a step with a line through it.

    Each point is the mean of its bin, of positive values up to 1e300.
    """
    last = max(steps, default=0)
    width = max(1, math.ceil((last + 1) / POINTS))
    bins: dict[int, list[float]] = {}
    for step, value in zip(steps, values):
        if 0 < value < LARGEST:
            bins.setdefault(step // width, []).append(math.log10(value))
    if not bins:
        return figure("", f"{name}: no positive values")
    points = [(k * width / max(last, 1), sum(logs) / len(logs)) for k, logs in sorted(bins.items())]
    low, high = (choose(y for _, y in points) for choose in (min, max))
    low, high = low - 0.03, max(high, low + 0.1) + 0.03

    def x(share: float) -> float:
        return LEFT + share * (WIDTH - LEFT - RIGHT)

    def y(log: float) -> float:
        return TOP + (high - log) / (high - low) * (HEIGHT - TOP - BOTTOM)

    lines = [
        f'<line x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y(tick):.1f}" y2="{y(tick):.1f}"/>'
        f'<text x="{LEFT - 4}" y="{y(tick) + 3:.1f}" text-anchor="end">{10**tick:.2g}</text>'
        for tick in _ticks(low, high)
    ]
    if mark is not None and 0 < mark < last:
        at = x(mark / last)
        lines.append(f'<line class="stage" x1="{at:.1f}" x2="{at:.1f}" y1="{TOP}" y2="{HEIGHT - BOTTOM}"/>')
    lines.append(f'<text x="{LEFT}" y="{HEIGHT - 4}">0</text>')
    lines.append(f'<text x="{WIDTH - RIGHT}" y="{HEIGHT - 4}" text-anchor="end">{last + 1} steps</text>')
    path = "".join(f"{'L' if k else 'M'}{x(share):.1f} {y(log):.1f}" for k, (share, log) in enumerate(points))
    caption = f"{name}, last {10 ** points[-1][1]:.3g}"
    head = f'<svg class="curve" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{escape(caption)}">'
    return figure(f'{head}{"".join(lines)}<path d="{path}"/></svg>', caption)


def _ticks(low: float, high: float) -> list[float]:
    """Logarithms of round numbers between ``low`` and ``high``, two to six where they fit."""
    ticks: list[float] = []
    for mantissas in ((1,), (1, 3), (1, 2, 5), tuple(range(1, 10)), tuple(k / 5 for k in range(5, 50))):
        decades = range(math.floor(low), math.ceil(high) + 1)
        ticks = [d + math.log10(m) for d in decades for m in mantissas]
        ticks = [tick for tick in ticks if low <= tick <= high]
        if len(ticks) >= 2:
            break
    return ticks[:: math.ceil(len(ticks) / 6)] if ticks else []
