"""Decay of the learning rates."""

from __future__ import annotations

import dataclasses

import pytest

from rnd_trainer.config import preset
from rnd_trainer.training.schedule import Schedule


@pytest.mark.parametrize("name", ["quick", "standard", "full"])
def test_rates_stay_high_until_the_last_steps_and_never_rise(name) -> None:
    config = preset(name)
    schedule, steps = Schedule(config), config.steps
    rates = [schedule.decay(step) for step in range(steps)]
    assert rates[0] == 1 and rates == sorted(rates, reverse=True)
    begun = round((1 - config.cooling_fraction) * steps)
    assert rates[begun] == pytest.approx(config.rate_final ** (begun / steps))
    assert rates[-1] == pytest.approx(config.rate_final * config.rate_cooled, rel=15 / steps)  # a step before the end
    third = [schedule.decay(step) for step in range(steps, schedule.total)]
    assert third[0] == 1 and third == sorted(third, reverse=True)
    assert third[-1] == pytest.approx(0.1, rel=0.02)


def test_rates_may_fall_without_an_end_of_their_own() -> None:
    schedule = Schedule(dataclasses.replace(preset("standard"), cooling_fraction=0.0))
    assert schedule.decay(schedule.config.steps - 1) == pytest.approx(0.5, rel=1e-3)
