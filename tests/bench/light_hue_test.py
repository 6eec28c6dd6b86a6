"""The hue of a light: the level does not count, colours count by direction."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from rnd_bench.studies.light_hue import hue_difference
from rnd_bench.studies.trainings import _light_error
from rnd_runtime.capture.capture import load_capture
from rnd_runtime.shading.light import Light, texel_directions
from support.paths import ASSETS

WHITE = np.ones((16, 32, 3), np.float32)


def test_a_brighter_light_has_the_same_hue() -> None:
    assert hue_difference(3.0 * WHITE.astype(float), Light(WHITE)) == pytest.approx(0, abs=0.01)


def test_a_light_of_another_colour_differs_by_its_lab_distance() -> None:
    green = WHITE * [0.5, 1.0, 0.5]
    to_xyz = [[0.41246, 0.35758, 0.18044], [0.21267, 0.71515, 0.07218], [0.01933, 0.11919, 0.95030]]  # IEC 61966-2-1
    x, y, z = np.cbrt(to_xyz @ green[0, 0] * 0.5 / (to_xyz @ green[0, 0])[1] / [0.95047, 1, 1.08883])
    assert hue_difference(green, Light(WHITE)) == pytest.approx(np.hypot(500 * (x - y), 200 * (y - z)), abs=0.1)


def test_the_same_colours_from_other_sides_differ() -> None:
    left, right = WHITE.copy(), WHITE.copy()
    left[:, :16, 0] *= 2
    right[:, 16:, 0] *= 2
    assert hue_difference(left, Light(right)) > 5
    assert hue_difference(left, Light(left)) == pytest.approx(0, abs=0.01)


def test_a_studys_rows_have_it_where_the_true_light_is_known():
    known = load_capture(ASSETS / "capture")
    light = known.load_light(known.split("train")[0].light).resized(32, 64)
    learned = torch.from_numpy(2 * light.sample(texel_directions(32, 64)))
    checkpoint = SimpleNamespace(probe_of=lambda name: learned)
    assert _light_error(checkpoint, known) == {"light_hue_de": pytest.approx(0, abs=0.01)}
    unknown = SimpleNamespace(split=lambda name: [SimpleNamespace(light=None)])
    assert _light_error(checkpoint, unknown) == {}
