"""Sheets for the README from the strips of rnd-eval: python scripts/strip_sheet.py STRIPS OUT.png NAME NAME …

STRIPS is a folder that ``rnd-eval --strips`` wrote (truth, render, normals, albedo, error side by side). The named
strips are cropped to the person, two to a row; an odd last one has black beside it.
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.images import read_image, write_image
from rnd_trainer.evaluation.preview import TILES, captions

SHOWN = (330, 150)
"""height and width of a tile in the sheet, pixels"""
MARGIN = 0.04
"""around the person, of the height"""


def main(folder: Path, out: Path, names: list[str]) -> None:
    """Write the sheet."""
    strips = [_cut(read_image(folder / f"{name}.png")[..., :3]) for name in names]
    if len(strips) > 1 and len(strips) % 2:
        strips.append(np.zeros_like(strips[-1]))
    rows = [np.concatenate(strips[k : k + 2], axis=1) for k in range(0, len(strips), 2)]
    words = captions(TILES * len(strips[:2]), SHOWN[1])
    write_image(out, np.concatenate([words, *rows], axis=0))


def _cut(strip: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The tiles of a strip, each cropped to the person in the first."""
    tiles = np.split(strip, len(TILES), axis=1)
    rows, columns = np.nonzero(tiles[0].any(axis=2))
    high = (np.ptp(rows) + 1) * (1 + 2 * MARGIN)
    wide = (np.ptp(columns) + 1) * (1 + 2 * MARGIN)
    scale = min(SHOWN[0] / high, SHOWN[1] / wide)
    middle = np.array([columns.min() + columns.max(), rows.min() + rows.max()]) / 2
    to_tile = np.array([[scale, 0, 0], [0, scale, 0]])
    to_tile[:, 2] = (np.array(SHOWN[::-1]) - 1) / 2 - scale * middle
    small = [cv2.warpAffine(tile, to_tile, SHOWN[::-1], flags=cv2.INTER_CUBIC) for tile in tiles]
    return np.concatenate(small, axis=1)


if __name__ == "__main__":
    if len(sys.argv) < 4:
        sys.exit("usage: strip_sheet.py FOLDER OUT NAME ...")
    main(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3:])
