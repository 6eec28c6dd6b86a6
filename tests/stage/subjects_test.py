"""rnd-stage --subjects: several people, here and on workers."""

from __future__ import annotations

import numpy as np
import pytest

from rnd_runtime.core.images import read_image
from rnd_stage.cli import main
from support.dask_jobs import two_workers

SMALL = ["--frames", "5", "--cameras", "2", "--size", "32", "--samples", "4"]
SMALL += ["--lights", "red", "--relight-cameras", "1", "--step", "0.02"]


def test_people_are_given_once(tmp_path, capsys):
    pytest.importorskip("mitsuba")
    assert main([str(tmp_path / "out"), "--subject", "1", "--subjects", "2", "3"]) == 2
    assert "--subject: expected the default, got 1 (--subjects has the people)" in capsys.readouterr().err


@pytest.mark.slow
def test_people_of_workers_are_those_of_one_process(tmp_path):
    pytest.importorskip("mitsuba")
    small = [*SMALL, "--variant", "scalar_rgb"]
    with two_workers() as (_, where):
        assert main([str(tmp_path / "both"), "--subjects", "0", "1", *small, "--on", where]) == 0
    assert main([str(tmp_path / "one"), "--subject", "1", *small]) == 0
    files = [file.relative_to(tmp_path / "one") for file in (tmp_path / "one").rglob("*.png")]
    assert len(files) > 20 and (tmp_path / "both/subject0/capture.json").is_file()
    for file in files:  # kernels that are compiled differ in the last digit from those that are loaded
        made, expected = (read_image(tmp_path / folder / file).astype(float) for folder in ("both/subject1", "one"))
        assert made.shape == expected.shape and np.abs(made - expected).mean() < 0.1, file
