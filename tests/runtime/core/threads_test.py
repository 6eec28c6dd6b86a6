"""Work shared between threads: order, how far ahead, exceptions."""

from __future__ import annotations

import threading

import pytest

from rnd_runtime.core.threads import ahead, cores


def test_results_keep_their_order_and_items_are_taken_as_they_are_needed() -> None:
    taken: list[int] = []

    def items():
        for k in range(50):
            assert threading.current_thread() is threading.main_thread()
            taken.append(k)
            yield k

    for k, result in enumerate(ahead(lambda k: (threading.current_thread().name, k * k), items())):
        assert result[1] == k * k and result[0] != threading.main_thread().name
        assert len(taken) <= k + cores() + 1
    assert k == 49


def test_an_exception_comes_when_its_turn_does_and_ends_the_work() -> None:
    done: list[int] = []

    def work(k: int) -> int:
        if k == 3:
            raise ValueError("three")
        done.append(k)
        return k

    results = ahead(work, range(1000))
    assert [next(results) for _ in range(3)] == [0, 1, 2]
    with pytest.raises(ValueError, match="three"):
        next(results)
    assert len(done) <= 3 + cores() + 1
