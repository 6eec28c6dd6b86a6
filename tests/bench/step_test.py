"""Where a training step's time goes: operations are told apart, and their times add up."""

from rnd_bench.speed.step import KINDS, OPTIMISER, OUTSIDE, REST, bench_step


def test_the_parts_add_up_to_the_step_and_ours_are_among_them(tiny_capture, tiny_config):
    seen: list[float] = []
    rows = bench_step(tiny_capture, tiny_config, None, repeats=3, on_step=seen.append)
    assert rows[0]["what"] == "a step" and seen == list(range(len(seen)))
    assert {row["what"] for row in rows[1:]} == {*KINDS, OPTIMISER, REST, OUTSIDE}
    spent = {row["what"]: row["ms"] for row in rows}
    assert spent[OUTSIDE] >= 0  # the total by the clock, less what the profiler counted: nothing is counted twice
    assert min(spent[kind] for kind in ("our posing", "our shading", "our splatting", "our SSIM")) > 0
    assert spent["perceptual network"] == 0  # none was given
    assert rows[0]["gaussians"] == tiny_config.model.gaussians
