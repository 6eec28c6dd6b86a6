"""rnd-train --view: what the page is told, to whom, and that it shows it."""

from __future__ import annotations

import json
import shutil
import socket
import struct
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from rnd_runtime.core.files import atomic_path
from rnd_runtime.core.images import read_image, write_image
from rnd_trainer.commands import train as cli
from rnd_trainer.config import TrainConfig
from rnd_trainer.evaluation.preview import CAPTION, TILES, contact_sheet
from rnd_trainer.training.live_view import GOODBYE_S, POINTS, Metrics, live_view, state
from rnd_trainer.training.schedule import UNSEEN_COST, Schedule
from support.browser import CHROMIUM, chromium

TOTAL = 1000
SCHEDULE = Schedule(TrainConfig(steps=800, unseen_fraction=0.25))

PICTURE = "document.getElementById('picture')"
END = "document.getElementById('end').textContent"
SERVING = """
import sys, time
from pathlib import Path
from rnd_trainer.config import TrainConfig
from rnd_trainer.live_view import live_view
from rnd_trainer.schedule import Schedule
with live_view(Path(sys.argv[1]), Schedule(TrainConfig(steps=800, unseen_fraction=0.25)), port=0) as page:
    print(page, flush=True)
    time.sleep(600)
"""


def _row(step: int, **more: object) -> dict[str, object]:
    stage = 1 if step < 250 else 2
    return {"step": step, "stage": stage, "seconds": 0.5 * step, "image": 1 / (1 + step), **more}


def _write_run(folder: Path, steps: int) -> Path:
    lines = [json.dumps(_row(step)) + "\n" for step in range(steps)]
    (folder / "metrics.jsonl").write_text("".join(lines), encoding="utf-8")
    picture = np.zeros((8, 32, 3), np.uint8)
    for step in (250, 500):
        picture[:] = step // 4
        write_image(folder / f"previews/step_{step:06d}.png", picture)
    return folder


def _get(url: str, host: str | None = None) -> tuple[int, bytes]:
    request = urllib.request.Request(url, headers={"Host": host} if host else {})
    try:
        with urllib.request.urlopen(request, timeout=10) as answer:
            return answer.status, answer.read()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, b""


@contextmanager
def _served_by_another_process(folder: Path) -> Iterator[tuple[str, subprocess.Popen[str]]]:
    command = [sys.executable, "-c", SERVING, str(folder)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout
            yield process.stdout.readline().strip(), process
        finally:
            process.kill()


def test_state_says_how_far_and_how_long_still():
    rows = [_row(step) for step in range(501)]
    now = state(rows, SCHEDULE, ["step_000250.png"])
    assert (now["done"], now["total"], now["stage"], now["skipped"]) == (501, TOTAL, 2, 0)
    left = 299 + 200 * UNSEEN_COST  # the last 200 without pictures
    assert now["seconds_left"] == pytest.approx(0.5 * left)
    assert set(now["curves"]) == {"image"} and len(now["curves"]["image"]) <= POINTS
    step, value = now["curves"]["image"][0]
    assert step == 2 and value == pytest.approx(np.mean([1, 1 / 2, 1 / 3, 1 / 4]))  # bins of 1000/300 → 4 steps


def test_state_of_nothing_and_of_steps_that_failed():
    assert state([], SCHEDULE, [])["seconds_left"] is None
    rows = [_row(0), _row(1, image=float("nan"), skipped=True), _row(2, grey=0.5)]
    now = state(rows, SCHEDULE, [])
    assert now["skipped"] == 1 and now["curves"]["grey"] == [[2, 0.5]]
    json.dumps(now, allow_nan=False)  # the browser's parser knows no NaN


def test_metrics_are_read_on_and_torn_lines_wait(tmp_path):
    metrics = Metrics(tmp_path / "metrics.jsonl")
    assert metrics.read() == []
    with metrics.path.open("w") as stream:
        stream.write(json.dumps(_row(0)) + "\n" + '{"step": 1, "sta')
        stream.flush()
        assert [row["step"] for row in metrics.read()] == [0]
        stream.write('ge": 1, "seconds": 0.5}\n')
    assert [row["step"] for row in metrics.read()] == [0, 1]
    with atomic_path(metrics.path) as kept:  # --resume cut it, and it has grown past where it was
        kept.write_text("".join(json.dumps(_row(k)) + "\n" for k in range(9)) + "{half\n")
    assert [row["step"] for row in metrics.read()] == list(range(9))
    with atomic_path(metrics.path) as kept:  # it kept nothing
        kept.write_text("")
    assert metrics.read() == []


def test_a_run_is_served_to_this_machine_alone(tmp_path):
    folder = _write_run(tmp_path, 300)
    (tmp_path / "secret.png").write_bytes(b"no")
    with live_view(folder, SCHEDULE, port=0) as page:
        assert page.startswith("http://127.0.0.1:")
        status, html = _get(page)
        assert status == 200 and b"<!doctype html>" in html and b"http" not in html.replace(b"http-equiv", b"")
        now = json.loads(_get(page + "state.json")[1])
        assert now["done"] == 300 and now["previews"] == ["step_000250.png", "step_000500.png"]
        status, png = _get(page + "previews/step_000500.png")
        (tmp_path / "back.png").write_bytes(png)
        assert status == 200 and (read_image(tmp_path / "back.png") == 125).all()
        for path in ("previews/../secret.png", "secret.png", "previews/step_999999.png", "metrics.jsonl"):
            assert _get(page + path)[0] == 404, path
        assert _get(page, host="evil.example")[0] == 403  # a page that had its own name resolve to us
        with live_view(folder, SCHEDULE, port=int(page.rsplit(":")[-1][:-1])) as second:
            assert second != page and _get(second)[0] == 200
    with pytest.raises(urllib.error.URLError):
        _get(page)


def test_a_page_that_goes_away_leaves_nothing_on_the_terminal(tmp_path, capfd):
    folder = _write_run(tmp_path, 3)
    (folder / "previews" / "step_000250.png").write_bytes(bytes(32 << 20))  # more than a socket takes at once
    with live_view(folder, SCHEDULE, port=0) as page:
        port = int(page.rsplit(":")[-1][:-1])
        with socket.create_connection(("127.0.0.1", port), timeout=10) as asked:
            asked.sendall(f"GET /previews/step_000250.png HTTP/1.1\r\nHost: localhost:{port}\r\n\r\n".encode())
            reset = struct.pack("ii", 1, 0)  # instead of closing
            asked.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, reset)
            assert asked.recv(9) == b"HTTP/1.0 "
        assert _get(page)[0] == 200
        time.sleep(0.5)
    assert "Traceback" not in capfd.readouterr().err


def _last_state(folder: Path, end: type[BaseException] | None) -> dict[str, object]:
    """What a page that waits for the end of a run is told."""
    told = []
    with suppress(RuntimeError), live_view(folder, SCHEDULE, port=0) as page:
        waiting = threading.Thread(target=lambda: told.append(_get(page + "end.json")[1]))
        waiting.start()
        waiting.join(0.3)
        assert waiting.is_alive() and json.loads(_get(page + "state.json")[1])["ended"] is None
        if end:
            raise end
    waiting.join()
    return json.loads(told[0])


def test_whoever_waits_for_the_end_is_told_how_it_came(tmp_path):
    folder = _write_run(tmp_path, 300)
    now = _last_state(folder, RuntimeError)
    assert (now["ended"], now["done"], now["scores"]) == ("stopped", 300, None)
    _write_run(folder, TOTAL)
    now = _last_state(folder, None)
    assert (now["ended"], now["done"], now["scores"]) == ("finished", TOTAL, None)
    (folder / "eval.json").write_text("{}")
    now = _last_state(folder, None)
    assert now["scores"] == str(folder / "eval.json") and now["avatar"] == str(folder / "avatar.ckpt")


def test_where_no_page_is_open_the_end_comes_at_once(tmp_path):
    folder = _write_run(tmp_path, 3)
    with live_view(folder, SCHEDULE, port=0) as page:
        _get(page + "state.json")
        started = time.monotonic()
    assert time.monotonic() - started < GOODBYE_S


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    if CHROMIUM is None:
        pytest.skip("needs Chromium")
    with chromium(tmp_path_factory.mktemp("profile")) as browser:
        yield browser


def test_the_page_shows_the_training_and_its_end(tmp_path, browser):
    folder = _write_run(tmp_path, 501)
    with live_view(folder, SCHEDULE, port=0) as page:
        browser.open(page)
        browser.wait(f"{PICTURE}?.naturalWidth")
        dom = browser.run("document.body.innerHTML")
        assert "step 501 of 1000 · stage 2 · 4 min 10 s so far · 2 min 42 s left" in dom
        assert 'src="/previews/step_000500.png"' in dom and "image (log)" in dom and "<path d=" in dom
        assert browser.run(END) == ""
        _write_run(folder, TOTAL)
        shutil.copy(folder / "previews/step_000500.png", folder / "previews/step_001000.png")
        (folder / "eval.json").write_text("{}")
    assert browser.run(END) == (
        f"Finished, all 1000 steps. The avatar: {folder}/avatar.ckpt · its scores: {folder}/eval.json"
    )
    assert browser.run("document.getElementById('facts').textContent").startswith("step 1000 of 1000 · stage 2")
    assert browser.run(f"{PICTURE}.src").endswith("step_001000.png")
    assert browser.run(f"{PICTURE}.complete && {PICTURE}.naturalWidth") == 32


def test_the_page_tells_a_run_that_was_stopped_from_one_that_was_killed(tmp_path, browser):
    folder = _write_run(tmp_path, 501)
    with suppress(RuntimeError), live_view(folder, SCHEDULE, port=0) as page:
        browser.open(page)
        browser.wait(f"{PICTURE}?.naturalWidth")
        raise RuntimeError
    stopped = "Stopped after step 501 of 1000; rnd-train --resume goes on from what was saved."
    assert browser.run(END) == stopped
    with _served_by_another_process(folder) as (page, process):
        browser.open(page)
        browser.wait(f"{PICTURE}?.naturalWidth")
        process.kill()
        browser.wait(f"{END} !== ''")
    assert browser.run(END).startswith("No answer any more: the training was killed.")


def test_the_page_calls_the_pictures_what_they_are_called_above_them():
    page = files("rnd_trainer").joinpath("live_view.html").read_text("utf-8")
    assert f"In each row: {', '.join(TILES)}." in page


def test_pictures_of_narrower_rows_stand_in_their_columns(tmp_path):
    wide, narrow = (np.full((4, len(TILES) * width, 3), 255, np.uint8) for width in (40, 20))
    contact_sheet(tmp_path / "sheet.png", [wide, narrow])
    sheet = read_image(tmp_path / "sheet.png")
    assert sheet.shape == (CAPTION + 8, 40 * len(TILES), 3)
    assert (sheet[CAPTION:-4] == 255).all()
    columns = sheet[-4:].reshape(4, len(TILES), 40, 3)
    assert (columns[:, :, 10:30] == 255).all() and columns.sum() == 255 * columns[:, :, 10:30].size


def test_view_is_an_option_of_rnd_train(tiny_capture, tmp_path, monkeypatch, capsys):
    """The page is up while steps are made, and gone afterwards; the steps themselves are tested elsewhere."""
    answers = []

    def steps(training, folder) -> bool:
        page = capsys.readouterr().err.split()[-1]
        answers.append((page, _get(page)[0]))
        return False

    monkeypatch.setattr(cli, "_run_with_progress", steps)
    monkeypatch.setattr(cli, "_score_after_training", lambda *_: None)
    options = cli.TrainOptions(tiny_capture.folder, out=tmp_path / "run", gaussians=200, view=True)
    cli._train(options)
    ((page, status),) = answers
    assert status == 200
    with pytest.raises(urllib.error.URLError):
        _get(page)
