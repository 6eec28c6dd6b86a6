"""Overlap the stages of consecutive frames: while one is drawn, the next is encoded and the last is written.

onnxruntime, the compiled kernels and the writers release the GIL. Results and order are those of one thread.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

Encoded = TypeVar("Encoded")
Drawn = TypeVar("Drawn")

_MAX_UNWRITTEN = 2  # frames drawn and not yet written: each takes memory


def run(
    frames: Iterable[int],
    encode: Callable[[int], Encoded],
    draw: Callable[[int, Encoded], Drawn],
    write: Callable[[int, Drawn], None],
) -> Iterator[int]:
    """Take each of ``frames`` through the three stages and yield its number once it is drawn.

    Drawing stays in the caller's thread, where its OpenGL context lives; each stage sees the frames in order. When a
    stage raises, or the caller stops, frames that were drawn before are still written, and the exception propagates.
    """
    with ThreadPoolExecutor(1, "encode") as encoder, _writer(write) as submit:
        encodings = ((number, encoder.submit(encode, number)) for number in frames)  # one ahead: more add latency
        waiting = next(encodings, None)
        while waiting:
            number, encoded = waiting
            values = encoded.result()
            waiting = next(encodings, None)
            submit(number, draw(number, values))
            yield number


@contextmanager
def _writer(write: Callable[[int, Drawn], None]) -> Iterator[Callable[[int, Drawn], None]]:
    """A function that hands a frame to the writing thread; what it was handed is written when the block ends."""
    with ThreadPoolExecutor(1, "write") as executor:
        unwritten: list[Future[None]] = []

        def submit(number: int, frame: Drawn) -> None:
            unwritten.append(executor.submit(write, number, frame))
            while len(unwritten) > _MAX_UNWRITTEN:
                unwritten.pop(0).result()

        yield submit
        for future in unwritten:
            future.result()
