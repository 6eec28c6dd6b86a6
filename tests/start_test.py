"""How commands start: garbage waits until what stays is loaded, whatever happens on the way."""

from __future__ import annotations

import gc

import pytest

from rnd_runtime.start import quick_start, settle


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
