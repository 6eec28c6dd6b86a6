"""Frames that are means of several: against the samples, rendered as frames of their own by rnd-play."""

from __future__ import annotations

import numpy as np
import pytest

from rnd_runtime.core.camera import Camera
from rnd_runtime.core.images import read_image
from rnd_runtime.playback.frame import RenderedFrame
from rnd_viewer.play.cli import main
from rnd_viewer.play.sampling import Sampling
from viewer.play.play_cli_test import _arguments, files  # noqa: F401

RNG = np.random.default_rng(0)


def _frame(size: int, ground: bool = False, background: str = "none") -> RenderedFrame:
    alpha = np.clip(RNG.uniform(-0.5, 1.5, (size, size)), 0, 1).astype(np.float32)
    radiance = (alpha[..., None] * RNG.uniform(0, 2, (size, size, 3))).astype(np.float32)
    share = RNG.uniform(0, 1, (size, size, 3)).astype(np.float32) if ground else None
    behind = {"none": None, "grey": np.full(3, 0.3, np.float32)}.get(
        background, RNG.uniform(0, 3, (size, size, 3)).astype(np.float32)
    )
    return RenderedFrame(radiance, alpha, ground=share, background=behind)


def _box(values: np.ndarray, factor: int) -> np.ndarray:
    rows, columns = values.shape[0] // factor, values.shape[1] // factor
    return values.reshape(rows, factor, columns, factor, *values.shape[2:]).mean(axis=(1, 3), dtype=np.float64)


@pytest.mark.parametrize("factor", [1, 2, 3])
@pytest.mark.parametrize(("ground", "background"), [(False, "none"), (True, "grey"), (False, "map"), (True, "map")])
def test_what_is_shown_is_the_mean_of_what_samples_show(factor, ground, background):
    sampling = Sampling(factor, 180, 3)
    frames = [_frame(6 * factor, ground, background) for _ in sampling.offsets]
    got = sampling.mean(iter(frames))
    expected = np.mean([_box(frame.linear(), factor) for frame in frames], axis=0)
    np.testing.assert_allclose(got.linear(), expected, rtol=2e-5, atol=2e-6)
    np.testing.assert_allclose(got.alpha, np.mean([_box(frame.alpha, factor) for frame in frames], axis=0), atol=1e-6)


def test_one_sample_is_the_frame_itself():
    frame, camera = _frame(4), Camera.look_at([0, 0, 3], [0, 0, 0], width=4, height=4, fov_y=0.5)
    assert Sampling().mean(iter([frame])) is frame and Sampling().fine(camera) is camera
    assert Sampling(count=8).offsets == [0.0]
    assert Sampling(1, 180, 4).offsets == [-0.1875, -0.0625, 0.0625, 0.1875]


def _linear(out, number: int = 0) -> np.ndarray:
    return read_image(out / f"frames_exr/{number:06d}.exr")


def test_rnd_play_supersamples(files, tmp_path):  # noqa: F811
    look = {"ground": "auto", "background": "hdr", "camera": "orbit", "format": "exr", "frames": "2:3", "shade": "ao"}
    assert main(_arguments(files, tmp_path / "fine", **look, size=96)) == 0
    assert main(_arguments(files, tmp_path / "mean", **look, supersample=2)) == 0
    fine, mean = _linear(tmp_path / "fine", 2), _linear(tmp_path / "mean", 2)
    np.testing.assert_allclose(mean[..., :4], _box(fine[..., :4], 2), rtol=1e-4, atol=1e-5)


def test_rnd_play_blurs_motion(files, tmp_path):  # noqa: F811
    look = {"camera": "orbit", "orbit_seconds": 0.7, "hdr_turn": 0.9, "format": "exr", "shade": "ao"}
    assert main(_arguments(files, tmp_path / "moments", **look, fps=240, frames="13:20")) == 0
    shutter = {"shutter": 360, "shutter_samples": 4, "frames": "2:3"}
    assert main(_arguments(files, tmp_path / "blurred", **look, fps=30, **shutter)) == 0
    assert main(_arguments(files, tmp_path / "sharp", **look, fps=30, frames="2:3")) == 0
    expected = np.mean([_linear(tmp_path / "moments", number) for number in (13, 15, 17, 19)], axis=0)
    blurred, sharp = (_linear(tmp_path / name, 2) for name in ("blurred", "sharp"))
    np.testing.assert_allclose(blurred, expected, atol=1e-4)
    assert np.abs(blurred - sharp).max() > 0.05


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"supersample": 5}, "--supersample"),
        ({"shutter": 400}, "--shutter"),
        ({"shutter_samples": 4}, "--shutter-samples"),
        ({"supersample": 2, "aov": "normal"}, "--aov"),
        ({"shutter": 90, "aov": "motion"}, "--aov"),
    ],
)
def test_what_cannot_be_sampled_is_refused(files, tmp_path, capsys, options, message):  # noqa: F811
    assert main(_arguments(files, tmp_path / "out", **options)) == 2
    assert message in capsys.readouterr().err and not (tmp_path / "out").exists()
