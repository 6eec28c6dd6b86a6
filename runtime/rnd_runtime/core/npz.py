"""Named arrays of untrusted .npz archives and of others, and writing archives."""

from __future__ import annotations

import lzma
import math
import struct
import sys
import tokenize
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO, Self

import numpy as np
from numpy.typing import NDArray

from .budget import Budget
from .errors import InputError
from .files import atomic_path, existing_file

# What numpy and zipfile raise for archives that are cut, scrambled, encrypted or hold Python objects.
_UNREADABLE = (
    *(ValueError, OSError, EOFError, KeyError, RuntimeError, OverflowError, NotImplementedError),
    *(zlib.error, lzma.LZMAError, zipfile.BadZipFile, struct.error),
    *(tokenize.TokenError, SyntaxError, TypeError),
)


_NUMBER_BYTES, _TEXT_BYTES = 8, 64  # of an element as ``Members`` hands it over
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # what numpy and torch write; zipfile expands these by pieces


def array_header(stream: BinaryIO) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Shape and dtype of the .npy that begins here; nothing of its data is read.

    Raises:
        ValueError: damaged, or of a version that only structured types need.
    """
    version = np.lib.format.read_magic(stream)
    if version not in ((1, 0), (2, 0)):
        raise ValueError(f"version {version} of .npy")
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    try:
        shape, _, dtype = read(stream)
    except MemoryError as error:  # Python's parser on nested brackets
        raise ValueError("nested header") from error
    if any(size < 0 for size in shape):
        raise ValueError("negative shape")
    return shape, dtype


def array_bytes(shape: tuple[int, ...], dtype: np.dtype[Any]) -> int:
    """Bytes of an array of these as ``Members`` hands it over: float64, or strings."""
    return math.prod(shape) * max(dtype.itemsize, _TEXT_BYTES if dtype.kind in "SU" else _NUMBER_BYTES)


def check_member(archive: zipfile.ZipFile, name: str, budget: Budget) -> None:
    """Count the bytes that the member ``name`` declares; raise ``InputError`` where they are too many."""
    info = archive.getinfo(name)
    if info.compress_type not in _METHODS:
        raise InputError(f"compression of {name}", expected="none or deflate", got=f"method {info.compress_type}")
    budget.take(info.file_size, name)


class Members:
    """Arrays by name, checked when asked for: every failure is an ``InputError`` naming file and field.

    Args:
        arrays: what numpy takes for arrays, by name.
        path: the file they are from, for messages.
    """

    def __init__(self, arrays: Mapping[str, Any], path: str | Path) -> None:
        self.path = Path(path)
        self.names: tuple[str, ...] = tuple(arrays)
        self._arrays = arrays

    def first_of(self, *names: str) -> str | None:
        """The first of ``names`` that the archive holds."""
        return next((name for name in names if name in self.names), None)

    def numbers(self, name: str, shape: tuple[int | None, ...] | None = None) -> NDArray[np.float64]:
        """The finite numbers of member ``name`` as float64.

        ``shape`` is what it must be, None where any length does. A number that is not finite is reported
        with its frame (its index along the first axis).
        """
        array = self._member(name)
        if array.dtype.kind not in "fiub":
            raise InputError(name, expected="numbers", got=f"dtype {array.dtype}", file=self.path)
        self._check_shape(name, array, shape)
        numbers = array.astype(np.float64)
        finite = np.isfinite(numbers)
        if not finite.all():
            index = np.argwhere(~finite)[0]
            frame = int(index[0]) if numbers.ndim > 1 else None
            raise InputError(name, expected="finite numbers", got=numbers[tuple(index)], file=self.path, frame=frame)
        return numbers

    def strings(self, name: str) -> tuple[str, ...]:
        """Member ``name`` as strings."""
        array = self._member(name)
        if array.dtype.kind == "S":
            array = np.char.decode(array.astype(np.bytes_), "utf-8", "replace")
        if array.dtype.kind != "U":
            raise InputError(name, expected="strings", got=f"dtype {array.dtype}", file=self.path)
        try:
            if array.size and array.dtype.itemsize:  # Python takes numbers that are no characters, and fails later
                codes = np.dtype(np.uint32).newbyteorder(array.dtype.byteorder)
                if np.ascontiguousarray(array.reshape(-1)).view(codes).max() > sys.maxunicode:
                    raise ValueError("no character")
            texts = tuple(str(text) for text in array.reshape(-1))
            "".join(texts).encode()  # what cannot be written cannot be shown either
        except (SystemError, ValueError) as error:
            raise InputError(name, expected="strings", got="damaged ones", file=self.path) from error
        return texts

    def _member(self, name: str) -> NDArray[np.generic]:
        if name not in self.names:
            raise InputError(f"{name} is missing", got=f"only {', '.join(self.names) or 'nothing'}", file=self.path)
        return self._read(name)

    def _read(self, name: str) -> NDArray[np.generic]:
        try:
            return np.asarray(self._arrays[name])
        except ValueError as error:
            raise InputError(name, expected="an array", got="rows of unequal lengths", file=self.path) from error

    def _check_shape(self, name: str, array: NDArray[np.generic], shape: tuple[int | None, ...] | None) -> None:
        if shape is None:
            return
        fits = array.ndim == len(shape)
        if not fits or any(want not in (None, have) for want, have in zip(shape, array.shape)):
            wanted = "×".join("n" if want is None else str(want) for want in shape) or "a single number"
            got = "×".join(map(str, array.shape)) or "a single number"
            raise InputError(f"shape of {name}", expected=wanted, got=got, file=self.path)


class Npz(Members):
    """The members of an .npz, read one at a time when asked for; use it in a ``with`` statement.

    Members that are not requested are never read, so an archive may hold Python objects beside the arrays we
    need. Nothing is ever unpickled.
    """

    def __init__(self, path: str | Path, *, what: str) -> None:
        path = existing_file(path, what=what)
        self._stream = path.open("rb")  # ours to close: numpy leaves its own open when a file is cut
        try:
            begins = self._stream.read(len(np.lib.format.MAGIC_PREFIX))
            self._stream.seek(0)
            if begins == np.lib.format.MAGIC_PREFIX:  # numpy would read all of it
                raise InputError(f"{what} cannot be read", expected="an .npz archive", got="an array", file=path)
            self._archive: np.lib.npyio.NpzFile = np.load(self._stream, allow_pickle=False)
        except _UNREADABLE as error:
            self._stream.close()
            raise InputError(f"{what} cannot be read", expected="an .npz archive", file=path) from error
        except InputError:
            self._stream.close()
            raise
        self._budget = Budget.of(path)
        self._counted: set[str] = set()
        super().__init__(self._archive, path)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._archive.close()
        self._stream.close()

    def _read(self, name: str) -> NDArray[np.generic]:
        try:
            self._count(name)
            array: NDArray[np.generic] = self._archive[name]
            if not isinstance(array, np.ndarray):  # numpy hands over the bytes of what is no array
                raise ValueError("not an array")
        except _UNREADABLE as error:
            got = "data that is cut short or damaged"
            if "allow_pickle" in str(error):
                got = "Python objects"
            raise InputError(name, expected="an array", got=got, file=self.path) from error
        except InputError as error:
            raise error.at(file=self.path) from error
        return array

    def _count(self, name: str) -> None:
        """Take the member's bytes from the budget, once."""
        if name in self._counted:
            return
        self._counted.add(name)
        archive = self._archive.zip
        assert archive is not None
        member = name if name in archive.namelist() else f"{name}.npy"
        check_member(archive, member, self._budget)
        with archive.open(member) as stream:
            shape, dtype = array_header(stream)  # type: ignore[arg-type]  # reads as one
        self._budget.take(max(array_bytes(shape, dtype) - archive.getinfo(member).file_size, 0), name)


def save_npz(path: str | Path, arrays: Mapping[str, NDArray[np.generic]]) -> None:
    """Write ``arrays`` as a compressed .npz, atomically; equal arrays give equal bytes."""
    with atomic_path(path) as temporary, temporary.open("wb") as stream:
        np.savez_compressed(stream, **dict(arrays))  # type: ignore[arg-type]  # its keyword allow_pickle
