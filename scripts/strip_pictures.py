"""Sheets for the README from the strips of rnd-eval: python scripts/strip_pictures.py STRIPS OUT.png NAME NAME …

STRIPS is a folder that ``rnd-eval --pictures`` wrote (truth, render, normals, albedo, error side by side); the named
strips are cut to the person and laid out two to a row; of an odd number, the last has black beside it.
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from rnd_runtime.images import read_image, write_image

TILES = 5
"""pictures side by side in a strip"""
SHOWN = (270, 150)
"""height and width of a tile in the sheet, pixels"""


def main(folder: Path, out: Path, names: list[str]) -> None:
    """Write the sheet."""
    strips = [_cut(read_image(folder / f"{name}.png")[..., :3]) for name in names]
    if len(strips) > 1 and len(strips) % 2:
        strips.append(np.zeros_like(strips[-1]))
    rows = [np.concatenate(strips[k : k + 2], axis=1) for k in range(0, len(strips), 2)]
    write_image(out, np.concatenate(rows, axis=0))


def _cut(strip: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The tiles of a strip, each cut to the columns around the person in the first."""
    tiles = np.split(strip, TILES, axis=1)
    height, width = tiles[0].shape[:2]
    wide = round(height * SHOWN[1] / SHOWN[0])
    middle = int(np.median(np.nonzero(tiles[0].any(axis=2))[1]))
    left = int(np.clip(middle - wide // 2, 0, width - wide))
    small = [
        cv2.resize(tile[:, left : left + wide], SHOWN[::-1], interpolation=cv2.INTER_AREA) for tile in tiles
    ]
    return np.concatenate(small, axis=1)


if __name__ == "__main__":
    if len(sys.argv) < 4:
        sys.exit("usage: strip_pictures.py FOLDER OUT NAME ...")
    main(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3:])
