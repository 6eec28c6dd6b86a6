"""Whom to follow, by networks that find bright blocks: nobody, one, several, darkness, a rotated video."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from rnd_runtime.core.errors import InputError
from rnd_trainer.estimating.observing.detection import Detection
from rnd_trainer.estimating.observing.landmarks import SIDE, View, Views
from rnd_trainer.estimating.observing.regions import Region
from rnd_trainer.estimating.observing.tracking import find_person, follow, next_other

COUNT = 20


class Clip:
    def __init__(self, images: list[np.ndarray]) -> None:
        self.images, self.numbers = images, range(len(images))

    def frame(self, number: int) -> np.ndarray:
        return self.images[number]


def blocks(image: np.ndarray) -> list[Detection]:
    """A person where a red block is taller than wide."""
    red = (image[..., 0] > 200) & (image[..., 1] < 100)
    _, _, stats, centres = cv2.connectedComponentsWithStats(red.astype(np.uint8))
    found = [
        Detection(Region(float(x) + 0.5, float(y) + 0.5, float(stats[k, cv2.CC_STAT_HEIGHT])), 0.9)
        for k, (x, y) in enumerate(centres)
        if k > 0 and stats[k, cv2.CC_STAT_HEIGHT] > stats[k, cv2.CC_STAT_WIDTH]
    ]
    return sorted(found, key=lambda one: -one.region.size)


class Network:
    """Sees the red block nearest to the region's middle; a darker one may be a thing."""

    def look(self, image, region: Region, *, mirrored: bool = False) -> View:
        near = [one.region for one in blocks(image.image) if region.overlap(one.region) > 0.2]
        found = near[0] if near else region
        zeros = np.zeros((33, 2)), np.zeros((33, 3)), np.ones(33)
        score = 0.0 if not near else 1.0 if image.image[round(found.y), round(found.x), 0] > 220 else 0.9
        return View(*zeros, score, found, np.zeros((SIDE, SIDE), np.float32), region.to_image(SIDE))

    def look_twice(self, image: np.ndarray, region: Region, first: View | None = None) -> Views:
        many = np.zeros((2, 33, 2)), np.zeros((2, 33, 3)), np.ones((2, 33))
        return Views(*many, 1.0, np.zeros(image.shape[:2], np.float32), region)


def image(*people: tuple[int, int], grey: int = 90, red: int = 230) -> np.ndarray:
    """People at these columns with these heights."""
    pixels = np.full((120, 200, 3), grey, np.uint8)
    for x, height in people:
        pixels[60 - height // 2 : 60 + height // 2, x - height // 6 : x + height // 6] = (red, 20, 20)
    return pixels


def start_of(images: list[np.ndarray], person: int | None = None):
    clip = Clip(images)
    return find_person(clip, list(clip.numbers), blocks, Network(), person)


def test_one_person_is_followed_and_found_again() -> None:
    images = [image((60 + 3 * k, 60)) for k in range(COUNT)]
    images[8] = image()
    clip = Clip(images)
    start = start_of(images)
    assert (start.frame, round(start.region.x)) == (0, 60)
    seen = dict(follow(clip, list(clip.numbers), start, blocks, Network()))
    assert [number for number, views in seen.items() if views is None] == [8]
    assert seen[19].region.x == pytest.approx(60 + 3 * 19, abs=4)


def test_a_small_bystander_is_left_alone() -> None:
    assert round(start_of([image((60, 80), (150, 30))] * COUNT).region.x) == 60


def test_two_people_are_told_apart_by_an_option() -> None:
    images = [image((60, 60), (150, 56))] * COUNT
    with pytest.raises(
        InputError, match=r"people: expected one, got 2 \(choose by --person: 0 at x = 60, 1 at x = 150"
    ):
        start_of(images)
    assert round(start_of(images, person=1).region.x) == 150
    with pytest.raises(InputError, match="--person: expected 0 to 1"):
        start_of(images, person=2)


def test_a_person_is_chosen_among_all_that_the_message_counts() -> None:
    crowd = image((30, 20), (80, 60), (150, 56))  # a small bystander on the left
    images = [image((80, 60)), crowd, *[crowd] * (COUNT - 2)]
    with pytest.raises(InputError, match=r"frame \d+: people: expected one, got 3 .* 1 at x = 80, 2 at x = 150"):
        start_of(images)
    assert [round(start_of(images, person=k).region.x) for k in range(3)] == [30, 80, 150]


def test_a_thing_that_looks_like_a_person_is_nobody_beside_a_person() -> None:
    person, thing = image((60, 60)), image((150, 56), red=210)
    start = start_of([np.where(thing == 90, person, thing)] * COUNT)
    assert round(start.region.x) == 60 and all(len(people) == 1 for people in start.people.values())
    assert round(start_of([thing] * COUNT).region.x) == 150


def test_people_of_like_size_may_hide_the_person() -> None:
    images = [image((30, 20), (80, 60), (150, 56))] * COUNT
    start = start_of(images, person=1)
    person = dict.fromkeys(range(COUNT), start.region)
    other = next_other(start, [person])
    assert other is not None and round(other.region.x) == 150
    assert next_other(start, [person, dict.fromkeys(range(COUNT), other.region)]) is None


def test_who_comes_later_may_hide_the_person_too() -> None:
    start = start_of([image((60, 80))] * 15 + [image((60, 80), (150, 70))] * 4)
    other = next_other(start, [dict.fromkeys(range(19), start.region)])
    assert other is not None and other.frame >= 15 and round(other.region.x) == 150


def test_several_detections_of_one_person_are_one_person() -> None:
    def twice(pixels: np.ndarray) -> list[Detection]:
        return [found for one in blocks(pixels) for found in (one, Detection(one.region.scaled(0.6), 0.5))]

    clip = Clip([image((60, 60))] * COUNT)
    assert find_person(clip, list(clip.numbers), twice, Network()).frame == 0
    with pytest.raises(InputError, match="--person: expected 0 to 0"):
        find_person(clip, list(clip.numbers), twice, Network(), person=1)


@pytest.mark.parametrize(
    "pixels, words",
    [
        (image(), "expected one in the video, got none"),
        (image(grey=4), "light enough"),
        (np.rot90(image((60, 60))), "head to the left"),
        (np.rot90(image((60, 60)), -1), "head to the"),
    ],
)
def test_why_nobody_is_found(pixels: np.ndarray, words: str) -> None:
    with pytest.raises(InputError, match=words):
        start_of([np.ascontiguousarray(pixels)] * COUNT)
