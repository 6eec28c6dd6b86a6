"""Random damage to valid files, sampled by hypothesis: to their bytes, or below their outer layer."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable
from typing import Any

import numpy as np
from hypothesis import strategies as st

HOSTILE: tuple[Any, ...] = (
    *(None, True, -1, 0, 1e308, float("nan"), 10**30, [], {}, [[[[[[]]]]]], {"__class__": "os.system"}),
    *("", "../../outside.txt", "/etc/passwd", "a\0b", "\ud800", "x" * 10_000),
)


def damage(draw: Any, honest: bytes, inner: Callable[[bytes, Any], bytes] | None) -> bytes:
    """A broken copy; ``draw`` is hypothesis' data.draw."""
    if inner is not None and draw(st.booleans()):
        return inner(honest, draw)
    data = bytearray(honest)
    for _ in range(draw(st.integers(1, 4))):
        kind = draw(st.sampled_from(("flip", "write", "cut", "insert", "repeat")))
        # half of the damage goes to the head, where the structure is
        reach = min(len(data), 256) if draw(st.booleans()) else len(data)
        start = draw(st.integers(0, max(reach - 1, 0)))
        if not data:
            break
        if kind == "flip":
            data[start] ^= 1 << draw(st.integers(0, 7))
        elif kind == "write":
            given = draw(st.sampled_from((b"\xff\xff\xff\x7f", b"\0\0\0\0", b"\xff" * 8, b"\x80" * 10, b"../../x")))
            data[start : start + len(given)] = given
        elif kind == "cut":
            del data[start:]
        elif kind == "insert":
            data[start:start] = draw(st.binary(min_size=1, max_size=12))
        else:
            data[start:start] = data[start : start + 64]
    return bytes(data)


def json_damage(honest: bytes, draw: Any) -> bytes:
    """JSON with one value replaced by a hostile one, or a key renamed."""
    tree = json.loads(honest)
    slots = list(_slots(tree))
    holder, key = slots[draw(st.integers(0, len(slots) - 1))]
    if isinstance(holder, dict) and draw(st.integers(0, 4)) == 0:
        holder[draw(st.text(max_size=5))] = holder.pop(key)
    else:
        holder[key] = draw(st.sampled_from(HOSTILE))
    return json.dumps(tree).encode("utf-8", "surrogatepass")


def _slots(tree: Any) -> Any:
    """Every (container, key) of a JSON tree."""
    entries = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    for key, value in list(entries):
        yield tree, key
        yield from _slots(value)


def npz_damage(honest: bytes, draw: Any) -> bytes:
    """An archive with valid checksums and one broken member."""
    with zipfile.ZipFile(io.BytesIO(honest)) as source:
        members = {name: source.read(name) for name in source.namelist()}
    name = draw(st.sampled_from(sorted(members)))
    kind = draw(st.sampled_from(("bytes", "shape", "type", "gone", "rename", "random")))
    if kind == "bytes":
        members[name] = damage(draw, members[name], None)
    elif kind == "shape":
        array = np.load(io.BytesIO(members[name]), allow_pickle=False)
        rows = draw(st.integers(-2, 2**62))
        head = f"{{'descr': '{array.dtype.str}', 'fortran_order': False, 'shape': ({rows}, 3), }}"
        members[name] = b"\x93NUMPY\x01\x00" + len(head).to_bytes(2, "little") + head.encode() + b"\0" * 64
    elif kind == "type":
        others = (np.array(["a"]), np.array(1j), np.zeros((0, 3)), np.array(np.nan), np.zeros((2, 2, 2, 2)))
        members[name] = _npy(draw(st.sampled_from(others)))
    elif kind == "gone":
        del members[name]
    elif kind == "rename":
        members[draw(st.sampled_from(("../../x.npy", "/etc/x.npy", "betas.npy", "Rh.npy")))] = members.pop(name)
    else:
        array = np.load(io.BytesIO(members[name]), allow_pickle=False)
        if array.dtype.kind in "fiu" and array.size:
            array = array.copy()
            extreme = draw(st.sampled_from((np.nan, np.inf, -1, 1e30, 2**31 - 1)))
            with np.errstate(all="ignore"):
                array.flat[draw(st.integers(0, array.size - 1))] = np.array(extreme).astype(array.dtype)
            members[name] = _npy(array)
    result = io.BytesIO()
    with zipfile.ZipFile(result, "w") as target:
        for member, content in members.items():
            target.writestr(member, content)
    return result.getvalue()


def _npy(array: np.ndarray) -> bytes:
    made = io.BytesIO()
    np.save(made, array)
    return made.getvalue()


def safetensors_damage(honest: bytes, draw: Any) -> bytes:
    """A safetensors file with a broken JSON header of the right length."""
    size = int.from_bytes(honest[:8], "little")
    head = json_damage(honest[8 : 8 + size], draw)
    return len(head).to_bytes(8, "little") + head + honest[8 + size :]
