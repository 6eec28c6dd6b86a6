"""Skin fixes the colour that light and albedo share; where it was not seen, the body's mean fixes the level alone."""

from __future__ import annotations

import numpy as np
import pytest

from rnd_runtime.capture.capture import load_capture
from rnd_runtime.shading.light import REC709_LUMINANCE
from rnd_trainer.model.model import ALBEDO_RANGE
from rnd_trainer.model.template import sample_template
from rnd_trainer.training.lighting import skin
from support.paths import ASSETS


@pytest.fixture(scope="module")
def template():
    return sample_template(load_capture(ASSETS / "capture").body, 2_000, 250, 0)


def _albedo(rng: np.random.Generator, tone: float) -> tuple[np.ndarray, list[np.ndarray]]:
    """True albedo [200, 3] of blue clothes, and at the last 20 points of skin of reflectance ``tone``: hands, face."""
    clothes = np.array([0.1, 0.2, 0.4]) * rng.uniform(0.7, 1.3, (180, 1))
    colour = np.exp([skin.SKIN_CHROMA[0], 0, skin.SKIN_CHROMA[1]])
    of_skin = tone * colour / (colour @ REC709_LUMINANCE) * rng.uniform(0.9, 1.1, (20, 1))
    return np.concatenate([clothes, of_skin]), [np.arange(180, 190), np.arange(190, 200)]


@pytest.mark.parametrize(
    "light",
    [(1.2, 1.0, 0.7), (0.9, 1.0, 1.3), (1, 1, 1), (2.2, 1.2, 0.5), (0.45, 0.8, 1.6), (1.6, 0.9, 1.4), (0.6, 1.1, 0.7)],
)
def test_skin_of_a_known_tone_gives_level_and_colour(light) -> None:
    true, places = _albedo(np.random.default_rng(0), 0.3)
    learned = 0.6 * true * np.array(light)  # a light that was taken for grey and too bright
    gain = skin.likely_gain(learned, np.ones(len(true)), places, 0.3)
    found = learned * gain / true
    assert np.allclose(found, 1, atol=0.12)
    assert np.allclose(found / found[:, 1:2], 1, atol=0.12)


def test_without_skin_only_the_level_changes() -> None:
    true, _ = _albedo(np.random.default_rng(1), 0.3)
    gain = skin.likely_gain(0.5 * true, np.ones(len(true)), [], None)
    assert np.ptp(gain) == pytest.approx(0, abs=1e-12)
    mean = (0.5 * true * gain @ REC709_LUMINANCE).mean()
    assert mean == pytest.approx(skin.BODY_LUMINANCE)


def test_a_bright_shirt_over_black_trousers_is_no_brighter_than_a_material() -> None:
    rng = np.random.default_rng(3)
    true = np.where(np.arange(200)[:, None] < 140, 0.01, [0.75, 0.1, 0.2]) * rng.uniform(0.9, 1.0, (200, 1))
    gain = skin.likely_gain(2 * true, np.ones(len(true)), [], None)
    assert np.quantile((2 * true * gain).max(1), skin.BRIGHT_SHARE) == pytest.approx(ALBEDO_RANGE[1])


def test_gloves_are_no_skin() -> None:
    true, (hands, face) = _albedo(np.random.default_rng(2), 0.3)
    true[hands] = (0.05, 0.3, 0.05)
    weight = np.ones(len(true))
    of_face = skin.likely_gain(true, weight, [face], 0.3)
    assert np.allclose(skin.likely_gain(true, weight, [hands, face], 0.3), of_face)
    assert np.allclose(skin.likely_gain(true, weight, [hands], 0.3), skin.likely_gain(true, weight, [], None))
    assert not np.allclose(of_face, skin.likely_gain(true, weight, [], None), rtol=0.02)


def test_hands_and_face_are_found_on_the_body(template) -> None:
    body = load_capture(ASSETS / "capture").body
    hands, face = (template.points[indices] for indices in skin.skin_points(template, body.skeleton))
    names, joints = list(body.skeleton.names), body.skeleton.rest_joints
    wrists = joints[[names.index("left_wrist"), names.index("right_wrist")]]
    assert len(hands) >= 10 and (np.linalg.norm(hands[:, None] - wrists, axis=2) < 0.25).any(1).all()
    assert len(face) >= 3 and (face[:, 1:] > joints[names.index("head"), 1:]).all()
