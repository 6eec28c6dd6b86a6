"""How commands start: garbage waits until what stays is loaded, whatever happens on the way."""

from __future__ import annotations

import gc

import numpy as np
import pytest

from rnd_runtime.avatar.avatar import Avatar
from rnd_runtime.core.errors import InputError
from rnd_runtime.playback.start import quick_start, settle
from support.tiny import body, motion


@pytest.fixture(autouse=True)
def _as_it_was():
    yield
    gc.enable()
    gc.unfreeze()


def test_nothing_is_collected_until_it_settles():
    with quick_start():
        assert not gc.isenabled()
        settle()
        assert gc.isenabled()
        assert gc.get_freeze_count() > 1000
    assert gc.isenabled()
    assert gc.get_freeze_count() == 0


def test_collects_again_after_a_failure():
    with pytest.raises(KeyError), quick_start():
        raise KeyError
    assert gc.isenabled()


def test_frozen_before_a_failure_is_collected_at_the_end_too():
    with pytest.raises(KeyError), quick_start():
        settle()
        raise KeyError
    assert gc.get_freeze_count() == 0


def test_settling_twice_freezes_once():
    with quick_start():
        settle()
        frozen = gc.get_freeze_count()
        kept = [[] for _ in range(100)]
        settle()
        assert gc.get_freeze_count() == frozen
        assert len(kept) == 100


def test_an_avatars_networks_are_loaded_meanwhile(tiny_avatar):
    with quick_start(tiny_avatar, 1) as ahead:
        avatar, alone = Avatar.load(tiny_avatar, ahead=ahead), Avatar.load(tiny_avatar, threads=1)
    ours, theirs = (each.pose(motion(body()), 0.1) for each in (avatar, alone))
    np.testing.assert_array_equal(ours.means, theirs.means)


def test_what_is_wrong_with_an_avatar_is_told_when_it_is_asked_for(tmp_path):
    with quick_start(tmp_path / "none.onnx") as ahead, pytest.raises(InputError, match=r"none\.onnx"):
        Avatar.load(tmp_path / "none.onnx", ahead=ahead)


def test_nothing_is_loaded_ahead_for_threads_that_will_be_refused(tiny_avatar):
    with quick_start(tiny_avatar, 10**6) as ahead:
        assert ahead is None
