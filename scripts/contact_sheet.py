"""Contact sheet of a demo run: the last training preview above frames of the played clip.

Usage: contact_sheet.py RUN OUT.png
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np

from rnd_runtime.core.images import read_image, write_image

COLUMNS = 6


def main(run: Path, out: Path) -> None:
    """Tile six evenly spaced frames of RUN/play/frames under the newest image of RUN/previews."""
    frames = sorted((run / "play" / "frames").glob("*.png"))
    chosen = [frames[k * len(frames) // COLUMNS] for k in range(COLUMNS)]
    played = np.concatenate([_on_grey(read_image(path)) for path in chosen], axis=1)
    preview = _on_grey(read_image(max((run / "previews").glob("*.png"))))
    width = preview.shape[1]
    height = round(played.shape[0] * width / played.shape[1])
    shrunk = cv2.resize(played, (width, height), interpolation=cv2.INTER_AREA)
    write_image(out, np.concatenate([preview, shrunk]))


def _on_grey(image: np.ndarray) -> np.ndarray:
    """[H, W, 3 or 4] uint8 → [H, W, 3]; straight alpha goes over dark grey."""
    if image.shape[2] == 3:
        return image
    alpha = image[..., 3:] / 255
    return np.round(image[..., :3] * alpha + 40 * (1 - alpha)).astype(np.uint8)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
