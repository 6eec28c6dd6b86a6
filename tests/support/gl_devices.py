"""What the tests of a module keep on EGL's context and on OSMesa's."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest

from rnd_runtime.gl.context import create_context

BACKENDS = ("egl", "osmesa")


class Device:
    """A context and the parts on it, each made of the context by its class in ``kinds``."""

    def __init__(self, backend: str, kinds: dict[str, Callable[..., Any]]) -> None:
        self.context = create_context(backend)
        with self.context:
            self.parts = {name: make(self.context) for name, make in kinds.items()}

    def __getattr__(self, name: str) -> Any:
        return self.parts[name]

    def close(self) -> None:
        with self.context:
            for part in self.parts.values():
                part.release()
        self.context.release()


def devices(**kinds: Callable[..., Any]) -> Any:
    """A module's fixture ``devices``: one of these for each of ``BACKENDS``."""

    @pytest.fixture(scope="module")
    def made() -> Iterator[dict[str, Device]]:
        each = {backend: Device(backend, kinds) for backend in BACKENDS}
        yield each
        for device in each.values():
            device.close()

    return made
