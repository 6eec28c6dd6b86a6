"""The benchmark's means: seeds of one subject count as one, and no figure is invented."""

import pytest

from rnd_trainer.stage.benchmark import means


def _row(method: str, subject: int, seed: int, psnr: float, **more: float) -> dict[str, object]:
    return {"method": method, "split": "novel_view", "subject": subject, "seed": seed, "psnr": psnr, **more}


def test_every_subject_counts_once():
    rows = [
        _row("ours", 0, 0, 30.0, ssim=0.9), _row("ours", 0, 1, 32.0, ssim=0.94), _row("ours", 1, 0, 21.0, ssim=0.8),
        _row("plain", 0, 0, 20.0), _row("plain", 1, 0, 22.0),
    ]  # fmt: skip
    ours, plain = means(rows)
    assert (ours["method"], ours["split"], ours["subjects"]) == ("ours", "novel_view", 2)
    assert ours["psnr"] == pytest.approx((31 + 21) / 2) and ours["ssim"] == pytest.approx((0.92 + 0.8) / 2)
    assert ours["psnr_spread"] == pytest.approx(2**0.5)
    assert plain["psnr"] == pytest.approx(21) and plain["psnr_spread"] is None
    assert plain["ssim"] is None and ours["lpips"] is None
