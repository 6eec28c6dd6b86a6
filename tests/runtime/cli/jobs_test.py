"""Jobs on other processes: order, errors, warnings, and a job whose worker was killed."""

from __future__ import annotations

import sys

import pytest

from rnd_runtime.cli.jobs import run_jobs, workers
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.threads import cores
from support.dask_jobs import dies, squared


@pytest.mark.parametrize("where", ["local", "local:0", "dask://host", "host:8786", "dask://a b:1"])
def test_other_places_are_refused(where):
    with pytest.raises(InputError, match=r"^--on: expected local:N or dask://HOST:PORT, got "), workers(where):
        pass


def test_the_extra_is_named_where_it_is_missing(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match=r"not installed \(pip install 'rnd-avatar\[dask\]', "), workers("local:2"):
        pass


def test_a_process_takes_the_threads_that_it_is_given(monkeypatch):
    monkeypatch.setenv("NUMBA_NUM_THREADS", "1")
    assert cores() == 1
    for wrong in ("0", "-1", "two", "1.5"):
        monkeypatch.setenv("NUMBA_NUM_THREADS", wrong)
        with pytest.raises(InputError, match=r"^NUMBA_NUM_THREADS: expected a whole number of at least 1, got "):
            cores()


@pytest.mark.slow
def test_a_job_lost_with_its_worker_is_run_again(tmp_path, capsys):
    pytest.importorskip("distributed", reason="extra [dask]: distributed is not installed")
    import dask

    with workers("local:2") as client:
        assert run_jobs(client, squared, [(tmp_path, k) for k in range(6)], name="squares") == [0, 1, 4, 9, 16, 25]
        assert (tmp_path / "died").exists()
        assert capsys.readouterr().err.count("warning: squares only") == 1
        with pytest.raises(InputError, match=r"list\.txt: number: expected a lucky one, got 13$"):
            run_jobs(client, squared, [(tmp_path, 13)], name="squares")
    lost = pytest.raises(InputError, match="a job was lost with its worker")
    with dask.config.set({"distributed.scheduler.allowed-failures": 0}), workers("local:1") as client, lost:
        run_jobs(client, dies, [(1,)], name="deaths")


@pytest.mark.slow
def test_a_scheduler_that_does_not_answer_is_one_line():
    pytest.importorskip("distributed", reason="extra [dask]: distributed is not installed")
    import dask

    refused = pytest.raises(InputError, match=r"^--on: expected a Dask scheduler, got none at 127.0.0.1:9$")
    with dask.config.set({"distributed.comm.timeouts.connect": "1s"}), refused, workers("dask://127.0.0.1:9"):
        pass
