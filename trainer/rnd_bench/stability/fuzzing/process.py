"""The process in which a reader reads broken files, and may die.

``python -m rnd_bench.stability.fuzzing.process READER COUNT SEED VALID OWN`` reads COUNT damaged copies of a file of
the folder VALID in the folder OWN and prints one line of JSON. Address space and processor time per input are limited.
An audit hook records executed code and files written outside of OWN.
"""

from __future__ import annotations

import json
import os
import resource
import signal
import sys
from pathlib import Path
from time import process_time
from typing import Any

from rnd_runtime.core.errors import InputError

from .damage import Random, damage
from .readers import READERS

HANG_S = 5.0  # processor time for one input
SPARE_BYTES = 2 << 30  # address space beyond that of the imports
EVENTS = {"subprocess.Popen", "os.system", "os.exec", "os.posix_spawn", "os.fork", "pickle.find_class"}
"""audit events that no reader may cause"""


def feed(name: str, count: int, seed: int, valid: Path, own: Path) -> dict[str, Any]:
    """Feed ``count`` inputs of ``seed`` to the reader ``name`` in this process; counts, escapes, time and memory.

    ``own`` is a copy of the folder ``valid``, in which the damaged file replaces the valid one.
    """
    reader = READERS[name]
    honest, broken = (valid / reader.file).read_bytes(), own / reader.file
    read, rng = reader.prepare(valid), Random(f"{name} {seed}")
    broken.write_bytes(honest)
    read(broken)  # fills imports and caches
    report: dict[str, Any] = {"inputs": 0, "refused": 0, "read": 0, "escaped": {}, "audit": [], "slowest_s": 0.0}
    before = _peak_bytes()
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    limit = pages * resource.getpagesize() + SPARE_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    _watch(own, report["audit"])
    begun = process_time()
    for _ in range(count):
        content = damage(rng, honest, reader.mutation)
        broken.write_bytes(content)
        signal.setitimer(signal.ITIMER_PROF, HANG_S)  # ends the process
        started = process_time()
        try:
            read(broken)
            report["read"] += 1
        except InputError as error:
            report["refused"] += 1
            if "\n" in str(error):
                report["escaped"].setdefault(f"more than one line: {str(error)[:120]}", content[:200].hex())
        except Exception as error:
            report["escaped"].setdefault(f"{type(error).__name__}: {str(error)[:120]}", content[:200].hex())
            broken.with_name(f"escape_{type(error).__name__}{broken.suffix}").write_bytes(content)
        report["slowest_s"] = max(report["slowest_s"], process_time() - started)
        signal.setitimer(signal.ITIMER_PROF, 0)
        report["inputs"] += 1
    report["seconds"] = process_time() - begun
    report["grown_bytes"] = _peak_bytes() - before
    return report


def _peak_bytes() -> int:
    """Largest resident memory of this process so far."""
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def _watch(own: Path, seen: list[str]) -> None:
    """Record forbidden events, and files opened for writing outside ``own``, in ``seen``."""
    inside = str(own.resolve())

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        if event in EVENTS:
            seen.append(event)
        elif event == "open" and isinstance(arguments[0], str):
            path, mode, flags = arguments
            writes = "w" in (mode or "")
            if isinstance(flags, int):
                writes = bool(flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT))
            allowed = os.path.realpath(path).startswith(inside) or path.startswith(("/dev/", "/proc/self/"))
            if writes and not allowed:
                seen.append(f"wrote {path}")

    sys.addaudithook(hook)


if __name__ == "__main__":
    which, amount, first_seed, valid_files, own_files = sys.argv[1:]
    sys.stdout.write(json.dumps(feed(which, int(amount), int(first_seed), Path(valid_files), Path(own_files))) + "\n")
