"""Jobs for tests of ``rnd_runtime.cli.jobs``, and a Dask cluster of processes of which one is killed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest

from rnd_runtime.cli.command import warn
from rnd_runtime.core.errors import InputError

ONE_THREAD = {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}  # a training then gives the same bits


def squared(folder: Path, number: int) -> int:
    """Square ``number``; 1 takes its process with it the first time, and 13 is refused."""
    if number == 1 and not (folder / "died").exists():
        (folder / "died").touch()
        os.kill(os.getpid(), signal.SIGKILL)
    if number == 13:
        raise InputError("number", expected="a lucky one", got=number, file=folder / "list.txt")
    warn("squares only")
    return number * number


def dies(number: int) -> None:
    """Take the process with it, always."""
    os.kill(os.getpid(), signal.SIGKILL)


def in_a_process(module: str, *words: object) -> None:
    """Run the command of ``module`` alone, with one thread.

    A first run compiles kernels, and its results may differ in the last digit: one comes before what is compared.
    """
    program = f"import sys; from {module} import main; sys.exit(main())"
    environment = os.environ | ONE_THREAD | {"PYTHONPATH": os.pathsep.join(sys.path)}
    subprocess.run([sys.executable, "-c", program, *map(str, words)], env=environment, check=True)


@contextmanager
def two_workers() -> Iterator[tuple[Any, str]]:
    """A Dask cluster of two processes, and what ``--on`` calls it; skips the test where the extra is missing."""
    distributed = pytest.importorskip("distributed", reason="extra [dask]: distributed is not installed")
    how = {"n_workers": 2, "threads_per_worker": 1, "memory_limit": 0, "env": ONE_THREAD}
    cluster = distributed.LocalCluster(**how, dashboard_address="127.0.0.1:0")
    try:
        yield cluster, cluster.scheduler_address.replace("tcp://", "dask://")
    finally:
        with suppress(TimeoutError):  # a busy machine takes longer to end its processes
            cluster.close()


@contextmanager
def worker_killed_when(cluster: Any, ready: Callable[[], bool]) -> Iterator[list[int]]:
    """Kill one of the cluster's processes as soon as ``ready()`` during the block; yields the list of the killed."""
    killed: list[int] = []
    over = threading.Event()

    def kill() -> None:
        while not ready() and not over.is_set():
            time.sleep(0.01)
        if not over.is_set():
            killed.append(cluster.workers[0].pid)
            os.kill(killed[0], signal.SIGKILL)

    killer = threading.Thread(target=kill)
    killer.start()
    try:
        yield killed
    finally:
        over.set()
        killer.join()
