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
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.budget import Budget
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import existing_file
from rnd_runtime.core.npz import array_bytes, array_header, check_member

from .pickle_values import (
    ELEMENT,
    OBJECT,
    STORAGE,
    Made,
    Name,
    check_keys,
    copied_size,
    shown,
    torch_storage,
    understand,
)

_READ_ERRORS = (
    *(ValueError, OSError, EOFError, KeyError, IndexError, TypeError, AttributeError, AssertionError),
    *(OverflowError, RecursionError, NotImplementedError, UnicodeError, ImportError),
    *(zlib.error, lzma.LZMAError, zipfile.BadZipFile, pickle.UnpicklingError, RuntimeError),
    *(struct.error, tokenize.TokenError, SyntaxError, LookupError),
)
_TORCH_MAGIC = 0x1950A86A20F9469CFC6C
_STEP = 1 << 20  # bytes that are decompressed at a time
_MAX_DICTIONARY = 256 << 20  # bytes that an LZMA file may ask for
_MAX_DEPTH = 4  # torch files within one another; torch writes one

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
        return Reader(Budget.of(path)).read(content)
    except InputError as error:
        raise error.at(file=path) from error
    except _READ_ERRORS as error:
        raise InputError(f"{what} cannot be read", got=f"{type(error).__name__}: {error}", file=path) from error


class Reader:
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
        meaning = understand(made, {}, self)
        self.check_size(meaning)
        return meaning

    def check_size(self, meaning: Any) -> None:
        """Raise ``InputError`` where ``meaning`` is more than the budget once its shared parts are copied."""
        size = copied_size(meaning, {})
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
                dtype, key = torch_storage(key)
                if key not in storages:
                    storages[key] = member(f"{folder}data/{key}")
                return np.frombuffer(storages[key], dtype.newbyteorder(sign))

            return self.understood(self._machine(io.BytesIO(member(names[0])), storage).load())

    def _old_torch(self, stream: io.BytesIO) -> Any:
        """What torch wrote before its zip files, and still puts into other pickles; the magic number is already read.

        Protocol, machine, content and the storages' keys are pickles; then every storage's length and bytes follow.
        """
        storages: dict[object, Made] = {}

        def storage(key: object) -> Made:
            dtype, key = torch_storage(key)
            return storages.setdefault(key, Made(Name(*STORAGE.split(".")), (dtype,)))

        for _ in range(2):
            self._machine(stream).load()
        content = self._machine(stream, storage).load()
        keys = self._machine(stream).load()
        check_keys(keys)
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


# Python's own machine, in Python: its twin in C cannot be overridden. Typeshed shows neither's parts.
_PlainMachine: Any = pickle._Unpickler


class _Machine(_PlainMachine):
    """The stack machine without its calls."""

    dispatch: ClassVar[dict[int, Any]] = dict(_PlainMachine.dispatch)

    def __init__(self, stream: io.BytesIO, reader: Reader, storage: Callable[[object], Any] | None = None) -> None:
        super().__init__(stream, encoding="latin1")  # reads of a stream in memory never allocate more than is left
        self._stream, self._reader, self._storage = stream, reader, storage
        self.budget = reader.budget

    def find_class(self, module: str, name: str) -> Name:
        return Name(module, name)

    def persistent_load(self, pid: object) -> Any:
        if self._storage is None:
            raise InputError("reference to data outside the file", got=shown(pid))
        return self._storage(pid)

    def get_extension(self, code: int) -> None:
        raise InputError("copyreg extension", got=code)

    def _instantiate(self, klass: object, args: object) -> None:
        self.append(Made(klass, args))

    def load_reduce(self) -> None:
        args = self.stack.pop()
        self.stack[-1] = Made(self.stack[-1], args)

    def load_newobj_ex(self) -> None:
        self.stack.pop()  # keywords
        self.load_reduce()

    def load_build(self) -> None:
        state, made = self.stack.pop(), self.stack[-1]
        if not isinstance(made, Made):
            raise InputError("state for something that is not an object", got=type(made).__name__)
        made.state = state
        if isinstance(made.what, Name) and str(made.what) == "joblib.numpy_pickle.NumpyArrayWrapper":
            self.stack[-1] = self._joblib_array(self._reader.understood(state))

    def load_bytearray8(self) -> None:
        size = int.from_bytes(self.read(8), "little")
        content = self.read(size)
        if len(content) < size:
            raise EOFError(f"{size} bytes announced, {len(content)} left")
        self.append(bytearray(content))

    def load_setitem(self) -> None:
        check_keys(self.stack[-2:-1])
        _PlainMachine.load_setitem(self)

    def load_setitems(self) -> None:
        check_keys(self.stack[::2])
        _PlainMachine.load_setitems(self)

    def load_dict(self) -> None:
        check_keys(self.stack[::2])
        _PlainMachine.load_dict(self)

    def load_additems(self) -> None:
        check_keys(self.stack)
        _PlainMachine.load_additems(self)

    def load_frozenset(self) -> None:
        check_keys(self.stack)
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
        _Machine.dispatch[_code] = _counted(_load, OBJECT if bytes([_code]) in _OBJECTS else ELEMENT)
