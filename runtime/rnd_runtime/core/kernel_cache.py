"""Where compiled kernels are kept between runs.

numba compiles a kernel anew when the file of its outermost function has changed. Of what is inlined into it from other
files, constants included, it knows nothing: after an edit or a ``git pull`` it would run what stood there before. So
in a clone the cache is one for each state of the sources. Files of an installed package are all written at once, and
with them numba's own stamps.
"""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

_KEPT = 4  # states of the sources


def keep_kernels_by_source() -> None:
    """Name the folder in ``NUMBA_CACHE_DIR``, unless the user has; before numba is loaded."""
    root = Path(__file__).parents[3]
    if "NUMBA_CACHE_DIR" in os.environ or not (root / "pyproject.toml").is_file():
        return
    try:
        digest = hashlib.sha256()
        for file in _sources(root):
            digest.update(file.relative_to(root).as_posix().encode() + file.read_bytes())
        folder = root / ".cache" / "kernels" / digest.hexdigest()[:16]
        new = not folder.is_dir()
        folder.mkdir(parents=True, exist_ok=True)  # another process may have been faster
    except OSError:  # not ours to write: numba finds a place of its own
        return
    os.environ["NUMBA_CACHE_DIR"] = str(folder)
    if new:
        _remove_oldest(folder.parent)


def _remove_oldest(kept: Path) -> None:
    with suppress(OSError):  # another process removes them too
        for old in sorted(kept.iterdir(), key=lambda path: path.stat().st_mtime)[:-_KEPT]:
            shutil.rmtree(old, ignore_errors=True)


def _sources(root: Path) -> Iterator[Path]:
    """All that kernels may be made of: this package, whose constants they hold, and whatever else compiles some."""
    own = Path(__file__).parents[1]
    yield from sorted(own.rglob("[!.]*.py"))  # a name with a dot is an editor's
    for file in sorted((root / "trainer").rglob("[!.]*.py")):
        if b"njit" in file.read_bytes():
            yield file
