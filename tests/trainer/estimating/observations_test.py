"""Observations of a person: shapes, selection, and the file."""

from pathlib import Path

import numpy as np
import pytest

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.npz import save_npz
from rnd_trainer.estimating.flow import CELLS, Flow
from rnd_trainer.estimating.observations import GreyImages, Observations, load_observations, save_observations


def observed(count: int = 4, size: tuple[int, int] = (24, 32)) -> Observations:
    rng = np.random.default_rng(0)
    width, height = size
    hands = rng.uniform(0, 20, (count, 2, 21, 2)).astype(np.float32)
    confidence = np.array([[0, 1]] * count, np.float32)
    hands[:, 0] = np.nan
    masks = rng.integers(0, 256, (count, height, width), dtype=np.uint8)
    masks[1], masks[2, :9], masks[2, :, 20:] = 0, 0, 0
    displacement = rng.normal(size=(count - 1, CELLS, CELLS, 2)).astype(np.float16)
    displacement[:, :9] = np.nan
    return Observations(
        fps=25.0,
        image_size=size,
        frames=np.arange(count) * 2,
        keypoints_px=rng.uniform(0, 20, (count, 33, 2)).astype(np.float32),
        confidence=rng.uniform(0, 1, (count, 33)).astype(np.float32),
        spread_px=rng.uniform(0, 1, (count, 33)).astype(np.float32),
        keypoints_m=rng.normal(size=(count, 33, 3)).astype(np.float32),
        hands_px=hands,
        hands_confidence=confidence,
        masks=GreyImages.of(masks, size),
        flow=(Flow(1, np.tile([1.0, 2, 20, 30], (count - 1, 1)), displacement),),
    )


def test_a_file_brings_back_every_number(tmp_path: Path) -> None:
    seen = observed()
    save_observations(tmp_path / "seen.npz", seen)
    again = load_observations(tmp_path / "seen.npz")
    for name in ("frames", "keypoints_px", "confidence", "spread_px", "keypoints_m", "hands_px", "hands_confidence"):
        np.testing.assert_array_equal(getattr(again, name), getattr(seen, name), err_msg=name)
    np.testing.assert_array_equal(np.asarray(again.masks), np.asarray(seen.masks))
    (flow,), (again_flow,) = seen.flow, again.flow
    np.testing.assert_array_equal(again_flow.displacement, flow.displacement)
    np.testing.assert_array_equal(again_flow.boxes, flow.boxes)
    assert (again.fps, again.image_size) == (25.0, (24, 32))


def test_selected_frames_take_their_masks_along() -> None:
    seen = observed()
    few = seen.select([1, 3])
    assert few.flow == ()
    assert few.frames.tolist() == [2, 6]
    np.testing.assert_array_equal(few.masks[1], seen.masks[3])
    assert seen.masks[2][9:, :20].any() and not seen.masks[1].any()
    np.testing.assert_array_equal(seen.masks[1:3][1], seen.masks[2])


def test_wrong_shapes_and_damaged_masks_are_refused(tmp_path: Path) -> None:
    seen = observed()
    with pytest.raises(InputError, match="confidence"):
        Observations(**{**vars(seen), "confidence": seen.confidence[:, :3]})
    save_observations(tmp_path / "seen.npz", seen)
    with np.load(tmp_path / "seen.npz") as archive:
        arrays = dict(archive)
    save_npz(tmp_path / "cut.npz", {**arrays, "masks_ends": arrays["masks_ends"] + 7})
    with pytest.raises(InputError, match="masks_ends"):
        load_observations(tmp_path / "cut.npz")
    scrambled = {**arrays, "masks_png": np.zeros_like(arrays["masks_png"])}
    save_npz(tmp_path / "scrambled.npz", scrambled)
    with pytest.raises(InputError, match="grey image"):
        load_observations(tmp_path / "scrambled.npz").masks[0]
    for corner in (-1, 3):
        save_npz(tmp_path / "aside.npz", {**arrays, "masks_corners": np.full((len(seen), 2), corner)})
        with pytest.raises(InputError, match="grey image"):
            load_observations(tmp_path / "aside.npz").masks[0]
