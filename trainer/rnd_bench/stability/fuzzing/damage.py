"""Random damage to bytes, text and JSON."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from random import Random  # noqa: TID251  # draws from lists that numpy would convert
from typing import Any

Mutation = Callable[[bytes, Random], bytes]
"""a broken copy of a valid file, damaged below its outer layer"""

HOSTILE: tuple[Any, ...] = (
    *(None, True, -1, 0, 1e308, float("nan"), 10**30, [], {}, [[[[[[]]]]]], {"__class__": "os.system"}),
    *("", "../../outside.txt", "/etc/passwd", "a\0b", "\ud800", "x" * 10_000),
)
WORDS = (
    *("nan", "-1", "0", "1e308", "-1e-308", "inf", str(2**63), str(10**30), "0x1F", "1e", "{", "}", "[", "]", ":"),
    *("", "é", "\x00", "\x1b[2J", "'", '"', "&a [*a, *a]", "!!python/object:os.system", "x" * 10_000, "9" * 5000),
)
_WRITTEN = (b"\xff\xff\xff\x7f", b"\0\0\0\0", b"\xff" * 8, b"\x80" * 10, b"../../x")


def damage(rng: Random, honest: bytes, mutation: Mutation | None) -> bytes:
    """A broken copy of ``honest``: of its bytes or, for half of the copies, by its format's ``mutation``."""
    if mutation is not None and rng.random() < 0.5:
        return mutation(honest, rng)
    data = bytearray(honest)
    for _ in range(rng.randint(1, 4)):
        if not data:
            break
        # half of the damage goes to the head, where the structure is
        start = rng.randrange(min(len(data), 256) if rng.random() < 0.5 else len(data))
        kind = rng.randrange(5)
        if kind == 0:
            data[start] ^= 1 << rng.randrange(8)
        elif kind == 1:
            written = rng.choice(_WRITTEN)
            data[start : start + len(written)] = written
        elif kind == 2:
            del data[start:]
        elif kind == 3:
            data[start:start] = rng.randbytes(rng.randint(1, 12))
        else:
            data[start:start] = data[start : start + 64]
    return bytes(data)


def damaged_text(honest: bytes, rng: Random) -> bytes:
    """Text with one word replaced, or one line lost, repeated or moved."""
    lines = honest.decode("latin1").split("\n")
    row = rng.randrange(len(lines))
    kind = rng.randrange(6)
    if kind == 0:
        del lines[row]
    elif kind == 1:
        lines[row:row] = [lines[row]] * rng.choice((1, 2, 1000))
    elif kind == 2:
        lines.insert(rng.randrange(len(lines)), lines.pop(row))
    else:
        words = lines[row].split(" ")
        words[rng.randrange(len(words))] = rng.choice(WORDS)
        lines[row] = " ".join(words)
    return "\n".join(lines).encode("utf-8" if rng.random() < 0.5 else "latin1", "replace")


def damaged_json(honest: bytes, rng: Random) -> bytes:
    """JSON with one value replaced by a hostile one, or a key renamed."""
    tree = json.loads(honest)
    slots = list(_slots(tree))
    holder, key = rng.choice(slots)
    if isinstance(holder, dict) and rng.random() < 0.2:
        holder["".join(chr(rng.randrange(1, 0xD000)) for _ in range(rng.randint(0, 5)))] = holder.pop(key)
    else:
        holder[key] = rng.choice(HOSTILE)
    return json.dumps(tree).encode("utf-8", "surrogatepass")


def damaged_json_lines(honest: bytes, rng: Random) -> bytes:
    """As ``damaged_json``, in one line of several."""
    lines = honest.splitlines()
    row = rng.randrange(len(lines))
    lines[row] = damaged_json(lines[row], rng)
    return b"\n".join(lines) + b"\n"


def _slots(tree: Any) -> Iterator[tuple[Any, Any]]:
    """Every (container, key) of a JSON tree."""
    entries = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    for key, value in list(entries):
        yield tree, key
        yield from _slots(value)
