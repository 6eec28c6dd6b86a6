"""rnd-report: one page, whole, offline, and true to the files of the run."""

from __future__ import annotations

import base64
import json
import re
import shutil
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import onnx
import pytest

from rnd_runtime.core.files import sha256_of
from rnd_runtime.core.images import read_image, write_image
from rnd_trainer.config import TrainConfig, to_dict
from rnd_viewer.report import renders
from rnd_viewer.report.cli import main
from rnd_viewer.report.html_parts import curve
from support.axe import needs_axe, violations
from support.browser import CHROMIUM, chromium
from support.tiny import ASSETS

VOID = {"meta", "img", "input", "link", "br"}
ROW = {
    "split": "novel_view",
    "frames": 2,
    "psnr": 27.3456,
    "ssim": 0.95,
    "psnr_box": 22.0,
    "ssim_box": 0.8,
    "normal_deg": 10.0,
    "lpips": None,
    "psnr_n": 19.0,
    "flicker": 24.087,
    "minutes": 6.5,
    "capture": "me & <you>",
    "steps": 100,
    "seed": 0,
    "gaussians": 800,
    "machine": "a test",
}
SVG = '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 1 1"/>'


class _Page(HTMLParser):
    """Every opened tag is closed in order; collects attributes and text."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data) -> None:
        self.text += data


def _strip() -> np.ndarray:
    """Truth 200, render 100, normals 50, albedo 150, error 90, of a person in the middle of 40²."""
    tiles = np.zeros((5, 40, 40, 3), np.uint8)
    for tile, value in zip(tiles, (200, 100, 50, 150, 90)):
        tile[15:30, 18:24] = value
    return np.concatenate(list(tiles), axis=1)


@pytest.fixture
def run(tmp_path, monkeypatch) -> Path:
    """The folder of a training, as far as the report reads it; small images of the avatar; no assets here."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(renders, "SIDE", 64)
    monkeypatch.setattr(renders, "SECONDS", 0.1)
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "config.json").write_text(json.dumps(to_dict(TrainConfig(steps=100))))
    rows = [{"step": k, "stage": 1 + (k >= 25), "seconds": k / 10, "image": 1 / (1 + k)} for k in range(100)]
    rows[7] |= {"image": float("nan"), "skipped": True}
    (folder / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    (folder / "eval.json").write_text(json.dumps([ROW, ROW | {"split": "relight, albedo scaled"}]))
    for name in ("a", "b", "c", "d"):
        write_image(folder / f"eval/novel_view/{name}.png", _strip())
    shutil.copy(ASSETS / "avatar.onnx", folder / "avatar.onnx")
    return folder


def _write(run: Path, *words: str) -> tuple[str, _Page]:
    assert main([str(run), *words]) == 0
    text = (run / "report.html").read_text(encoding="utf-8")
    return text, _Page(text)


def _images(page: _Page, tmp_path: Path) -> dict[str, np.ndarray]:
    images = {}
    for tag, attributes in page.tags:
        if tag == "img" and "image/png" in attributes["src"]:
            (tmp_path / "x.png").write_bytes(base64.b64decode(attributes["src"].partition(",")[2]))
            images[attributes["alt"]] = read_image(tmp_path / "x.png")
    return images


def test_a_whole_run_is_on_the_page(run, tmp_path):
    bench = _bench(tmp_path / "bench", {"id": "P2", "what": "edges, <worst>", "measured": 0.61}, "grid")
    sky = str(ASSETS / "sky.exr")
    text, page = _write(run, "--hdr", sky, "--bench", str(bench), "--motion", str(ASSETS / "walk.npz"))
    for tag, attributes in page.tags:  # nothing is fetched from anywhere
        for name in ("src", "href"):
            assert (attributes.get(name) or "data:").startswith(("data:", "#")), (tag, attributes)
    identities = [attributes.get("id") for _, attributes in page.tags]
    assert [attributes["href"][1:] in identities for tag, attributes in page.tags if tag == "a"] == 7 * [True]
    assert "http" not in text and "url(" not in text
    assert "me & <you>" in page.text and "800 Gaussians" in page.text
    assert "27.35" in page.text and "PSNR of normals" in page.text
    assert "LPIPS" not in page.text  # a column nobody measured is no column
    assert "1 steps were not finite" in page.text
    assert "P2" in page.text and "edges, <worst>" in page.text and "0.61" in page.text
    (chart,) = [attributes["src"] for _, attributes in page.tags if (attributes.get("alt") or "").endswith(": grid")]
    assert base64.b64decode(chart.removeprefix("data:image/svg+xml;base64,")).startswith(b"<svg")
    assert "weight_normal" in page.text and "model.gaussians" in page.text
    images = _images(page, tmp_path)
    lights = ("learned light, 0°", "learned light, 270°", "sky")
    front = [images[f"the avatar from the front: {name}"] for name in (*lights, "its albedo", "its roughness")]
    assert (front[2] != front[0]).any() and len({image.shape for image in front}) == 1
    for edge in (front[0][:9], front[0][-9:], front[0][:, :9], front[0][:, -9:]):
        assert edge.max() > 8  # cropped to the person
    for seldom in ("back of the head", "left palm", "right sole"):
        shown = images[f"{seldom}: albedo"].max(-1) > 0
        assert shown.mean() > 0.1 and shown[96:128, 96:128].all(), seldom  # the camera looks at it
    strips = [name for name in images if name.startswith("truth, ")]
    assert strips == ["truth, a", "truth, b", "truth, c"]  # three of four, spread
    for what, value in (("truth", 200), ("render", 100), ("normals", 50), ("albedo", 150), ("error", 90)):
        assert images[f"{what}, a"].max() == value
    assert images["truth, a"].shape[:2] == (15 + 16, 6 + 16)  # cropped to the person and a margin
    (clip,) = [attributes["src"] for tag, attributes in page.tags if tag == "video"]
    assert base64.b64decode(clip.partition(",")[2])[4:8] == b"ftyp"


@pytest.mark.slow
@needs_axe
def test_no_rule_of_accessibility_is_broken_by_day_and_by_night(run, tmp_path):
    _write(run, "--bench", str(_bench(tmp_path / "bench", {"id": "P2", "what": "edges"}, "grid")))
    with chromium(tmp_path / "profile", size=(390, 844)) as page:
        page.open((run / "report.html").as_uri())
        page.wait("document.readyState === 'complete' && document.querySelector('h2')")
        for scheme in ("light", "dark"):
            page.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])
            assert violations(page) == []


def _bench(folder: Path, row: dict[str, object] | None = None, *charts: str) -> Path:
    folder.mkdir(parents=True)
    if row is not None:
        (folder / "stability.json").write_text(json.dumps([row]))
    for name in charts:
        (folder / f"{name}.svg").write_text(SVG)
    return folder


def test_benchmarks_of_the_software_are_shown_where_they_are_named_alone(run, tmp_path, capsys):
    bench = _bench(run / "bench", {"id": "P1", "what": "of the software"})
    assert "of the software" not in _write(run)[1].text
    assert "of the software" in _write(run, "--bench", str(bench))[1].text
    (bench / "stability.json").unlink()
    assert main([str(run), "--bench", str(bench)]) == 2
    assert "bench: --bench: expected crossed.svg or grid.svg or stability.json, got none" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")
def test_the_whole_of_a_training_has_four_screens_of_a_desk_and_six_of_a_phone(run, tmp_path):
    """Of the README's capture: four splits of ten frames, thirteen terms of loss."""
    for split in range(4):
        for frame in range(10):
            tiles = np.zeros((5, 256, 256, 3), np.uint8)
            tiles[:, 20:236, 70 : 190 - 5 * split] = 99 + 10 * split
            write_image(run / f"eval/split{split}/{frame:03d}.png", np.concatenate(list(tiles), axis=1))
    terms = {f"term{k}": 0.1 for k in range(12)}
    rows = [{"step": k, "stage": 1, "image": 1 / (1 + k), **terms} for k in range(9)]
    (run / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    (run / "eval.json").write_text(json.dumps([ROW | {"split": f"split {k}"} for k in range(5)]))
    shutil.rmtree(run / "eval/novel_view")
    _write(run, "--hdr", str(ASSETS / "sky.exr"))
    with chromium(tmp_path / "profile", size=(1440, 900)) as page:
        page.open((run / "report.html").as_uri())
        page.wait("document.readyState === 'complete' && [...document.images].every(({ complete }) => complete)")
        assert page.run("document.images.length") > 60
        assert 3 < page.run("document.documentElement.scrollHeight / 900") <= 4
        assert page.run("document.documentElement.scrollWidth") == 1440
        page.call("Emulation.setDeviceMetricsOverride", width=390, height=844, deviceScaleFactor=2, mobile=True)
        assert 3 < page.run("document.documentElement.scrollHeight / 844") <= 6
        assert page.run("document.documentElement.scrollWidth") == 390
        page.run("document.querySelector('.shots').focus()")  # what does not fit is reached by the keyboard
        page.call("Input.dispatchKeyEvent", type="rawKeyDown", windowsVirtualKeyCode=39, key="ArrowRight")
        page.wait("document.querySelector('.shots').scrollLeft > 0")


def test_what_a_run_lacks_is_named(run):
    for name in ("avatar.onnx", "eval.json", "metrics.jsonl"):
        (run / name).unlink()
    shutil.rmtree(run / "eval")
    _, page = _write(run)
    for words in ("rnd-export", "no eval.json", "--strips RUN/eval", "no metrics.jsonl"):
        assert words in page.text
    assert not any(tag in ("img", "video", "svg") for tag, _ in page.tags)


def test_the_avatar_of_another_checkpoint_is_not_shown(run, capsys):
    made_of = "avatar.onnx is of another checkpoint than avatar.ckpt"
    (run / "avatar.ckpt").write_bytes(b"trained")
    model = onnx.load(run / "avatar.onnx")
    (about,) = (entry for entry in model.metadata_props if entry.key == "rnd_avatar")
    source = json.loads(about.value) | {"checkpoint_sha256": sha256_of(run / "avatar.ckpt")}
    about.value = json.dumps(source)
    onnx.save(model, run / "avatar.onnx")
    _, page = _write(run)
    assert made_of not in page.text and any(tag == "video" for tag, _ in page.tags)
    (run / "avatar.ckpt").write_bytes(b"trained since")
    _, page = _write(run)
    assert made_of in page.text and f"warning: {made_of}" in capsys.readouterr().err
    assert not any(tag == "video" for tag, _ in page.tags)


def test_a_second_stage_is_marked_where_the_rows_begin_it(run):
    second = "marks the second stage, the light"
    text, page = _write(run)
    (mark,) = re.findall(r'<line class="stage" x1="([\d.]+)"', text)
    assert second in page.text and float(mark) == pytest.approx(42 + 25 / 99 * 270, abs=0.06)
    (run / "avatar.onnx").unlink()
    (run / "config.json").write_text(json.dumps(to_dict(TrainConfig(steps=100, light="none"))))
    rows = [{"step": k, "stage": 1, "image": 1 / (1 + k)} for k in range(100)]
    (run / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    text, page = _write(run)
    assert second not in page.text and 'class="stage"' not in text
    assert "rnd-export" not in page.text and "--light none is not exported" in page.text


def test_a_probe_made_for_a_z_up_world_is_turned_upright(run, tmp_path):
    sky = "--hdr", str(ASSETS / "sky.exr")
    front = "the avatar from the front: sky"
    images = [_images(_write(run, *sky, "--hdr-up", up)[1], tmp_path)[front] for up in "yz"]
    assert (images[0] != images[1]).any()
    assert main([str(run), "--hdr-up", "z"]) == 2


def test_a_line_that_was_begun_when_the_training_was_ended_is_left_out(run):
    rows = [{"step": 1, "image": 0.5}, {"step": 0, "image": 1e305}]
    (run / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows) + '{"step": 2, "ima')
    _, page = _write(run)
    assert "image, last 0.5" in page.text and "2 steps" in page.text


def test_notes_on_motion_and_light_are_on_the_page_and_logged(run, tmp_path, capsys):
    broken = np.ones((16, 32, 3), np.float32)
    broken[3, 4] = np.nan
    write_image(tmp_path / "nan.exr", broken)
    np.savez(tmp_path / "still.npz", poses=np.zeros((2, 72)), trans=np.zeros((2, 3)))
    _, page = _write(run, "--hdr", str(tmp_path / "nan.exr"), "--motion", str(tmp_path / "still.npz"))
    printed = capsys.readouterr().err
    for note in ("nan.exr: 1 texels of the light were NaN", "no frame rate in the file: 60 frames per second"):
        assert f"Note: {note}" in page.text and f"warning: {note}" in printed


def test_a_curve_goes_through_the_points():
    figure = curve(range(100), [10.0 ** (-k / 99) for k in range(100)], "image", 25)
    (path,) = re.findall(r'<path d="([^"]+)"', figure)
    points = np.array(re.findall(r"([\d.]+) ([\d.]+)", path), float)
    assert len(points) == 100
    np.testing.assert_allclose(np.diff(points[:, 0]), (320 - 42 - 8) / 99, atol=0.11)  # tenths are stored
    slope = np.diff(points[:, 1])
    assert slope.min() > 0 and np.ptp(slope) < 0.21  # a straight line downwards: y grows downwards in SVG
    assert ">1<" in figure and ">0.1<" in figure and 'class="stage"' in figure and "last 0.1" in figure
    assert "<path" not in curve([0, 1], [0.0, -1.0], "nothing", None)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("config.json", None, "config.json: config.json of rnd-train not found"),
        ("eval.json", "{", "eval.json: not JSON"),
        ("metrics.jsonl", '{"step": 0\n', "metrics.jsonl: not JSON lines"),
        ("metrics.jsonl", '{"step": NaN}', "metrics.jsonl: step: expected a number, 0 to 1e+12, got NaN"),
        ("metrics.jsonl", f'{{"step": 1, "image": 1{"0" * 400}}}', "image: expected a number, got 1000"),
        ("metrics.jsonl", "3", "metrics.jsonl: expected a step in every line"),
        ("metrics.jsonl", '{"step": null}', "metrics.jsonl: step: expected a number, got null"),
        ("metrics.jsonl", '{"step": 0, "image": [1]}', "metrics.jsonl: image: expected a number, got [1]"),
        ("config.json", "[]", "config.json of rnd-train: expected an object"),
        ("eval.json", '[{"split": 3}]', "eval.json: split: expected a text, got 3"),
        ("eval.json", '[{"split": "a", "psnr": "?"}]', 'eval.json: psnr: expected a number, got "?"'),
        ("eval.json", '{"summary": [], "rows": []}', "eval.json: expected rows of rnd-eval"),  # of an ablation
        ("bench/stability.json", '[{"id": "P1"}]', "stability.json: expected rows of rnd-bench stability"),
        ("bench/grid.json", "3", "grid.json: expected rows of rnd-bench"),
        ("avatar.onnx", "onnx", "avatar.onnx: "),
    ],
)
def test_a_damaged_run_is_refused_in_one_line(run, name, content, message, capsys):
    bench = _bench(run / "bench", None, "grid")
    (run / name).unlink() if content is None else (run / name).write_text(content)
    assert main([str(run), "--bench", str(bench)]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert not (run / "report.html").exists()


@pytest.mark.parametrize("option", ["--hdr", "--motion"])
@pytest.mark.parametrize("why", ["no avatar.onnx in the run", "avatar.onnx is of another checkpoint"])
def test_what_only_an_avatar_can_show_needs_one(run, option, why, capsys):
    if why.startswith("no "):
        (run / "avatar.onnx").unlink()
    else:
        (run / "avatar.ckpt").write_bytes(b"trained since")
    assert main([str(run), option, str(ASSETS / "sky.exr")]) == 2
    assert f"{option}: expected an avatar that can be shown ({why}" in capsys.readouterr().err
    assert not (run / "report.html").exists()


@pytest.mark.parametrize(
    ("out", "message"),
    [
        ("config.json", "--out: expected a name in .html, got"),
        ("a.html", "a.html: cannot be written: it is a folder"),
        ("config.json/a.html", "config.json: output folder cannot be made"),
    ],
)
def test_a_page_that_cannot_be_written_is_refused_before_anything_is_filmed(run, out, message, monkeypatch, capsys):
    (run / "a.html").mkdir()
    monkeypatch.setattr(renders.Avatar, "load", None)
    before = (run / "config.json").read_bytes()
    assert main([str(run), "--out", str(run / out)]) == 2
    assert message in capsys.readouterr().err and (run / "config.json").read_bytes() == before
