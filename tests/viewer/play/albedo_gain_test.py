"""``--albedo-gain`` multiplies the albedo and keeps it conserving energy."""

from __future__ import annotations

import numpy as np
import pytest

from rnd_runtime.avatar.avatar import Avatar
from rnd_runtime.core.errors import InputError
from rnd_runtime.motion.motion import load_motion
from rnd_runtime.shading.brdf import LARGEST_ALBEDO
from rnd_viewer.inputs.cast import load_people
from rnd_viewer.inputs.options import MotionOptions, PlayOptions, parse_gain
from rnd_viewer.inputs.scenes import PersonRecord
from support.paths import ASSETS


def test_the_gain_multiplies_what_play_loads() -> None:
    plain = Avatar.load(ASSETS / "avatar.onnx")
    cast = [PersonRecord(ASSETS / "avatar.onnx", ASSETS / "walk.npz")]
    person = load_people(cast, MotionOptions(), "1.5,1,0.5")[0]
    motion = load_motion(ASSETS / "walk.npz", plain.skeleton)
    before, after = plain.pose(motion, 0.0).albedo, person.avatar.pose(motion, 0.0).albedo
    assert np.allclose(after, np.minimum(before * [1.5, 1, 0.5], LARGEST_ALBEDO), atol=1e-6)
    assert (after[:, 0] > before[:, 0]).any() and after.max() <= LARGEST_ALBEDO


def test_gains_are_one_or_three_numbers() -> None:
    assert parse_gain("2") == (2, 2, 2) and parse_gain("1,0.5,2") == (1, 0.5, 2)
    for wrong in ("", "1,2", "red", "-1,1,1", "nan", "1,1,1,1", "101"):
        with pytest.raises(InputError, match="--albedo-gain: expected R,G,B or one number"):
            parse_gain(wrong)
    with pytest.raises(InputError, match="--albedo-gain"):
        type(PlayOptions().lighting)(albedo_gain="1,2")
