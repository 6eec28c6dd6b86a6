"""Pickles that other programs wrote, read as data: nothing that a file names is imported, called or built.

A pickle is a program for a small stack machine. Here that machine never calls anything: a class or function
that the file names stays a name, and calling it leaves a note of its arguments. Afterwards the notes that we
know (numpy and torch arrays, scipy's compressed sparse columns, chumpy's wrappers, ordered dictionaries) are
understood as plain data, and any other is an error. Neither numpy's, joblib's, torch's nor chumpy's code runs.

Whatever the file expands to is taken from its ``Budget`` before it is allocated; what refers to one part many times
counts by what copies of it would fill.
"""

from __future__ import annotations

import bz2
import gzip
import io
import lzma
import math
import pickle  # noqa: TID251  # only its stack machine, with every call taken out
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, BinaryIO, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.budget import Budget
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import existing_file
from rnd_runtime.core.npz import array_bytes, array_header, check_member

_READ_ERRORS = (
    *(ValueError, OSError, EOFError, KeyError, IndexError, TypeError, AttributeError, AssertionError),
    *(OverflowError, RecursionError, NotImplementedError, UnicodeError, ImportError),
    *(zlib.error, lzma.LZMAError, zipfile.BadZipFile, pickle.UnpicklingError, RuntimeError),
    *(struct.error, tokenize.TokenError, SyntaxError, LookupError),
)
_TORCH_DTYPES = {
    **{"Double": "f8", "Float": "f4", "Half": "f2", "Long": "i8", "Int": "i4", "Short": "i2", "Char": "i1"},
    **{"Byte": "u1", "Bool": "?"},
}
_STORAGE = "torch.storage"  # our note for a storage whose bytes come later
_TORCH_MAGIC = 0x1950A86A20F9469CFC6C
_ARRAY_KINDS = "biufcSUO"
_STEP = 1 << 20  # bytes that are decompressed at a time
_MAX_DICTIONARY = 256 << 20  # bytes that an LZMA file may ask for
_MAX_DEPTH = 4  # torch files within one another; torch writes one
_CODECS = ("latin1", "latin-1", "iso-8859-1", "utf-8", "utf8", "ascii")
_LARGEST_KEY = 1 << 60  # larger numbers can be made to share their hash: a dictionary of them is quadratic

# About the bytes that an opcode fills, whatever it reads: an element of a list, or an object of its own
_ELEMENT, _OBJECT = 16, 100
_OBJECTS = {
    *(pickle.MARK, pickle.EMPTY_DICT, pickle.EMPTY_LIST, pickle.EMPTY_SET, pickle.DICT, pickle.LIST, pickle.TUPLE),
    *(pickle.TUPLE1, pickle.TUPLE2, pickle.TUPLE3, pickle.FROZENSET, pickle.PUT, pickle.BINPUT, pickle.LONG_BINPUT),
    *(pickle.MEMOIZE, pickle.GLOBAL, pickle.STACK_GLOBAL, pickle.REDUCE, pickle.NEWOBJ, pickle.NEWOBJ_EX),
    *(pickle.INST, pickle.OBJ, pickle.BUILD),
}


def read_pickle(path: str | Path, *, what: str = "pickle") -> Any:
    """What a .pkl, .pt or .npy holds, as dicts, lists, tuples, strings, numbers and numpy arrays.

    Reads pickles of every protocol (Python 2's strings as Latin-1), joblib's files, plain or compressed,
    torch's zip files, and the arrays of Python objects that numpy saves (one without axes is its content,
    any other a nested list). Sparse matrices come out dense, torch's tensors as arrays.

    Raises:
        InputError: for a damaged file, one that needs an object of a class unknown to us, or one that expands to more
            than its budget.
    """
    path = existing_file(path, what=what)
    try:
        content = path.read_bytes()
        return _Reader(Budget.of(path)).read(content)
    except InputError as error:
        raise error.at(file=path) from error
    except _READ_ERRORS as error:
        raise InputError(f"{what} cannot be read", got=f"{type(error).__name__}: {error}", file=path) from error


class _Reader:
    """Reads one file, and files within it, on one budget."""

    def __init__(self, budget: Budget) -> None:
        self.budget = budget
        self._depth = 0
        self._within: dict[int, tuple[bytes, Any]] = {}  # by the id of their bytes

    def read(self, content: bytes) -> Any:
        """The meaning of a whole file."""
        magic = content[:6]
        if magic[:4] == b"PK\x03\x04":
            return self._torch(content)
        if magic == b"\x93NUMPY":
            return self._npy(io.BytesIO(content))
        if magic[:2] in _EXPANDERS:
            content = self._expanded(_EXPANDERS[magic[:2]](content))
        stream = io.BytesIO(content)
        made = self._machine(stream).load()
        if isinstance(made, int) and made == _TORCH_MAGIC:
            return self._old_torch(stream)
        return self.understood(made)

    def within(self, content: bytes) -> Any:
        """The meaning of a file within the file, read once."""
        if id(content) in self._within:
            return self._within[id(content)][1]
        if self._depth == _MAX_DEPTH:
            raise InputError("torch files within one another", expected=f"at most {_MAX_DEPTH}", got="more")
        self.budget.take(len(content), "torch file")
        self._depth += 1
        meaning = self.read(content)
        self._depth -= 1
        self._within[id(content)] = content, meaning
        return meaning

    def understood(self, made: Any) -> Any:
        """The meaning of ``made``, which copies of its shared parts would not take beyond the budget."""
        meaning = _understand(made, {}, self)
        self.check_size(meaning)
        return meaning

    def check_size(self, meaning: Any) -> None:
        """Raise ``InputError`` where ``meaning`` is more than the budget once its shared parts are copied."""
        size = _copied_size(meaning, {})
        if size > self.budget.limit:
            raise InputError(
                "data that repeats its parts",
                expected=f"at most {self.budget.limit >> 20} MB of copies",
                got=f"{size >> 20} MB" if size < 1 << 60 else "more than any memory",
                hint="--max-expand-mb N allows more",
            )

    def _expanded(self, pieces: Iterator[bytes]) -> bytes:
        whole = io.BytesIO()
        for piece in pieces:
            self.budget.take(len(piece), "compressed data")
            whole.write(piece)
        return whole.getvalue()

    def _machine(self, stream: io.BytesIO, storage: Callable[[object], Any] | None = None) -> _Machine:
        return _Machine(stream, self, storage)

    def _npy(self, stream: io.BytesIO) -> Any:
        shape, dtype = array_header(stream)
        if dtype.hasobject:
            return self.understood(self._machine(stream).load())
        self.budget.take(array_bytes(shape, dtype), "array")
        stream.seek(0)
        return np.lib.format.read_array(stream, allow_pickle=False)

    def _torch(self, content: bytes) -> Any:
        """A torch zip file: ``NAME/data.pkl`` beside ``NAME/data/KEY``, the tensors' bytes."""
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            held = archive.namelist()
            names = [name for name in held if name.endswith("data.pkl")]
            if len(names) != 1:
                raise InputError("torch file", expected="one data.pkl", got=f"{len(names)}")
            folder = names[0].removesuffix("data.pkl")

            def member(name: str) -> bytes:
                check_member(archive, name, self.budget)
                return archive.read(name)

            order = member(folder + "byteorder").decode() if folder + "byteorder" in held else "little"
            sign: Literal[">", "<"] = ">" if order == "big" else "<"
            storages: dict[object, bytes] = {}

            def storage(key: object) -> NDArray[np.generic]:
                dtype, key = _torch_storage(key)
                if key not in storages:
                    storages[key] = member(f"{folder}data/{key}")
                return np.frombuffer(storages[key], dtype.newbyteorder(sign))

            return self.understood(self._machine(io.BytesIO(member(names[0])), storage).load())

    def _old_torch(self, stream: io.BytesIO) -> Any:
        """What torch wrote before its zip files, and still puts into other pickles; the magic number is already read.

        Protocol, machine, content and the storages' keys are pickles; then every storage's length and bytes follow.
        """
        storages: dict[object, _Made] = {}

        def storage(key: object) -> _Made:
            dtype, key = _torch_storage(key)
            return storages.setdefault(key, _Made(_Name(*_STORAGE.split(".")), (dtype,)))

        for _ in range(2):
            self._machine(stream).load()
        content = self._machine(stream, storage).load()
        keys = self._machine(stream).load()
        _check_keys(keys)
        for key in keys:
            dtype = storages[key].args[0].newbyteorder("<")
            count = int.from_bytes(stream.read(8), "little", signed=True)
            storages[key].state = np.frombuffer(stream.read(max(count, 0) * dtype.itemsize), dtype, count)
        return self.understood(content)


def _gzip(content: bytes) -> Iterator[bytes]:
    return _pieces(gzip.GzipFile(fileobj=io.BytesIO(content)))


def _bzip2(content: bytes) -> Iterator[bytes]:
    return _pieces(bz2.BZ2File(io.BytesIO(content)))


def _pieces(stream: BinaryIO | gzip.GzipFile | bz2.BZ2File) -> Iterator[bytes]:
    return iter(lambda: stream.read(_STEP), b"")


def _zlib(content: bytes) -> Iterator[bytes]:
    machine, left = zlib.decompressobj(), memoryview(content)
    while not machine.eof:
        feed = machine.unconsumed_tail or bytes(left[:_STEP])
        left = left if machine.unconsumed_tail else left[_STEP:]
        if not feed:
            raise EOFError("compressed data without an end")
        yield machine.decompress(feed, _STEP)


def _lzma(content: bytes) -> Iterator[bytes]:
    machine = lzma.LZMADecompressor(memlimit=_MAX_DICTIONARY)
    while not machine.eof:
        piece = machine.decompress(content, _STEP)
        if not piece and machine.needs_input and not machine.eof:
            raise EOFError("compressed data without an end")
        content = b""
        yield piece


_EXPANDERS: dict[bytes, Callable[[bytes], Iterator[bytes]]] = {
    **{b"\x1f\x8b": _gzip, b"BZ": _bzip2, b"\xfd7": _lzma, b"]\0": _lzma},
    **dict.fromkeys((b"x\x01", b"x\x5e", b"x\x9c", b"x\xda"), _zlib),
}


def _torch_storage(key: object) -> tuple[np.dtype[Any], object]:
    """Element type and key of a storage that a torch file refers to."""
    kind, element, name_of_data = key[:3] if isinstance(key, tuple) and len(key) >= 3 else (None, None, None)
    name = element.name.removesuffix("Storage") if isinstance(element, _Name) else ""
    if kind != "storage" or name not in _TORCH_DTYPES or not isinstance(name_of_data, str | int):
        raise InputError("torch tensor", expected=f"one of {', '.join(_TORCH_DTYPES)}", got=name or _shown(key))
    return np.dtype(_TORCH_DTYPES[name]), name_of_data


def _shown(value: object) -> str:
    """``value`` for a message; the text of lists that hold one another can be endless."""
    return str(value)[:100] if isinstance(value, str | int | float) else f"a {type(value).__name__}"


class _Name:
    """A class or function that the file names."""

    __slots__ = ("module", "name")

    def __init__(self, module: str, name: str) -> None:
        self.module, self.name = module, name

    def __str__(self) -> str:
        return f"{self.module}.{self.name}"


class _Made:
    """A call that the file asks for and does not get: what was to be called, and with what."""

    __slots__ = ("args", "items", "state", "what")

    def __init__(self, what: object, args: object) -> None:
        self.what = what
        self.args: Any = args
        self.state: Any = None
        self.items: dict[Any, Any] = {}

    def __setitem__(self, key: Any, value: Any) -> None:
        self.items[key] = value


# Python's own machine, in Python: its twin in C cannot be overridden. Typeshed shows neither's parts.
_PlainMachine: Any = pickle._Unpickler


class _Machine(_PlainMachine):
    """The stack machine without its calls."""

    dispatch: ClassVar[dict[int, Any]] = dict(_PlainMachine.dispatch)

    def __init__(self, stream: io.BytesIO, reader: _Reader, storage: Callable[[object], Any] | None = None) -> None:
        super().__init__(stream, encoding="latin1")  # reads of a stream in memory never allocate more than is left
        self._stream, self._reader, self._storage = stream, reader, storage
        self.budget = reader.budget

    def find_class(self, module: str, name: str) -> _Name:
        return _Name(module, name)

    def persistent_load(self, pid: object) -> Any:
        if self._storage is None:
            raise InputError("reference to data outside the file", got=_shown(pid))
        return self._storage(pid)

    def get_extension(self, code: int) -> None:
        raise InputError("copyreg extension", got=code)

    def _instantiate(self, klass: object, args: object) -> None:
        self.append(_Made(klass, args))

    def load_reduce(self) -> None:
        args = self.stack.pop()
        self.stack[-1] = _Made(self.stack[-1], args)

    def load_newobj_ex(self) -> None:
        self.stack.pop()  # keywords
        self.load_reduce()

    def load_build(self) -> None:
        state, made = self.stack.pop(), self.stack[-1]
        if not isinstance(made, _Made):
            raise InputError("state for something that is not an object", got=type(made).__name__)
        made.state = state
        if isinstance(made.what, _Name) and str(made.what) == "joblib.numpy_pickle.NumpyArrayWrapper":
            self.stack[-1] = self._joblib_array(self._reader.understood(state))

    def load_bytearray8(self) -> None:
        size = int.from_bytes(self.read(8), "little")
        content = self.read(size)
        if len(content) < size:
            raise EOFError(f"{size} bytes announced, {len(content)} left")
        self.append(bytearray(content))

    def load_setitem(self) -> None:
        _check_keys(self.stack[-2:-1])
        _PlainMachine.load_setitem(self)

    def load_setitems(self) -> None:
        _check_keys(self.stack[::2])
        _PlainMachine.load_setitems(self)

    def load_dict(self) -> None:
        _check_keys(self.stack[::2])
        _PlainMachine.load_dict(self)

    def load_additems(self) -> None:
        _check_keys(self.stack)
        _PlainMachine.load_additems(self)

    def load_frozenset(self) -> None:
        _check_keys(self.stack)
        _PlainMachine.load_frozenset(self)

    dispatch[pickle.BYTEARRAY8[0]] = load_bytearray8
    dispatch[pickle.SETITEM[0]], dispatch[pickle.SETITEMS[0]] = load_setitem, load_setitems
    dispatch[pickle.DICT[0]], dispatch[pickle.ADDITEMS[0]] = load_dict, load_additems
    dispatch[pickle.FROZENSET[0]] = load_frozenset
    dispatch[pickle.REDUCE[0]] = dispatch[pickle.NEWOBJ[0]] = load_reduce
    dispatch[pickle.NEWOBJ_EX[0]] = load_newobj_ex
    dispatch[pickle.BUILD[0]] = load_build

    def _joblib_array(self, wrapper: dict[str, Any]) -> Any:
        """The array whose bytes joblib puts into the pickle behind its wrapper."""
        dtype, shape = wrapper["dtype"], tuple(wrapper["shape"])
        if dtype.hasobject:
            return _Machine(self._stream, self._reader).load()
        if wrapper.get("numpy_array_alignment_bytes") is not None:
            self._stream.read(self._stream.read(1)[0])
        size = math.prod(map(int, shape)) * dtype.itemsize
        if size < 0:
            raise InputError("shape of an array", got=shape)
        return np.frombuffer(self._stream.read(size), dtype).reshape(shape, order=wrapper["order"])


def _counted(load: Callable[[Any], Any], cost: int) -> Callable[[Any], Any]:
    """The opcode ``load``, whose ``cost`` is taken from the budget first."""

    def counted(machine: _Machine) -> None:
        budget = machine.budget
        budget.left -= cost
        if budget.left < 0 or budget.left & _TIMES < cost:
            budget.take(0, "pickle")
        load(machine)

    return counted


_TIMES = 0xFFFF  # the time is looked at about once in as many bytes
for _code, _load in list(_Machine.dispatch.items()):
    if _code != pickle.STOP[0]:
        _Machine.dispatch[_code] = _counted(_load, _OBJECT if bytes([_code]) in _OBJECTS else _ELEMENT)


def _check_keys(keys: Iterable[Any]) -> None:
    """Raise ``InputError`` unless ``keys`` are what a dictionary finds in constant time."""
    for key in keys:
        if isinstance(key, tuple):
            if any(isinstance(part, tuple | frozenset) for part in key):
                raise InputError("key of a dictionary", expected="a string or a number", got="nested tuples")
            _check_keys(key)
        elif isinstance(key, int | float) and not abs(key) < _LARGEST_KEY:
            raise InputError("key of a dictionary", expected="a number below 2^60", got=repr(key)[:40])
        elif isinstance(key, frozenset):
            raise InputError("key of a dictionary", expected="a string or a number", got="a set")


_LEAVES = {float, int, bool, type(None)}  # most of what lists hold


def _understand(value: Any, known: dict[int, tuple[Any, Any]], reader: _Reader) -> Any:
    """``value`` with every note taken for what it means; ``known`` holds (note, meaning) by the note's id."""
    if not isinstance(value, dict | list | tuple | set | frozenset | _Made | _Name):
        return value
    if id(value) in known:
        return known[id(value)][1]
    known[id(value)] = (value, None)  # what holds itself would never end: it reads as None
    reader.budget.take(_OBJECT + _ELEMENT * (0 if isinstance(value, _Made | _Name) else len(value)))
    if isinstance(value, dict):
        keys = [_hashable(_understand(key, known, reader)) for key in value]
        _check_keys(keys)
        meaning: Any = dict(zip(keys, [_understand(item, known, reader) for item in value.values()]))
    elif isinstance(value, list | tuple | set | frozenset):
        items = [item if type(item) in _LEAVES else _understand(item, known, reader) for item in value]
        meaning = items if isinstance(value, list) else tuple(items)
    elif isinstance(value, _Name):
        meaning = str(value)
    elif not isinstance(value.what, _Name):
        raise InputError("call", expected="of a class or function", got=_shown(value.what))
    else:
        args, state, contents = (_understand(part, known, reader) for part in (value.args, value.state, value.items))
        meaning = _meaning(str(value.what), args, state, contents, reader)
    known[id(value)] = (value, meaning)
    return meaning


def _copied_size(value: Any, known: dict[int, tuple[Any, int]]) -> int:
    """Bytes of ``value`` if each reference to a part of it were a copy; ``known`` holds (part, bytes) by id."""
    if isinstance(value, np.ndarray):
        return value.nbytes + _ELEMENT
    if isinstance(value, str | bytes | bytearray):
        return len(value) + _ELEMENT
    if not isinstance(value, dict | list | tuple):
        return _ELEMENT
    if id(value) not in known:
        known[id(value)] = (value, 0)
        parts = [*value.keys(), *value.values()] if isinstance(value, dict) else value
        known[id(value)] = (
            value,
            _ELEMENT + sum(_ELEMENT if type(part) in _LEAVES else _copied_size(part, known) for part in parts),
        )
    return known[id(value)][1]


def _hashable(key: Any) -> Any:
    return key.item() if isinstance(key, np.generic) else key


def _meaning(name: str, args: Any, state: Any, items: dict[Any, Any], reader: _Reader) -> Any:
    """What calling ``name`` would have given."""
    name = name.replace("__builtin__.", "builtins.")  # Python 2's name of it
    module, _, leaf = name.rpartition(".")
    package = module.split(".")[0]
    if name in ("collections.OrderedDict", "collections.defaultdict", "builtins.dict"):
        pairs = next((part for part in args if isinstance(part, list | dict)), {})
        if isinstance(pairs, list):
            _check_keys(pair[0] for pair in pairs)
        reader.budget.take(_OBJECT * len(pairs))
        return {**dict(pairs), **items}
    if name in ("builtins.set", "builtins.frozenset", "builtins.list", "builtins.tuple", "torch.Size"):
        reader.budget.take(_OBJECT * len(args[0]) if args else 0)
        return tuple(args[0]) if args else ()
    if name in ("_codecs.encode", "builtins.bytes", "builtins.bytearray"):
        return _bytes(name, args, reader)
    if package == "pathlib" and leaf in ("PosixPath", "PurePosixPath", "WindowsPath", "PureWindowsPath"):
        reader.budget.take(sum(len(part) + 1 for part in args), "path")
        return "/".join(args)
    if package == "numpy":
        return _numpy(name, leaf, args, state, reader)
    if package == "torch":
        return state if name == _STORAGE else _torch(name, leaf, args, reader)
    if package == "scipy" and leaf == "csc_matrix":
        return _dense(state, reader)
    if module in ("copy_reg", "copyreg") and leaf in ("_reconstructor", "__newobj__"):
        if not isinstance(args[0], str) or module in args[0]:
            raise InputError("object of an unknown class", expected="plain data and arrays", got=_shown(args[0]))
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


def _bytes(name: str, args: Any, reader: _Reader) -> bytes:
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


def _numpy(name: str, leaf: str, args: Any, state: Any, reader: _Reader) -> Any:
    if name == "numpy.dtype":
        if not isinstance(args[0], str):
            raise InputError("dtype", expected="its name", got=_shown(args[0]))
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


def _array(content: Any, dtype: np.dtype[Any], shape: tuple[int, ...], order: Any, reader: _Reader) -> Any:
    reader.budget.take(_ELEMENT * len(content) if dtype.hasobject else len(content), "array")
    if not dtype.hasobject:
        raw = content.encode("latin1") if isinstance(content, str) else content
        return np.frombuffer(raw, dtype).reshape(shape, order=order)
    if len(shape) == 0:
        return content[0]
    array = np.empty(len(content), object)
    for index, item in enumerate(content):  # a slice would broadcast lists over the axes
        array[index] = item
    return array.reshape(shape, order=order).tolist()


def _torch(name: str, leaf: str, args: Any, reader: _Reader) -> Any:
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
        return ":".join(map(_shown, args))
    raise InputError("object of an unknown class", expected="plain data and arrays", got=name)


def _dense(state: dict[str, Any], reader: _Reader) -> NDArray[np.float64]:
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
