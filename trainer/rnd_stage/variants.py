"""Choice of Mitsuba's back end. An unsuitable LLVM aborts the process, so a child process tries it first."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Literal, get_args

from rnd_runtime.cli.extras import need_packages
from rnd_runtime.core.errors import InputError

Variant = Literal["auto", "scalar_rgb", "llvm_ad_rgb"]

LIBRARY_VARIABLE = "DRJIT_LIBLLVM_PATH"
OLDEST_LLVM = 16  # 14 and 15 abort on Dr.Jit's AVX-512 instructions
PROBE_SECONDS = 120.0
_FOLDERS = ("/usr/lib", "/usr/lib64", "/usr/local/lib", "/opt/homebrew/opt/llvm/lib", "/usr/local/opt/llvm/lib")
_PROBE = """
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
from rnd_stage.render import probe
probe()
"""


def need_extra() -> None:
    """Raise ``InputError`` if a package of the extra is missing."""
    need_packages("stage", "mitsuba", "skimage", "scipy", "cv2")


def use_variant(wanted: Variant = "auto") -> str:
    """Set Mitsuba's variant and return its name; "auto" is LLVM if a child process can render with it."""
    if wanted not in get_args(Variant):
        raise InputError("--variant", expected=", ".join(get_args(Variant)), got=wanted)
    name = "scalar_rgb"
    if wanted != "scalar_rgb":
        library = working_llvm()
        if library is None and wanted == "llvm_ad_rgb":
            hint = f"install libllvm19 or newer, or point {LIBRARY_VARIABLE} at its libLLVM.so"
            raise InputError("no LLVM that works for Mitsuba", hint=hint)
        if library is not None:
            name = "llvm_ad_rgb"
            os.environ[LIBRARY_VARIABLE] = library
    import mitsuba as mi

    mi.set_variant(name)
    mi.set_log_level(mi.LogLevel.Error)  # samplers log that they round sample counts up
    return name


def working_llvm() -> str | None:
    """The first LLVM library with which a child process can render."""
    return next((library for library in _candidates() if _renders(library)), None)


def _candidates() -> Iterator[str]:
    """The library of the environment variable; by default the system's, the newest first."""
    if named := os.environ.get(LIBRARY_VARIABLE):
        yield named
        return
    found: dict[int, str] = {}
    for folder in map(Path, _FOLDERS):
        for path in [*folder.glob("libLLVM*"), *folder.glob("*/libLLVM*"), *folder.glob("llvm*/lib/libLLVM*")]:
            version = re.search(r"libLLVM(?:-|\.so\.|\.)(\d+)", path.name)
            if version and int(version[1]) >= OLDEST_LLVM and path.is_file():
                found.setdefault(int(version[1]), str(path))
    yield from (found[version] for version in sorted(found, reverse=True))


def _renders(library: str) -> bool:
    environment = {**os.environ, LIBRARY_VARIABLE: library, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    try:
        child = subprocess.run(
            [sys.executable, "-c", _PROBE], env=environment, capture_output=True, timeout=PROBE_SECONDS, check=False
        )
    except subprocess.TimeoutExpired:
        return False
    return child.returncode == 0
