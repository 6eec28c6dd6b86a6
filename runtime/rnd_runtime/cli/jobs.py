"""Independent jobs on several processes or machines, by Dask distributed (extra ``dask``).

A job is a call of a function of a module with paths, numbers and options. It runs in the folder of the command, which a
worker on another machine sees under the same path, and alone in its process. Dask runs a job that was lost with its
worker again, so jobs write files as a whole and may find those of a lost one.
"""

from __future__ import annotations

import importlib
import io
import os
import re
import socket
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.kernels import prepare_process
from rnd_runtime.core.threads import cores

from .command import option, warn
from .extras import need_packages
from .progress import Progress

if TYPE_CHECKING:
    from distributed import Client

Result = TypeVar("Result")
On = Annotated[str | None, option("local:N|dask://HOST:PORT")]
_THREADS = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
_WARNING = "warning: "
_alone = threading.Lock()


def check_on(where: str) -> re.Match[str]:
    """The number of processes or the address in ``where``; for checks before long work, see ``workers``."""
    match = re.fullmatch(r"local:([1-9]\d{0,2})|dask://([^\s/]+:\d+)", where)
    if match is None:
        raise InputError("--on", expected="local:N or dask://HOST:PORT", got=where)
    need_packages("dask", "distributed", what="--on needs")
    return match


@contextmanager
def workers(where: str) -> Iterator[Client]:
    """A client of N processes of this machine, which share its cores (``local:N``), or of a Dask scheduler.

    Raises:
        InputError: another word, no scheduler there, or Dask distributed is not installed.
    """
    match = check_on(where)
    from distributed import Client, LocalCluster

    if match[2]:
        try:
            client = Client(f"tcp://{match[2]}")
        except OSError as error:
            raise InputError("--on", expected="a Dask scheduler", got=f"none at {match[2]}") from error
        with client:
            yield client
        return
    count = int(match[1])
    env = dict.fromkeys(_THREADS, str(max(cores() // count, 1)))
    processes = {"n_workers": count, "threads_per_worker": 1, "memory_limit": 0, "env": env}
    # TLS, as any user of this machine may connect, and a worker does what it is told
    os.environ.setdefault("PYTHONWARNINGS", "ignore:resource_tracker")  # of what Ctrl-C leaves to it
    cluster = LocalCluster(**processes, security=True, dashboard_address="127.0.0.1:0")
    try:
        with Client(cluster) as client:
            yield client
    finally:
        with suppress(TimeoutError):  # of a worker that takes long to end: it does, with this process
            cluster.close()


def worker_count(client: Client) -> int:
    """How many workers there are now; 1 where the first is still to come."""
    return max(len(client.nthreads()), 1)


def run_jobs(
    client: Client,
    function: Callable[..., Result],
    jobs: Sequence[tuple[Any, ...]],
    *,
    name: str,
    sizes: Sequence[int] | None = None,
) -> list[Result]:
    """Call ``function`` with the arguments of each of ``jobs``, report progress, and return the results in order.

    Args:
        client: of ``workers``.
        function: of a module that workers have.
        name: of the phase.
        sizes: what each job adds to the phase, 1 by default.

    Raises:
        InputError: of a job, or a job has taken several workers with it. Others raise too.
    """
    from distributed import KilledWorker, as_completed

    target = f"{function.__module__}:{function.__qualname__}"
    sizes = [1] * len(jobs) if sizes is None else sizes
    futures = [client.submit(_call, target, job, str(Path.cwd()), pure=False) for job in jobs]
    numbers = {future.key: number for number, future in enumerate(futures)}
    finished = as_completed(futures)
    del futures  # a result that is here already is not made again when its worker is lost
    results: dict[int, Any] = {}
    warnings: set[str] = set()
    with Progress() as progress:
        progress.phase(name, sum(sizes))
        for future in finished:
            number = numbers[future.key]
            try:
                results[number], said = future.result()
            except KilledWorker as error:
                hint = "out of memory? fewer workers, or more memory for each"
                raise InputError("a job was lost with its worker, again and again", hint=hint) from error
            if isinstance(results[number], InputError):
                raise results[number]
            for line in said:
                if line not in warnings:
                    warnings.add(line)
                    warn(line)
            progress.update(sum(sizes[number] for number in results))
    return [results[number] for number in range(len(jobs))]


def _call(target: str, arguments: tuple[Any, ...], folder: str) -> tuple[Any, list[str]]:
    """In a worker: the result of the function ``target`` or its ``InputError``, and the warnings that it logged."""
    with _alone:
        prepare_process()  # before the import, which may load numba
        try:
            os.chdir(folder)
        except OSError as error:
            where = f"the folder of the command on {socket.gethostname()}"
            return InputError(f"{where} cannot be entered", got=error.strerror, file=folder), []
        module, name = target.split(":")
        with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()) as log:
            try:
                result = getattr(importlib.import_module(module), name)(*arguments)
            except InputError as error:  # raised, Dask would log it as a failure
                result = InputError(str(error))
        return result, [line.split(_WARNING, 1)[1] for line in log.getvalue().splitlines() if _WARNING in line]
