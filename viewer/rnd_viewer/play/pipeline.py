"""Overlapping the stages of consecutive frames: while one is drawn, the next is encoded and the last is written.

onnxruntime, the compiled kernels and the writers all let go of Python's lock, so three threads fill the gaps in which a
stage keeps one core busy. What comes out, and in which order, is what one thread would make.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

Encoded = TypeVar("Encoded")
Drawn = TypeVar("Drawn")

_AHEAD = 1  # frames encoded before they are drawn: more would only delay them
_BEHIND = 2  # frames drawn and not yet written: what they hold is memory


def run(
    frames: Iterable[int],
    encode: Callable[[int], Encoded],
    draw: Callable[[int, Encoded], Drawn],
    write: Callable[[int, Drawn], None],
    *,
    overlap: bool = True,
) -> Iterator[int]:
    """Take each of ``frames`` through the three stages and yield its number once it is drawn.

    Drawing stays in the caller's thread, where its OpenGL context lives; each stage sees the frames in order. When a
    stage raises, or the caller stops, frames that were drawn before are still written, and the exception goes on.
    """
    if not overlap:
        for number in frames:
            write(number, draw(number, encode(number)))
            yield number
        return
    numbers = iter(frames)
    with ThreadPoolExecutor(1, "encode") as encoder, _writer(write) as submit:
        waiting: list[tuple[int, Future[Encoded]]] = []

        def fill() -> None:
            while len(waiting) < _AHEAD and (number := next(numbers, None)) is not None:
                waiting.append((number, encoder.submit(encode, number)))

        fill()
        while waiting:
            number, encoded = waiting.pop(0)
            values = encoded.result()
            fill()
            submit(number, draw(number, values))
            yield number


@contextmanager
def _writer(write: Callable[[int, Drawn], None]) -> Iterator[Callable[[int, Drawn], None]]:
    """A function that hands a frame to the writing thread; what it was handed is written when the block ends."""
    with ThreadPoolExecutor(1, "write") as executor:
        unwritten: list[Future[None]] = []

        def submit(number: int, frame: Drawn) -> None:
            unwritten.append(executor.submit(write, number, frame))
            while len(unwritten) > _BEHIND:
                unwritten.pop(0).result()

        yield submit
        for future in unwritten:
            future.result()
