"""The benchmark's means: seeds of one subject count as one, and no figure is invented."""

import json
from pathlib import Path

import pytest

from rnd_bench.studies.stage_people import COST_FILE, _cost, means
from rnd_stage.film.plan import BenchmarkOptions


def _row(method: str, subject: int, seed: int, psnr: float, **more: float) -> dict[str, object]:
    return {"method": method, "split": "novel_view", "subject": subject, "seed": seed, "psnr": psnr, **more}


def test_subjects_that_rnd_stage_filmed_have_no_cost(tmp_path: Path):
    options, row = BenchmarkOptions(subjects=2), _row("ours", 0, 0, 30.0, minutes=6)
    nothing = _cost(tmp_path, options, [row], 60)
    assert nothing["pictures"] == 0 and nothing["seconds_per_picture"] is None and nothing["variant"] is None
    (tmp_path / "subject1").mkdir()
    spent = {"pictures": 4, "seconds": 8.0, "cpu_seconds": 12.0, "variant": "llvm_ad_rgb"}
    (tmp_path / "subject1" / COST_FILE).write_text(json.dumps(spent))
    one = _cost(tmp_path, options, [row], 60)
    assert (one["pictures"], one["seconds_per_picture"], one["cpu_seconds_per_picture"]) == (4, 2, 3)
    assert one["variant"] == "llvm_ad_rgb" and one["hours_training"] == pytest.approx(0.1)


def test_every_subject_counts_once():
    rows = [
        _row("ours", 0, 0, 30.0, ssim=0.9),
        _row("ours", 0, 1, 32.0, ssim=0.94),
        _row("ours", 1, 0, 21.0, ssim=0.8),
        _row("plain", 0, 0, 20.0),
        _row("plain", 1, 0, 22.0),
    ]
    ours, plain = means(rows)
    assert (ours["method"], ours["split"], ours["subjects"]) == ("ours", "novel_view", 2)
    assert ours["psnr"] == pytest.approx((31 + 21) / 2) and ours["ssim"] == pytest.approx((0.92 + 0.8) / 2)
    assert ours["psnr_spread"] == pytest.approx(2**0.5)
    assert plain["psnr"] == pytest.approx(21) and plain["psnr_spread"] is None
    assert plain["ssim"] is None and ours["lpips"] is None
