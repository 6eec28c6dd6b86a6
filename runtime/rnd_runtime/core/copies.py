"""Shallow copies of objects that change from frame to frame."""

from __future__ import annotations

from typing import Any, TypeVar

T = TypeVar("T")


def shallow_copy(original: T, **changes: Any) -> T:
    """A copy of an object, frozen or not, with other attributes; no check of its class runs."""
    copied = object.__new__(type(original))
    copied.__dict__.update(original.__dict__, **changes)
    return copied
