"""What the notes of a pickle mean: numpy and torch arrays, sparse columns, chumpy's wrappers, ordered dictionaries.

The stack machine of ``unpickle`` leaves a note for whatever a file would call. Here the known notes become plain data;
any other is an error. Bytes are taken from the reader's budget before they are allocated.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.budget import Budget
from rnd_runtime.core.errors import InputError

_TORCH_DTYPES = {
    **{"Double": "f8", "Float": "f4", "Half": "f2", "Long": "i8", "Int": "i4", "Short": "i2", "Char": "i1"},
    **{"Byte": "u1", "Bool": "?"},
}
STORAGE = "torch.storage"  # our note for a storage whose bytes come later
_ARRAY_KINDS = "biufcSUO"
_CODECS = ("latin1", "latin-1", "iso-8859-1", "utf-8", "utf8", "ascii")
_LARGEST_KEY = 1 << 60  # larger numbers can be made to share their hash: a dictionary of them is quadratic
# About the bytes that an opcode fills, whatever it reads: an element of a list, or an object of its own
ELEMENT, OBJECT = 16, 100


class Reader(Protocol):
    """What the notes need of their reader: its budget, and the meaning of a file within the file."""

    budget: Budget

    def within(self, content: bytes) -> Any:
        """The meaning of ``content``, a file of its own."""

    def check_size(self, meaning: Any) -> None:
        """One error line for a meaning whose copies would not fit the budget."""


def torch_storage(key: object) -> tuple[np.dtype[Any], object]:
    """Element type and key of a storage that a torch file refers to."""
    kind, element, name_of_data = key[:3] if isinstance(key, tuple) and len(key) >= 3 else (None, None, None)
    name = element.name.removesuffix("Storage") if isinstance(element, Name) else ""
    if kind != "storage" or name not in _TORCH_DTYPES or not isinstance(name_of_data, str | int):
        raise InputError("torch tensor", expected=f"one of {', '.join(_TORCH_DTYPES)}", got=name or shown(key))
    return np.dtype(_TORCH_DTYPES[name]), name_of_data


def shown(value: object) -> str:
    """``value`` for a message; the text of lists that hold one another can be endless."""
    return str(value)[:100] if isinstance(value, str | int | float) else f"a {type(value).__name__}"


class Name:
    """A class or function that the file names."""

    __slots__ = ("module", "name")

    def __init__(self, module: str, name: str) -> None:
        self.module, self.name = module, name

    def __str__(self) -> str:
        return f"{self.module}.{self.name}"


class Made:
    """A call that the file asks for and does not get: what was to be called, and with what."""

    __slots__ = ("args", "items", "state", "what")

    def __init__(self, what: object, args: object) -> None:
        self.what = what
        self.args: Any = args
        self.state: Any = None
        self.items: dict[Any, Any] = {}

    def __setitem__(self, key: Any, value: Any) -> None:
        self.items[key] = value


def check_keys(keys: Iterable[Any]) -> None:
    """Raise ``InputError`` unless ``keys`` are what a dictionary finds in constant time."""
    for key in keys:
        if isinstance(key, tuple):
            if any(isinstance(part, tuple | frozenset) for part in key):
                raise InputError("key of a dictionary", expected="a string or a number", got="nested tuples")
            check_keys(key)
        elif isinstance(key, int | float) and not abs(key) < _LARGEST_KEY:
            raise InputError("key of a dictionary", expected="a number below 2^60", got=repr(key)[:40])
        elif isinstance(key, frozenset):
            raise InputError("key of a dictionary", expected="a string or a number", got="a set")


LEAVES = {float, int, bool, type(None)}  # most of what lists hold


def understand(value: Any, known: dict[int, tuple[Any, Any]], reader: Reader) -> Any:
    """``value`` with every note taken for what it means; ``known`` holds (note, meaning) by the note's id."""
    if not isinstance(value, dict | list | tuple | set | frozenset | Made | Name):
        return value
    if id(value) in known:
        return known[id(value)][1]
    known[id(value)] = (value, None)  # what holds itself would never end: it reads as None
    reader.budget.take(OBJECT + ELEMENT * (0 if isinstance(value, Made | Name) else len(value)))
    if isinstance(value, dict):
        keys = [_hashable(understand(key, known, reader)) for key in value]
        check_keys(keys)
        meaning: Any = dict(zip(keys, [understand(item, known, reader) for item in value.values()]))
    elif isinstance(value, list | tuple | set | frozenset):
        items = [item if type(item) in LEAVES else understand(item, known, reader) for item in value]
        meaning = items if isinstance(value, list) else tuple(items)
    elif isinstance(value, Name):
        meaning = str(value)
    elif not isinstance(value.what, Name):
        raise InputError("call", expected="of a class or function", got=shown(value.what))
    else:
        args, state, contents = (understand(part, known, reader) for part in (value.args, value.state, value.items))
        meaning = _meaning(str(value.what), args, state, contents, reader)
    known[id(value)] = (value, meaning)
    return meaning


def copied_size(value: Any, known: dict[int, tuple[Any, int]]) -> int:
    """Bytes of ``value`` if each reference to a part of it were a copy; ``known`` holds (part, bytes) by id."""
    if isinstance(value, np.ndarray):
        return value.nbytes + ELEMENT
    if isinstance(value, str | bytes | bytearray):
        return len(value) + ELEMENT
    if not isinstance(value, dict | list | tuple):
        return ELEMENT
    if id(value) not in known:
        known[id(value)] = (value, 0)
        parts = [*value.keys(), *value.values()] if isinstance(value, dict) else value
        known[id(value)] = (
            value,
            ELEMENT + sum(ELEMENT if type(part) in LEAVES else copied_size(part, known) for part in parts),
        )
    return known[id(value)][1]


def _hashable(key: Any) -> Any:
    return key.item() if isinstance(key, np.generic) else key


def _meaning(name: str, args: Any, state: Any, items: dict[Any, Any], reader: Reader) -> Any:
    """What calling ``name`` would have given."""
    name = name.replace("__builtin__.", "builtins.")  # Python 2's name of it
    module, _, leaf = name.rpartition(".")
    package = module.split(".")[0]
    if name in ("collections.OrderedDict", "collections.defaultdict", "builtins.dict"):
        pairs = next((part for part in args if isinstance(part, list | dict)), {})
        if isinstance(pairs, list):
            check_keys(pair[0] for pair in pairs)
        reader.budget.take(OBJECT * len(pairs))
        return {**dict(pairs), **items}
    if name in ("builtins.set", "builtins.frozenset", "builtins.list", "builtins.tuple", "torch.Size"):
        reader.budget.take(OBJECT * len(args[0]) if args else 0)
        return tuple(args[0]) if args else ()
    if name in ("_codecs.encode", "builtins.bytes", "builtins.bytearray"):
        return _bytes(name, args, reader)
    if package == "pathlib" and leaf in ("PosixPath", "PurePosixPath", "WindowsPath", "PureWindowsPath"):
        reader.budget.take(sum(len(part) + 1 for part in args), "path")
        return "/".join(args)
    if package == "numpy":
        return _numpy(name, leaf, args, state, reader)
    if package == "torch":
        return state if name == STORAGE else _torch(name, leaf, args, reader)
    if package == "scipy" and leaf == "csc_matrix":
        return _dense(state, reader)
    if module in ("copy_reg", "copyreg") and leaf in ("_reconstructor", "__newobj__"):
        if not isinstance(args[0], str) or module in args[0]:
            raise InputError("object of an unknown class", expected="plain data and arrays", got=shown(args[0]))
        return _meaning(args[0], (), state, items, reader)
    if package == "chumpy" and isinstance(state, dict) and "x" in state:
        reader.check_size(state["x"])
        return np.asarray(state["x"])
    if package == "chumpy" and isinstance(state, dict) and {"a", "idxs"} <= state.keys():
        reader.check_size([state["a"], state["idxs"]])
        values, chosen = np.asarray(state["a"]).reshape(-1), np.asarray(state["idxs"])  # chumpy.reordering.Select
        reader.budget.take(chosen.size * values.itemsize, "chumpy selection")
        chosen = values[chosen]
        return chosen.reshape(state.get("preferred_shape") or chosen.shape)
    raise InputError("object of an unknown class", expected="plain data and arrays", got=name)


def _bytes(name: str, args: Any, reader: Reader) -> bytes:
    """What a pickle writes for bytes: themselves, or text and its encoding."""
    content = args[0] if args else b""
    if isinstance(content, str):
        codec = args[1] if len(args) > 1 else "utf-8"
        if codec not in _CODECS:  # others take quadratic time, or expand
            raise InputError("encoding of bytes", expected=" or ".join(_CODECS), got=codec)
        reader.budget.take(4 * len(content), "bytes")
        return content.encode(codec)
    if not isinstance(content, bytes | bytearray):
        return b""
    reader.budget.take(len(content), "bytes")
    return bytes(content)


def _numpy(name: str, leaf: str, args: Any, state: Any, reader: Reader) -> Any:
    if name == "numpy.dtype":
        if not isinstance(args[0], str):
            raise InputError("dtype", expected="its name", got=shown(args[0]))
        dtype = np.dtype(args[0])  # a name such as "f8": fields would come with the state, and are refused
        if dtype.kind not in _ARRAY_KINDS or dtype.names:
            raise InputError("dtype", expected="numbers, strings or objects", got=args[0])
        order: Any = state[1] if state else "="
        return dtype.newbyteorder(order) if order in ("<", ">") else dtype
    if leaf == "_reconstruct":
        _, shape, dtype, fortran, content = state
        return _array(content, dtype, shape, "F" if fortran else "C", reader)
    if leaf == "_frombuffer":
        content, dtype, shape, order = args
        return _array(content, dtype, shape, order, reader)
    if leaf == "scalar":
        return _array(args[1], args[0], (1,), "C", reader)[0]
    raise InputError("object of an unknown class", expected="plain data and arrays", got=name)


def _array(content: Any, dtype: np.dtype[Any], shape: tuple[int, ...], order: Any, reader: Reader) -> Any:
    reader.budget.take(ELEMENT * len(content) if dtype.hasobject else len(content), "array")
    if not dtype.hasobject:
        raw = content.encode("latin1") if isinstance(content, str) else content
        return np.frombuffer(raw, dtype).reshape(shape, order=order)
    if len(shape) == 0:
        return content[0]
    array = np.empty(len(content), object)
    for index, item in enumerate(content):  # a slice would broadcast lists over the axes
        array[index] = item
    return array.reshape(shape, order=order).tolist()


def _torch(name: str, leaf: str, args: Any, reader: Reader) -> Any:
    if leaf in ("_rebuild_tensor_v2", "_rebuild_tensor"):
        storage, offset, size, stride = args[:4]
        if not all(isinstance(number, int) for number in (*size, *stride, offset)):
            raise InputError("torch tensor", expected="whole numbers as size, stride and offset")
        if min((*size, *stride, offset), default=0) < 0:
            raise InputError("torch tensor", expected="no negative size, stride or offset")
        last = offset + sum((count - 1) * step for count, step in zip(size, stride))
        if 0 in size:
            return np.zeros(size, storage.dtype)
        if len(size) != len(stride) or last >= len(storage):
            raise InputError("torch tensor", expected=f"{len(storage)} numbers at most", got=last + 1)
        reader.budget.take(math.prod(size) * storage.itemsize, "torch tensor")
        steps = [step * storage.itemsize for step in stride]
        return np.lib.stride_tricks.as_strided(storage[offset:], size, steps).copy()
    if leaf == "_load_from_bytes":
        return reader.within(args[0])
    if leaf == "_rebuild_parameter":
        return args[0]
    if name == "torch.device":
        return ":".join(map(shown, args))
    raise InputError("object of an unknown class", expected="plain data and arrays", got=name)


def _dense(state: dict[str, Any], reader: Reader) -> NDArray[np.float64]:
    """A sparse matrix in compressed columns (SMPL's joint regressor) with its zeros."""
    reader.check_size(state)
    rows, columns = map(int, state["_shape"] if "_shape" in state else state["shape"])
    counts = np.diff(state["indptr"])
    if min(rows, columns) < 0 or len(counts) != columns:
        raise InputError("sparse matrix", expected=f"{columns} columns", got=f"{len(counts)}")
    if len(counts) and (counts.min() < 0 or counts.sum() != len(state["data"])):
        raise InputError("sparse matrix", expected=f"{len(state['data'])} numbers in its columns", got=counts.sum())
    reader.budget.take(8 * rows * columns, "sparse matrix")
    dense = np.zeros((rows, columns))
    np.add.at(dense, (state["indices"], np.repeat(np.arange(columns), counts)), state["data"])
    return dense
