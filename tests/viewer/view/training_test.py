"""rnd-view RUN: what it reads of a training's folder while it grows, and what it serves of it."""

from __future__ import annotations

import json
import urllib.error
import urllib.request
from pathlib import Path

import numpy as np
import pytest

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.images import write_image
from rnd_viewer.view.options import ViewOptions
from rnd_viewer.view.server import serve
from rnd_viewer.view.training import POINTS, Training
from support.axe import AXE, violations
from support.browser import CHROMIUM, answering, chromium
from support.paths import ASSETS


def _rows(*steps: int, **terms: float) -> str:
    rows = ({"step": k, "stage": 1, "seconds": 2.0 * k, "image": 1 / (1 + k), **terms} for k in steps)
    return "".join(json.dumps(row) + "\n" for row in rows)


def _status(run: Path, **changes: object) -> None:
    values = {"phase": "geometry", "step": 0, "steps": 100, "seconds": 18.0, "seconds_left": 180.0, "ended": None}
    (run / "status.json").write_text(json.dumps(values | changes))


@pytest.fixture
def run(tmp_path) -> Path:
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "config.json").write_text("{}")
    _status(folder, step=10)
    (folder / "metrics.jsonl").write_text(_rows(*range(10)))
    write_image(folder / "previews/step_000005.png", np.zeros((4, 4, 3), np.uint8))
    return folder


def test_progress_and_losses_follow_the_files(run):
    training = Training(ViewOptions(run))
    state = training.state()
    assert (state["done"], state["total"], state["ended"], state["avatar"]) == (10, 100, None, False)
    assert state["seconds_left"] == pytest.approx(180)
    assert [value for _, value in state["curves"]["image"]] == pytest.approx([1 / (1 + k) for k in range(10)])
    with (run / "metrics.jsonl").open("a") as stream:
        stream.write(_rows(10, image=float("nan")) + "damaged\n" + '{"step": 11, "ima')
    state = training.state()
    assert len(state["curves"]["image"]) == 10  # NaN is no point, nor a line being written
    replacement = run / "new"
    replacement.write_text(_rows(0, 1))  # as --resume cuts the log
    replacement.replace(run / "metrics.jsonl")
    assert len(training.state()["curves"]["image"]) == 2
    _status(run, phase="searching the light", seconds_left=7, ended="stopped")
    state = training.state()
    assert (state["phase"], state["seconds_left"], state["ended"]) == ("searching the light", 7, "stopped")


def test_long_curves_are_binned(run):
    (run / "metrics.jsonl").write_text(_rows(*range(1000)))
    assert len(Training(ViewOptions(run)).state()["curves"]["image"]) <= POINTS


def test_a_folder_without_a_training_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"config\.json"):
        Training(ViewOptions(tmp_path))


def _read(url: str, path: str) -> bytes:
    with urllib.request.urlopen(url.replace("/?", f"/{path}?"), timeout=10) as answer:
        return answer.read()


def test_the_page_and_previews_are_served_and_nothing_else(run):
    with serve(Training(ViewOptions(run)), "127.0.0.1", 0, "s3cret") as (server, url), answering(server):
        assert b"training.js" in _read(url, "")
        assert json.loads(_read(url, "training.json"))["previews"] == ["step_000005.png"]
        assert _read(url, "previews/step_000005.png") == (run / "previews/step_000005.png").read_bytes()
        for path in ("previews/../config.json", "previews/config.json", "config.json", "previews/step_1.png"):
            with pytest.raises(urllib.error.HTTPError, match="404"):
                _read(url, path)


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")
def test_it_grows_in_a_browser_and_the_avatar_opens_once_it_is_there(run, tmp_path):
    training = Training(ViewOptions(run, size=(64, None), raster="cpu"))
    with (
        serve(training, "127.0.0.1", 0, "s3cret") as (server, url),
        answering(server),
        chromium(tmp_path / "profile") as page,
    ):
        page.open(url)
        page.wait("document.getElementById('facts')?.textContent.includes('10 of 100')")
        page.wait("document.getElementById('preview').naturalWidth === 4")
        assert page.run("document.querySelectorAll('#curves path').length") == 1
        assert not AXE.is_file() or violations(page) == []
        with (run / "metrics.jsonl").open("a") as stream:
            stream.write(_rows(10, 11))
        _status(run, step=12)
        page.wait("document.getElementById('facts').textContent.includes('12 of 100')")
        (run / "avatar.onnx").symlink_to(ASSETS / "avatar.onnx")
        page.wait("!document.getElementById('avatar').hidden")
        page.run("document.getElementById('avatar').click()")
        page.wait("window.rnd && rnd.scene()")
        assert page.messages == []
    training.close()
