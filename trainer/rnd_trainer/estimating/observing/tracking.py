"""One person through a video: found, followed from frame to frame, found again where lost."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from statistics import mode
from typing import NamedTuple, Protocol

import numpy as np

from rnd_runtime.core.arrays import spaced_indices
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.threads import ahead

from .detection import Detection, Detector
from .landmarks import SIDE, LandmarkNetwork, View, Views
from .regions import Image, Region, Shrunk

MIN_SCORE = 0.5
"""of the landmark network, that there is a person"""
_SURE = 0.99  # score of people beside a surer one: things had up to 0.98, nearly all people more than 0.99
_SAMPLES = 9  # frames in which people are counted
_ALIKE = 0.6  # size of a second person, relative to the first, from which one has to be chosen
_OFTEN = 0.25  # share of the sampled frames
_STEADY = 0.9  # overlap of regions below which a frame is looked at again in the newer one
_NEAR = 0.05  # overlap with the last region from which a detection is the same person
_DARK = 16.0  # mean 8-bit value of a dark image


class Frames(Protocol):
    """Frames of a video by number."""

    @property
    def numbers(self) -> range | list[int]: ...
    def frame(self, number: int) -> Image: ...


@dataclass(frozen=True)
class Start:
    """Where a person is first seen, and all people in the frames in which they were counted."""

    frame: int
    region: Region
    people: Mapping[int, list[Region]] = field(default_factory=dict)


def find_person(
    video: Frames, numbers: list[int], detector: Detector, network: LandmarkNetwork, person: int | None = None
) -> Start:
    """The person to follow: the only one, the largest one by far, or number ``person`` from the left.

    Raises:
        InputError: nobody, nobody upright, several people of one size, or no such person.
    """
    sampled = [numbers[k] for k in spaced_indices(len(numbers), _SAMPLES)]
    seen: dict[int, list[Region]] = {}
    images = (video.frame(number) for number in sampled)
    for number, people in zip(sampled, ahead(lambda image: _people(image, detector, network), images)):
        if people:
            seen[number] = sorted(people, key=lambda one: -one.size)
    if not seen:
        raise _nobody(video, sampled, detector, network)
    several = [number for number, people in seen.items() if len(_alike(people)) > 1]
    usual = mode(len(seen[number]) for number in several or seen)
    number = next(number for number, people in seen.items() if len(people) == usual)
    row = sorted(seen[number], key=lambda one: one.x)
    if person is not None:
        if person >= len(row):
            raise InputError("--person", expected=f"0 to {len(row) - 1}, counted from the left", got=person)
        return Start(number, row[person], seen)
    if len(several) > _OFTEN * len(seen):
        places = ", ".join(f"{k} at x = {one.x:.0f}" for k, one in enumerate(row))
        raise InputError(
            "people", expected="one", got=f"{len(row)}", frame=number, hint=f"choose by --person: {places}"
        )
    return Start(number, seen[number][0], seen)


def next_other(start: Start, tracks: Sequence[Mapping[int, Region]]) -> Start | None:
    """Where somebody is seen who may hide the person of the first of ``tracks`` and is on none; None where nobody is.

    ``tracks`` are regions by frame number. Where the person was not counted, nobody was counted well.
    """
    for number, people in start.people.items():
        person = tracks[0].get(number)
        if person is None or not any(person.same_person(one) for one in people):
            continue
        known = [track[number] for track in tracks if number in track]
        for one in people:
            if one.size >= _ALIKE * person.size and not any(one.same_person(other) for other in known):
                return Start(number, one)
    return None


def follow(
    video: Frames, numbers: list[int], start: Start, detector: Detector, network: LandmarkNetwork
) -> Iterator[tuple[int, Views | None]]:
    """Yield each frame's number and the views of the person in it, None where the person is not seen."""

    def views_of(one: _Followed) -> tuple[int, Views | None]:
        return one.number, None if one.settled is None else network.look_twice(one.image, *one.settled)

    return ahead(views_of, _followed(video, numbers, start, detector, network))


class _Followed(NamedTuple):
    number: int
    image: Image
    settled: tuple[Region, View] | None


def _followed(
    video: Frames, numbers: list[int], start: Start, detector: Detector, network: LandmarkNetwork
) -> Iterator[_Followed]:
    region: Region | None = None
    last = start.region
    for number in numbers:
        image = video.frame(number)
        if number == start.frame:
            region = start.region
        if region is None:
            region = _found_again(detector(image), last)
        settled = None if region is None else _settled(image, region, network)
        yield _Followed(number, image, settled)
        region = None if settled is None else settled[1].next_region
        last = region or last


def _settled(image: Image, region: Region, network: LandmarkNetwork) -> tuple[Region, View] | None:
    """The view of ``region``, or of the better one that it shows; None where there is nobody."""
    for _ in range(3):
        view = network.look(Shrunk(image, region.size, SIDE), region)
        if view.score < MIN_SCORE or not view.next_region.size > 1:
            return None
        if region.overlap(view.next_region) >= _STEADY:
            break
        region = view.next_region
    return region, view


def _found_again(people: list[Detection], last: Region) -> Region | None:
    near = [(one.region.overlap(last.scaled(1.5)), one.region) for one in people]
    near = [(overlap, region) for overlap, region in near if overlap > _NEAR]
    return max(near, key=lambda pair: pair[0])[1] if near else None


def _people(image: Image, detector: Detector, network: LandmarkNetwork) -> list[Region]:
    """Regions of all whom ``network`` confirms; candidates that lead it to one person count once."""
    people: list[tuple[Region, float]] = []
    for one in detector(image):
        settled = _settled(image, one.region, network)
        if settled is not None and not any(settled[0].same_person(other) for other, _ in people):
            people.append((settled[0], settled[1].score))
    sure = min(_SURE, max((score for _, score in people), default=0.0))
    return [region for region, score in people if score >= sure]


def _alike(people: list[Region]) -> list[Region]:
    return [one for one in people if one.size >= _ALIKE * people[0].size]


def _nobody(video: Frames, sampled: list[int], detector: Detector, network: LandmarkNetwork) -> InputError:
    """Why nobody was found: darkness, a rotated video, or nobody."""
    images = [video.frame(number) for number in sampled[:: max(1, len(sampled) // 3)]]
    brightness = float(np.mean([image.mean() for image in images]))
    if brightness < _DARK:
        return InputError("images", expected="light enough to see a person", got=f"a mean of {brightness:.0f} of 255")
    for quarters, name in ((1, "lying, head to the left"), (3, "lying, head to the right"), (2, "upside down")):
        for image in images:
            rotated = np.ascontiguousarray(np.rot90(image, -quarters))
            if _people(rotated, detector, network):
                return InputError(
                    "person", expected="upright", got=f"lying, head to the {name}" if quarters != 2 else name
                )
    return InputError("person", expected="one in the video", got="none")
