"""scripts/strip_pictures.py: sheets of any number of strips."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pytest

from rnd_runtime.images import read_image, write_image

SCRIPT = runpy.run_path(str(Path(__file__).parent.parent / "scripts/strip_pictures.py"))
SIDE = 54


@pytest.mark.parametrize(("count", "rows", "columns"), [(1, 1, 1), (2, 1, 2), (3, 2, 2), (5, 3, 2)])
def test_strips_are_laid_out_two_to_a_row(tmp_path, count, rows, columns) -> None:
    names = [f"strip{k}" for k in range(count)]
    for k, name in enumerate(names):
        write_image(tmp_path / f"{name}.png", np.full((SIDE, 5 * SIDE, 3), 40 + k, np.uint8))
    SCRIPT["main"](tmp_path, tmp_path / "sheet.png", names)
    sheet = read_image(tmp_path / "sheet.png")
    height, width = SCRIPT["SHOWN"]
    assert sheet.shape == (rows * height, columns * 5 * width, 3)
    for k in range(rows * columns):
        tile = sheet[k // 2 * height :, k % 2 * 5 * width :][:height, : 5 * width]
        assert (tile == (40 + k if k < count else 0)).all()
