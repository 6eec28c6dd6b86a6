"""Progress where stderr is no terminal."""

import pytest

from rnd_runtime.cli import progress
from rnd_runtime.cli.command import run_command
from rnd_runtime.cli.progress import Progress, track


@pytest.fixture
def clock(monkeypatch) -> list[float]:
    """Seconds; the test moves it."""
    now = [100.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    return now


def test_a_line_for_each_phase_and_every_30_seconds(clock, capsys):
    def work() -> None:
        with Progress() as bar:
            bar.phase("fitting the light", 40)
            for done in range(1, 9):
                clock[0] += 10
                bar.update(done, loss=0.5 / done)
            bar.phase("writing")
            clock[0] += 31
            bar.update(7, step="7 files")

    run_command("rnd-x", work)
    assert capsys.readouterr().err.splitlines() == [
        "rnd-x: fitting the light",
        "rnd-x: fitting the light · 3/40 · loss 0.1667 · 6 min left",
        "rnd-x: fitting the light · 6/40 · loss 0.0833 · 6 min left",
        "rnd-x: writing",
        "rnd-x: writing · 7 files",
    ]


def test_a_resumed_phase_does_not_count_what_was_done_before(clock, capsys):
    with Progress() as bar:
        bar.phase("training", 100, done=90)
        clock[0] += 50
        bar.update(95)
    assert "95/100 · 50 s left" in capsys.readouterr().err


def test_a_pause_between_two_steps_does_not_count_for_all_that_are_left(clock, capsys):
    with Progress() as bar:
        bar.phase("training", 100)
        for done in range(1, 51):
            clock[0] += 300 if done == 50 else 1
            bar.update(done)
    assert capsys.readouterr().err.splitlines()[-1].endswith("50/100 · 14 min left")  # 318 s for 19 steps


def test_the_first_item_does_not_count_for_the_time_left(clock, capsys):
    """It compiles kernels and fills caches."""
    for number in track("rendering", range(4), 4):
        clock[0] += 31 if number else 300
    assert [line.rpartition(" · ")[2] for line in capsys.readouterr().err.splitlines()[1:]] == [
        "1/4",
        "62 s left",
        "31 s left",
        "0 s left",
    ]


def test_quiet_is_silent_and_items_pass(monkeypatch, capsys):
    monkeypatch.setattr("rnd_runtime.cli.command._running.quiet", True)
    assert list(track("counting", range(3), 3)) == [0, 1, 2]
    assert capsys.readouterr() == ("", "")
