"""A grey card fixes colour and level of the light; what is no card is refused."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from rnd_runtime.core.errors import InputError
from rnd_trainer.render.shading import traced_visibility
from rnd_trainer.training.lighting import grey_card
from rnd_trainer.training.lighting.grey_card import GreyCard, card_gain
from rnd_trainer.training.lighting.lights import KnownLight, TrainingLights
from rnd_trainer.training.training import Training

FRAME = 2


def _person_pixel(training: Training, capture) -> GreyCard:
    """The middle of the chest in the uncropped image."""
    frame = training.views[FRAME].frame
    mask = capture.load_frame(frame).mask
    rows, columns = np.nonzero(mask > 0.99)
    row = int(np.quantile(rows, 0.4))
    return GreyCard(frame.frame, int(np.median(columns[rows == row])), row)


def test_under_the_gained_light_the_card_reflects_18_percent(tiny_capture, tiny_config, monkeypatch) -> None:
    """Even light and no shadow: the irradiance is π times the radiance, so the gain is colour / 0.18."""
    training = Training(tiny_capture, tiny_config)
    card = _person_pixel(training, tiny_capture)
    view = card.view(training.views)
    row, column = card.pixel(view, tiny_capture.cameras["front"])
    whole = tiny_capture.load_frame(view.frame).image_srgb[card.y, card.x]
    assert np.array_equal(view.image[row, column], np.round(whole * 255))  # the same pixel of the crop
    monkeypatch.setattr(grey_card, "traced_visibility", lambda *args: torch.ones_like(traced_visibility(*args)))
    pose, radiance = training.pose(view), torch.full((32, 64, 3), 2.0)
    gain = card_gain(training.model, view, pose, (row, column), radiance)
    patch = view.image[row - 1 : row + 2, column - 1 : column + 2].astype(float) / 255
    colour = np.where(patch > 0.04045, ((patch + 0.055) / 1.055) ** 2.4, patch / 12.92).mean((0, 1))
    assert np.allclose(gain, colour / (2 * 0.18), rtol=0.02)  # texels are 5.6° wide


def test_the_training_light_is_scaled_by_the_card(tiny_capture, tiny_config) -> None:
    plain = Training(tiny_capture, tiny_config)
    card = _person_pixel(plain, tiny_capture)
    carded = Training(tiny_capture, tiny_config, known=KnownLight(card=card))
    for training in (plain, carded):
        while not training.lit:
            training.step()
    before, after = (training.lights.radiance().detach()[0].mean((0, 1)) for training in (plain, carded))
    assert not torch.allclose(before, after, rtol=0.05)
    pose, view = carded.pose(card.view(carded.views)), card.view(carded.views)
    again = card_gain(carded.model, view, pose, carded._card_pixel, carded.lights.radiance()[0].detach())
    assert np.allclose(again, 1, rtol=1e-3)


def test_what_is_no_card_is_refused(tiny_capture, tiny_config) -> None:
    for text in ("3", "3:1", "a:1,2", "3:1,2,3", "-1:2,3", "1:2.5,3"):
        with pytest.raises(InputError, match="--grey-card: expected FRAME:X,Y"):
            GreyCard.parse(text)
    assert GreyCard.parse("12:340,220") == GreyCard(12, 340, 220)
    for card, expected in ((GreyCard(99, 0, 0), "a training frame, 0 to 5"), (GreyCard(0, 1, 1), "inside the mask")):
        with pytest.raises(InputError, match=f"--grey-card: expected .*{expected}"):
            Training(tiny_capture, tiny_config, known=KnownLight(card=card))


def test_one_place_is_of_one_light(tiny_capture) -> None:
    light = tiny_capture.load_light("white")
    KnownLight(place=light).check(("white",))
    with pytest.raises(InputError, match="--hdr: expected one light in the training images, got noon, dusk"):
        KnownLight(place=light).check(("noon", "dusk"))
    fixed = TrainingLights(("white",))
    fixed.fix()
    assert not fixed.learned and TrainingLights(("white",)).learned


def test_a_training_in_a_known_place_keeps_its_light(tiny_capture, tiny_config) -> None:
    place = tiny_capture.load_light("white")
    training = Training(tiny_capture, dataclasses.replace(tiny_config, steps=8), known=KnownLight(place=place))
    while not training.lit:
        training.step()
    found = training.lights.radiance().detach().clone()
    training.step()
    assert torch.equal(training.lights.radiance(), found) and training.light_found
    assert torch.allclose(found, found.mean(), rtol=1e-3)  # white and even, at the level of the body
    assert "chroma" not in training.step().terms
