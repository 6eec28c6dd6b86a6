"""Overlapped stages: the order, the exceptions, and that they do overlap."""

from __future__ import annotations

import threading

import pytest

from rnd_viewer.play.pipeline import run


@pytest.mark.parametrize("count", [0, 1, 2, 7])
def test_every_frame_goes_through_every_stage_in_order(count):
    encoded, drawn, written = [], [], []

    def encode(number):
        encoded.append(number)
        return f"encoded {number}"

    def draw(number, values):
        assert values == f"encoded {number}" and threading.current_thread() is threading.main_thread()
        drawn.append(number)
        return f"drawn {number}"

    def write(number, frame):
        assert frame == f"drawn {number}"
        written.append(number)

    numbers = list(run(range(5, 5 + count), encode, draw, write))
    assert numbers == encoded == drawn == written == list(range(5, 5 + count))


def test_the_next_frame_is_encoded_and_the_last_written_while_one_is_drawn():
    """Drawing frame 1 waits for the encoding of frame 2 to begin and the writing of frame 0 to end."""
    begun, ended = {k: threading.Event() for k in range(4)}, {k: threading.Event() for k in range(4)}

    def draw(number, _):
        if number == 1:
            assert begun[2].wait(10) and ended[0].wait(10)

    list(run(range(4), lambda k: begun[k].set(), draw, lambda k, _: ended[k].set()))
    assert ended[3].is_set()


def test_one_frame_is_encoded_ahead_and_no_more():
    """Two frames ahead it would only wait longer."""
    begun = {k: threading.Event() for k in range(6)}

    def draw(number, _):
        assert number + 2 not in begun or not begun[number + 2].wait(0.05)

    assert list(run(range(6), lambda k: begun[k].set(), draw, lambda *_: None)) == list(range(6))


@pytest.mark.parametrize("stage", ["encode", "draw", "write"])
def test_what_a_stage_raises_arrives_and_what_was_drawn_is_written(stage):
    drawn, written = [], []

    def fail(name, number):
        if name == stage and number == 3:
            raise ValueError(f"{name} {number}")

    def draw(number, _):
        fail("draw", number)
        drawn.append(number)

    def write(number, _):
        fail("write", number)
        written.append(number)

    with pytest.raises(ValueError, match=f"{stage} 3"):
        list(run(range(9), lambda number: fail("encode", number), draw, write))
    assert written[:3] == [0, 1, 2]
    if stage != "write":
        assert written == drawn == [0, 1, 2]
