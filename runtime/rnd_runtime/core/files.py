"""Atomic writing of files, and checks of paths."""

from __future__ import annotations

import hashlib
import json
import math
import os
import secrets
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any, TypeGuard

from .errors import InputError
from .signals import at_end

_NAME_LETTERS = 40  # of the final name in a temporary's, which may not be too long


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Yield a temporary name beside ``path``; rename it to ``path`` when the block succeeds.

    The temporary keeps the suffix (writers choose a format by it) and starts with a dot. When the block
    raises or a signal ends the process, the temporary is removed and an earlier file at ``path`` stays. The mode is
    the umask's.
    """
    path = output_file(path)
    temporary = path.with_name(f"{temporary_stem(path)}{secrets.token_hex(4)}{path.suffix}")
    with at_end(partial(temporary.unlink, missing_ok=True)):  # before it is there
        try:
            os.close(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666))
            yield temporary
            _sync(temporary)
            temporary.replace(path)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise


def temporary_stem(path: Path) -> str:
    """Prefix of the names of ``path``'s temporaries; eight letters and its suffix follow."""
    return f".{path.stem[:_NAME_LETTERS]}."


def _sync(path: Path) -> None:
    """Flush to the disk: after a crash of the machine the name holds the old file or the new."""
    with suppress(OSError):  # a file system without it
        handle = os.open(path, os.O_RDWR)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def sha256_of(path: str | Path) -> str:
    """SHA-256 of a file's content, 64 hexadecimal digits."""
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()


def write_json(path: str | Path, value: object) -> None:
    """Write ``value`` under ``path``, indented, UTF-8; NaN and infinity as null.

    Names of files that are not UTF-8 are escaped.
    """
    text = json.dumps(_finite(value), indent=1, ensure_ascii=False, allow_nan=False)
    with atomic_path(path) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8", errors="backslashreplace")


def _finite(value: object) -> object:
    if isinstance(value, Mapping):
        return {key: _finite(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def earlier_rows(path: str | Path, *, what: str, names: Sequence[str]) -> list[dict[str, Any]]:
    """Rows that an earlier run wrote by ``write_json``; none where there is no file.

    Raises ``InputError`` where the file is not ``what``: a list of objects that have all of ``names``.
    """
    try:
        rows = json.loads(Path(path).read_text(encoding="utf-8"))
    except FileNotFoundError:
        return []
    except (OSError, ValueError):
        rows = None
    if not are_rows(rows, names):
        raise InputError("file of rows", expected=what, got="another file", file=path)
    return rows


def are_rows(value: object, names: Sequence[str]) -> TypeGuard[list[dict[str, Any]]]:
    """Whether ``value`` is a list of objects that have all of ``names``."""
    return isinstance(value, list) and all(isinstance(row, dict) and {*names} <= set(row) for row in value)


def output_folder(path: str | Path) -> Path:
    """Create ``path`` if needed and make sure that it can be written, or raise ``InputError``."""
    path = Path(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError("output folder cannot be made", got=error.strerror, file=path) from error
    if not os.access(path, os.W_OK | os.X_OK):
        raise InputError("output folder cannot be written", file=path)
    return path


def output_file(path: str | Path) -> Path:
    """``path`` with its folder created; ``InputError`` where no file can be written. For checks before long work."""
    path = Path(path)
    output_folder(path.parent)
    if path.is_dir():
        raise InputError("cannot be written: it is a folder", file=path)
    return path


def npz_output(path: Path) -> Path:
    """``path`` if its name ends in .npz; else ``InputError``."""
    if path.suffix.lower() != ".npz":
        raise InputError("output", expected="a name that ends in .npz", got=path.name)
    return path


def refuse_input(out: str | Path, *inputs: str | Path | None) -> None:
    """Raise ``InputError`` where ``out`` would overwrite one of ``inputs``."""
    if any(_is_same(Path(path), Path(out)) for path in inputs if path is not None):
        raise InputError("output", expected="another file than what is read", got=out)


def _is_same(one: Path, other: Path) -> bool:
    try:
        return one.samefile(other)
    except OSError:  # one does not exist
        return one.resolve() == other.resolve()


def is_folder(path: str | Path) -> bool:
    """Whether ``path`` is a folder; False where ``Path.is_dir`` raises, as for a name that is too long."""
    return os.path.isdir(path)  # noqa: PTH112


def existing_file(path: str | Path, *, what: str) -> Path:
    """``path`` if it is a file that may be read; else an ``InputError`` names ``what`` it should have been."""
    path = Path(path)
    try:
        if not path.is_file():
            raise InputError(f"{what} not found", got="a folder" if path.is_dir() else None, file=path)
    except OSError as error:  # a name that is too long, a folder that may not be entered
        raise InputError(f"{what} not found", got=error.strerror, file=str(path)[:200]) from error
    if not os.access(path, os.R_OK):
        raise InputError(f"{what} cannot be read", got="no permission", file=path)
    return path
