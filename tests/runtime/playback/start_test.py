"""An avatar's networks, loaded while the rest of a command is imported."""

from __future__ import annotations

import numpy as np
import pytest

from rnd_runtime.avatar.avatar import Avatar
from rnd_runtime.core.errors import InputError
from rnd_runtime.playback.start import load_ahead
from support.tiny import body, motion


def test_networks_loaded_ahead_are_those_of_the_file(tiny_avatar):
    avatar, alone = Avatar.load(tiny_avatar, ahead=load_ahead(tiny_avatar, 1)), Avatar.load(tiny_avatar, threads=1)
    means, expected = (each.pose(motion(body()), 0.1).means for each in (avatar, alone))
    np.testing.assert_array_equal(means, expected)


def test_what_is_wrong_with_an_avatar_is_raised_when_it_is_asked_for(tmp_path):
    ahead = load_ahead(tmp_path / "none.onnx")
    with pytest.raises(InputError, match=r"none\.onnx"):
        Avatar.load(tmp_path / "none.onnx", ahead=ahead)


def test_nothing_is_loaded_ahead_for_threads_that_will_be_refused(tiny_avatar):
    assert load_ahead(tiny_avatar, 10**6) is None
