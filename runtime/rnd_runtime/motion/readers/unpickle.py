"""Pickles that other programs wrote, read as data: nothing that a file names is imported, called or built.

A pickle is a program for a small stack machine. Here that machine never calls anything: a class or function
that the file names stays a name, and calling it leaves a note of its arguments. Afterwards the notes that we
know (numpy and torch arrays, scipy's compressed sparse columns, chumpy's wrappers, ordered dictionaries) are
understood as plain data, and any other is an error. Neither numpy's, joblib's, torch's nor chumpy's code runs.
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
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import existing_file

_READ_ERRORS = (
    *(ValueError, OSError, EOFError, KeyError, IndexError, TypeError, AttributeError, AssertionError),
    *(OverflowError, MemoryError, RecursionError, NotImplementedError, UnicodeError, ImportError),
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
_MAX_REPEATED = 10_000_000  # numbers of a tensor that repeats its storage, as one shape for all frames


def read_pickle(path: str | Path, *, what: str = "pickle") -> Any:
    """What a .pkl, .pt or .npy holds, as dicts, lists, tuples, strings, numbers and numpy arrays.

    Reads pickles of every protocol (Python 2's strings as Latin-1), joblib's files, plain or compressed,
    torch's zip files, and the arrays of Python objects that numpy saves (one without axes is its content,
    any other a nested list). Sparse matrices come out dense, torch's tensors as arrays.

    Raises:
        InputError: for a damaged file, or one that needs an object of a class unknown to us.
    """
    path = existing_file(path, what=what)
    try:
        with path.open("rb") as stream:
            return _read(stream)
    except InputError as error:
        raise error.at(file=path) from error
    except _READ_ERRORS as error:
        raise InputError(f"{what} cannot be read", got=f"{type(error).__name__}: {error}", file=path) from error


def _read(stream: BinaryIO) -> Any:
    magic = stream.read(6)
    stream.seek(0)
    if magic[:4] == b"PK\x03\x04":
        return _read_torch(stream)
    if magic == b"\x93NUMPY":
        return _read_npy(stream)
    unpack: dict[bytes, Callable[[bytes], bytes]] = {
        **{b"\x1f\x8b": gzip.decompress, b"BZ": bz2.decompress, b"\xfd7": lzma.decompress, b"]\0": lzma.decompress},
        **dict.fromkeys((b"x\x01", b"x\x5e", b"x\x9c", b"x\xda"), zlib.decompress),
    }
    if magic[:2] in unpack:
        stream = io.BytesIO(unpack[magic[:2]](stream.read()))
    content = _Machine(stream).load()
    if isinstance(content, int) and content == _TORCH_MAGIC:
        return _read_old_torch(stream)
    return _understand(content, {})


def _read_npy(stream: BinaryIO) -> Any:
    version = np.lib.format.read_magic(stream)
    read_header = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}.get(
        version
    )
    dtype = read_header(stream)[2] if read_header else np.dtype("f8")
    if dtype.hasobject:
        return _understand(_Machine(stream).load(), {})
    stream.seek(0)
    return np.lib.format.read_array(stream, allow_pickle=False)


def _read_torch(stream: BinaryIO) -> Any:
    """A torch zip file: ``NAME/data.pkl`` beside ``NAME/data/KEY``, the tensors' bytes."""
    with zipfile.ZipFile(stream) as archive:
        names = [name for name in archive.namelist() if name.endswith("data.pkl")]
        if len(names) != 1:
            raise InputError("torch file", expected="one data.pkl", got=f"{len(names)}")
        folder = names[0].removesuffix("data.pkl")
        order = archive.read(folder + "byteorder").decode() if folder + "byteorder" in archive.namelist() else "little"
        sign: Literal[">", "<"] = ">" if order == "big" else "<"

        def storage(key: object) -> NDArray[np.generic]:
            dtype, key = _torch_storage(key)
            return np.frombuffer(archive.read(f"{folder}data/{key}"), dtype.newbyteorder(sign))

        return _understand(_Machine(io.BytesIO(archive.read(names[0])), storage).load(), {})


def _read_old_torch(stream: BinaryIO) -> Any:
    """What torch wrote before its zip files, and still puts into other pickles; the magic number is already read.

    Protocol, machine, content and the storages' keys are pickles; then every storage's length and bytes follow.
    """
    storages: dict[object, _Made] = {}

    def storage(key: object) -> _Made:
        dtype, key = _torch_storage(key)
        return storages.setdefault(key, _Made(_Name(*_STORAGE.split(".")), (dtype,)))

    for _ in range(2):
        _Machine(stream).load()
    content = _Machine(stream, storage).load()
    for key in _Machine(stream).load():
        dtype = storages[key].args[0].newbyteorder("<")
        count = int.from_bytes(stream.read(8), "little", signed=True)
        storages[key].state = np.frombuffer(stream.read(max(count, 0) * dtype.itemsize), dtype, count)
    return _understand(content, {})


def _torch_storage(key: object) -> tuple[np.dtype[Any], object]:
    """Element type and key of a storage that a torch file refers to."""
    kind, element, name_of_data = key[:3] if isinstance(key, tuple) and len(key) >= 3 else (None, None, None)
    name = element.name.removesuffix("Storage") if isinstance(element, _Name) else ""
    if kind != "storage" or name not in _TORCH_DTYPES:
        raise InputError("torch tensor", expected=f"one of {', '.join(_TORCH_DTYPES)}", got=name or key)
    return np.dtype(_TORCH_DTYPES[name]), name_of_data


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

    def __init__(self, stream: BinaryIO, storage: Callable[[object], Any] | None = None) -> None:
        super().__init__(stream, encoding="latin1")
        self._stream, self._storage = stream, storage

    def find_class(self, module: str, name: str) -> _Name:
        return _Name(module, name)

    def persistent_load(self, pid: object) -> Any:
        if self._storage is None:
            raise InputError("reference to data outside the file", got=pid)
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
        if str(made.what) == "joblib.numpy_pickle.NumpyArrayWrapper":
            self.stack[-1] = self._joblib_array(_understand(state, {}))

    dispatch[pickle.REDUCE[0]] = dispatch[pickle.NEWOBJ[0]] = load_reduce
    dispatch[pickle.NEWOBJ_EX[0]] = load_newobj_ex
    dispatch[pickle.BUILD[0]] = load_build

    def _joblib_array(self, wrapper: dict[str, Any]) -> Any:
        """The array whose bytes joblib puts into the pickle behind its wrapper."""
        dtype, shape = wrapper["dtype"], tuple(wrapper["shape"])
        if dtype.hasobject:
            return _Machine(self._stream).load()
        if wrapper.get("numpy_array_alignment_bytes") is not None:
            self._stream.read(self._stream.read(1)[0])
        size = int(np.prod(shape, dtype=np.int64)) * dtype.itemsize
        return np.frombuffer(self._stream.read(size), dtype).reshape(shape, order=wrapper["order"])


def _understand(value: Any, known: dict[int, tuple[Any, Any]]) -> Any:
    """``value`` with every note taken for what it means; ``known`` holds (note, meaning) by the note's id."""
    if not isinstance(value, dict | list | tuple | set | _Made | _Name):
        return value
    if id(value) in known:
        return known[id(value)][1]
    known[id(value)] = (value, None)  # what holds itself would never end: it reads as None
    if isinstance(value, dict):
        meaning: Any = {_hashable(_understand(key, known)): _understand(item, known) for key, item in value.items()}
    elif isinstance(value, list | tuple | set):
        items = [_understand(item, known) for item in value]
        meaning = items if isinstance(value, list) else tuple(items)
    elif isinstance(value, _Name):
        meaning = str(value)
    else:
        made_of = [_understand(part, known) for part in (value.args, value.state, value.items)]
        meaning = _meaning(str(value.what), *made_of)
    known[id(value)] = (value, meaning)
    return meaning


def _hashable(key: Any) -> Any:
    return key.item() if isinstance(key, np.generic) else key


def _meaning(name: str, args: Any, state: Any, items: dict[Any, Any]) -> Any:
    """What calling ``name`` would have given."""
    name = name.replace("__builtin__.", "builtins.")  # Python 2's name of it
    module, _, leaf = name.rpartition(".")
    package = module.split(".")[0]
    if name in ("collections.OrderedDict", "collections.defaultdict", "builtins.dict"):
        return {**dict(next((part for part in args if isinstance(part, list | dict)), {})), **items}
    if name in ("builtins.set", "builtins.frozenset", "builtins.list", "builtins.tuple", "torch.Size"):
        return tuple(args[0]) if args else ()
    if name == "_codecs.encode":
        return args[0].encode(args[1] if len(args) > 1 else "utf-8")
    if name in ("builtins.bytes", "builtins.bytearray"):
        return (
            args[0].encode(args[1]) if len(args) > 1 else bytes(args[0] if args and isinstance(args[0], bytes) else b"")
        )
    if package == "pathlib" and leaf in ("PosixPath", "PurePosixPath", "WindowsPath", "PureWindowsPath"):
        return "/".join(args)
    if package == "numpy":
        return _numpy(name, leaf, args, state)
    if package == "torch":
        return state if name == _STORAGE else _torch(name, leaf, args)
    if package == "scipy" and leaf == "csc_matrix":
        return _dense(state)
    if module in ("copy_reg", "copyreg") and leaf in ("_reconstructor", "__newobj__"):
        return _meaning(args[0], (), state, items)
    if package == "chumpy" and isinstance(state, dict) and "x" in state:
        return np.asarray(state["x"])
    if package == "chumpy" and isinstance(state, dict) and {"a", "idxs"} <= state.keys():
        chosen = np.asarray(state["a"]).reshape(-1)[np.asarray(state["idxs"])]  # chumpy.reordering.Select
        return chosen.reshape(state.get("preferred_shape") or chosen.shape)
    raise InputError("object of an unknown class", expected="plain data and arrays", got=name)


def _numpy(name: str, leaf: str, args: Any, state: Any) -> Any:
    if name == "numpy.dtype":
        dtype = np.dtype(args[0])  # a name such as "f8": fields would come with the state, and are refused
        if dtype.kind not in _ARRAY_KINDS or dtype.names:
            raise InputError("dtype", expected="numbers, strings or objects", got=args[0])
        order = state[1] if state else "="
        return dtype.newbyteorder(order) if order in ("<", ">") else dtype
    if leaf == "_reconstruct":
        _, shape, dtype, fortran, content = state
        return _array(content, dtype, shape, "F" if fortran else "C")
    if leaf == "_frombuffer":
        content, dtype, shape, order = args
        return _array(bytes(content), dtype, shape, order)
    if leaf == "scalar":
        return _array(args[1], args[0], (1,), "C")[0]
    raise InputError("object of an unknown class", expected="plain data and arrays", got=name)


def _array(content: Any, dtype: np.dtype[Any], shape: tuple[int, ...], order: Any) -> Any:
    if not dtype.hasobject:
        raw = content.encode("latin1") if isinstance(content, str) else content
        return np.frombuffer(raw, dtype).reshape(shape, order=order)
    if len(shape) == 0:
        return content[0]
    array = np.empty(len(content), object)
    for index, item in enumerate(content):  # a slice would broadcast lists over the axes
        array[index] = item
    return array.reshape(shape, order=order).tolist()


def _torch(name: str, leaf: str, args: Any) -> Any:
    if leaf in ("_rebuild_tensor_v2", "_rebuild_tensor"):
        storage, offset, size, stride = args[:4]
        if min((*size, *stride, offset), default=0) < 0:
            raise InputError("torch tensor", expected="no negative size, stride or offset")
        last = offset + sum((count - 1) * step for count, step in zip(size, stride))
        if 0 in size:
            return np.zeros(size, storage.dtype)
        if len(size) != len(stride) or last >= len(storage):
            raise InputError("torch tensor", expected=f"{len(storage)} numbers at most", got=last + 1)
        if math.prod(size) > max(len(storage), _MAX_REPEATED):
            expected = f"at most {_MAX_REPEATED} numbers made of {len(storage)}"
            raise InputError("torch tensor", expected=expected, got=math.prod(size))
        steps = [step * storage.itemsize for step in stride]
        return np.lib.stride_tricks.as_strided(storage[offset:], size, steps).copy()
    if leaf == "_load_from_bytes":
        return _read(io.BytesIO(args[0]))
    if leaf == "_rebuild_parameter":
        return args[0]
    if name == "torch.device":
        return ":".join(map(str, args))
    raise InputError("object of an unknown class", expected="plain data and arrays", got=name)


def _dense(state: dict[str, Any]) -> NDArray[np.float64]:
    """A sparse matrix in compressed columns (SMPL's joint regressor) with its zeros."""
    rows, columns = state["_shape"] if "_shape" in state else state["shape"]
    counts = np.diff(state["indptr"])
    if rows * columns > 100_000_000 or len(counts) != columns:
        raise InputError("sparse matrix", expected=f"{columns} columns, at most 1e8 numbers", got=f"{len(counts)}")
    dense = np.zeros((rows, columns))
    np.add.at(dense, (state["indices"], np.repeat(np.arange(columns), counts)), state["data"])
    return dense
