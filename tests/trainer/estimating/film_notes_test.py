"""What is said of a clip: sides never seen, parts beyond the image, darkness."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rnd_runtime.core.errors import InputError
from rnd_trainer.estimating.film_notes import cut_off, film_notes, refuse_unusable
from rnd_trainer.estimating.observations import BLAZEPOSE, GreyImages, Observations

COUNT, SIDE = 40, 64


def seen(**changes: object) -> Observations:
    mask = np.zeros((SIDE, SIDE), np.uint8)
    mask[4:60, 20:44] = 255
    observed = Observations(
        fps=15.0,
        image_size=(SIDE, SIDE),
        frames=np.arange(COUNT),
        keypoints_px=np.full((COUNT, 33, 2), 32, np.float32),
        confidence=np.ones((COUNT, 33), np.float32),
        spread_px=np.zeros((COUNT, 33), np.float32),
        keypoints_m=np.zeros((COUNT, 33, 3), np.float32),
        hands_px=np.zeros((COUNT, 2, 21, 2), np.float32),
        hands_confidence=np.ones((COUNT, 2), np.float32),
        masks=GreyImages.of([mask] * COUNT, (SIDE, SIDE)),
    )
    return replace(observed, **changes)


def frame(value: int):
    return lambda number: np.full((SIDE, SIDE, 3), value, np.uint8)


def moved(points: list[str], to: tuple[float, float], frames: slice) -> Observations:
    pixels = seen().keypoints_px.copy()
    for name in points:
        pixels[frames, BLAZEPOSE.index(name)] = to
    return seen(keypoints_px=pixels)


FULL_TURN = np.linspace(-180, 180, COUNT, endpoint=False)


def test_a_good_film_needs_only_more_pixels() -> None:
    assert film_notes(seen(), FULL_TURN, frame(120)) == [
        "you are 56 pixels tall: come closer, or film upright and in 1080p"
    ]
    refuse_unusable(seen(), frame(120))


def test_sides_that_were_not_seen_are_named() -> None:
    notes = film_notes(seen(), np.linspace(-40, 140, COUNT), frame(120))
    assert "your back was seen in 2 frames: turn round once, slowly" in notes
    assert "your right side was never seen: turn round once, slowly" in notes
    assert not any("front" in note or "left side" in note for note in notes)


def test_parts_beyond_the_image_are_counted() -> None:
    part = moved(["left_wrist"], (-9, 30), slice(0, 6))
    assert cut_off(part).tolist() == [True] * 6 + [False] * 34
    assert "your hands left the image in 6 of 40 frames: step back" in film_notes(part, FULL_TURN, frame(120))
    refuse_unusable(part, frame(120))


@pytest.mark.parametrize(
    "points, words",
    [
        (["left_foot_index"], "feet beyond the image in 30 of 40 frames"),
        (["nose"], "head beyond the image"),
        (["left_hip", "right_hip", "left_ankle", "right_ankle"], "head and shoulders alone"),
    ],
)
def test_a_person_cut_off_is_refused(points: list[str], words: str) -> None:
    with pytest.raises(InputError, match=words):
        refuse_unusable(moved(points, (30, 90), slice(0, 30)), frame(120))


def test_darkness_is_noted_and_refused() -> None:
    assert any("the light is low" in note for note in film_notes(seen(), FULL_TURN, frame(30)))
    with pytest.raises(InputError, match="expected in light, got a mean of 5"):
        refuse_unusable(seen(), frame(5))
