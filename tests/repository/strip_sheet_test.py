"""scripts/strip_sheet.py: sheets of any number of strips."""

from __future__ import annotations

import runpy

import numpy as np
import pytest

from rnd_runtime.core.images import read_image, write_image
from rnd_trainer.evaluation.preview import CAPTION
from support.paths import ROOT

SCRIPT = runpy.run_path(str(ROOT / "scripts/strip_sheet.py"))
SIDE = 54
QUARTER = 4  # of a pixel of the strip, which is 15 of the sheet


@pytest.mark.parametrize(("count", "rows", "columns"), [(1, 1, 1), (2, 1, 2), (3, 2, 2), (5, 3, 2)])
def test_strips_are_two_to_a_row_and_cropped_to_the_person(tmp_path, count, rows, columns) -> None:
    """A person 20 pixels high and 6 wide, somewhere in each tile, fills the middle of a tile of the sheet."""
    names = [f"strip{k}" for k in range(count)]
    for k, name in enumerate(names):
        strip = np.zeros((SIDE, 5 * SIDE, 3), np.uint8)
        for tile in range(5):
            strip[7 + k : 27 + k, tile * SIDE + 30 : tile * SIDE + 36] = 60 + 20 * k + tile
        write_image(tmp_path / f"{name}.png", strip)
    SCRIPT["main"](tmp_path, tmp_path / "sheet.png", names)
    sheet = read_image(tmp_path / "sheet.png").astype(int)
    (height, width), margin, header = SCRIPT["SHOWN"], SCRIPT["MARGIN"], CAPTION
    assert sheet.shape == (header + rows * height, columns * 5 * width, 3)
    words, sheet = sheet[:header], sheet[header:]
    assert all(words[:, k * width : (k + 1) * width].any() for k in range(5 * columns))
    for k in range(rows * columns):
        for tile in range(5):
            left = (k % 2 * 5 + tile) * width
            shown = sheet[k // 2 * height :, left:][:height, :width, 0]
            level = 60 + 20 * k + tile if k < count else 0
            assert shown[height // 2, width // 2] == level
            if level:
                y, x = (np.flatnonzero((shown > level / 2).any(axis=axis)) for axis in (1, 0))
                assert len(y) == pytest.approx(height / (1 + 2 * margin), abs=QUARTER)
                assert len(x) == pytest.approx(len(y) * 6 / 20, abs=QUARTER)
                assert abs(y.mean() - height / 2) < QUARTER and abs(x.mean() - width / 2) < QUARTER
