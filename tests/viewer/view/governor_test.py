"""Holding a frame rate: when resolution is given up and taken back."""

from __future__ import annotations

from rnd_viewer.view.governor import SCALES, ResolutionController


def test_one_slow_frame_gives_nothing_up_and_steady_ones_do_step_by_step():
    governor = ResolutionController(50)
    for seconds in (0.01, 0.5, 0.01, 0.01, 0.019, 0.019):
        governor.observe(seconds)
    assert governor.scale == 1
    met = []
    for _ in range(60):
        governor.observe(0.021)
        met.append(SCALES.index(governor.scale))
    assert sorted(set(met)) == list(range(len(SCALES))) and met == sorted(met) and met[-1] == len(SCALES) - 1


def test_headroom_is_used_only_after_a_smooth_while():
    governor = ResolutionController(fps=50)
    for _ in range(4):
        governor.observe(0.03)
    assert governor.scale == SCALES[1]
    for _ in range(100):
        governor.observe(0.015)  # within the budget, without headroom
    assert governor.scale == SCALES[1]
    for _ in range(24):
        governor.observe(0.01)
    assert governor.scale == 1
