"""rnd-report: one page, whole, offline, and true to the files of the run."""

from __future__ import annotations

import base64
import json
import os
import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import onnx
import pytest

from rnd_runtime.core.files import sha256_of
from rnd_runtime.core.images import read_image, write_image
from rnd_trainer.config import TrainConfig, to_dict
from rnd_viewer.report import renders as report_shots
from rnd_viewer.report.cli import main
from rnd_viewer.report.html_parts import curve
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
OTHER = "0123456789abcdef" * 4  # the checkpoint of somebody else's avatar
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
    """The folder of a training, as far as the report reads it; small pictures of the avatar; no assets here."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(report_shots, "SIDE", 64)
    monkeypatch.setattr(report_shots, "SECONDS", 0.1)
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


def _pictures(page: _Page, tmp_path: Path) -> dict[str, np.ndarray]:
    pictures = {}
    for tag, attributes in page.tags:
        if tag == "img" and "image/png" in attributes["src"]:
            (tmp_path / "x.png").write_bytes(base64.b64decode(attributes["src"].partition(",")[2]))
            pictures[attributes["alt"]] = read_image(tmp_path / "x.png")
    return pictures


def test_a_whole_run_is_on_the_page(run, tmp_path):
    bench = _bench(tmp_path / "bench", {"id": "P2", "what": "edges, <worst>", "measured": 0.61}, "grid")
    sky = str(ASSETS / "sky.exr")
    text, page = _write(run, "--hdr", sky, "--bench", str(bench), "--motion", str(ASSETS / "walk.npz"))
    for tag, attributes in page.tags:  # nothing is fetched from anywhere
        for name in ("src", "href"):
            assert (attributes.get(name) or "data:").startswith("data:"), (tag, attributes)
    assert "http" not in text and "url(" not in text
    assert "me & <you>" in page.text and "800 Gaussians" in page.text
    assert "27.35" in page.text and "PSNR of normals" in page.text
    assert "LPIPS" not in page.text  # a column nobody measured is no column
    assert "1 steps were not finite" in page.text
    assert "P2" in page.text and "edges, <worst>" in page.text and "0.61" in page.text
    (chart,) = [attributes["src"] for _, attributes in page.tags if attributes.get("alt") == "grid"]
    assert base64.b64decode(chart.removeprefix("data:image/svg+xml;base64,")).startswith(b"<svg")
    assert "weight_normal" in page.text and "model.gaussians" in page.text
    pictures = _pictures(page, tmp_path)
    assert {"learned light, 0°", "learned light, 270°", "sky", "albedo", "roughness"} <= set(pictures)
    assert (pictures["sky"] != pictures["learned light, 0°"]).any()
    strips = [name for name in pictures if name.startswith("truth, ")]
    assert strips == ["truth, a", "truth, b", "truth, c"]  # three of four, spread
    for what, value in (("truth", 200), ("render", 100), ("normals", 50), ("albedo", 150), ("error", 90)):
        assert pictures[f"{what}, a"].max() == value
    assert pictures["truth, a"].shape[:2] == (15 + 16, 6 + 16)  # cropped to the person and a margin
    (clip,) = [attributes["src"] for tag, attributes in page.tags if tag == "video"]
    assert base64.b64decode(clip.partition(",")[2])[4:8] == b"ftyp"


def _bench(folder: Path, row: dict[str, object] | None = None, *charts: str) -> Path:
    folder.mkdir(parents=True)
    if row is not None:
        (folder / "stability.json").write_text(json.dumps([row]))
    for name in charts:
        (folder / f"{name}.svg").write_text(SVG)
    return folder


def test_charts_come_from_the_run_or_else_from_a_checkout(run, tmp_path):
    words = f"neither {run / 'bench'} nor assets/bench is there: --bench FOLDER"
    assert words in _write(run)[1].text
    _bench(tmp_path / "assets/bench", {"id": "P1", "what": "of the checkout"}, "crossed")
    _, page = _write(run)
    assert "of the checkout" in page.text
    assert "From assets/bench/crossed.svg" in page.text and "From assets/bench/stability.json" in page.text
    own = _bench(run / "bench", {"id": "P1", "what": "of the run"})
    _, page = _write(run)
    assert "of the run" in page.text and "of the checkout" not in page.text
    assert f"From {own / 'stability.json'}" in page.text
    named = _bench(tmp_path / "named", {"id": "P1", "what": "of another"})
    assert "of another" in _write(run, "--bench", str(named))[1].text


@pytest.mark.parametrize("shown", ["crossed", "grid"])
def test_one_chart_of_speed_is_shown_and_no_other(run, shown):
    folder = _bench(run / "bench", None, "grid", "lengths", "speed", *{shown} - {"grid"})
    (folder / f"{shown}.json").write_text(json.dumps([{"machine": "a"}, {"machine": "b"}, {"machine": "a"}]))
    _, page = _write(run)
    charts = [attributes["alt"] for _, attributes in page.tags if attributes.get("class") == "chart"]
    assert charts == [shown]
    assert f"{shown}.svg, measured on a; b. On which avatar is not said" in page.text


@pytest.mark.parametrize(
    ("checkpoints", "words"),
    [
        (("own",), "Measured on this run's avatar. ✓"),
        ((OTHER,), "Measured on another avatar, not on this run's (its checkpoint: 0123456789ab). ✓"),
        (("own", OTHER, OTHER), "1 rows measured on this run's avatar, 2 on another"),
        (("own", None), "Measured on this run's avatar. 1 of 2 rows name no avatar."),
        ((None,), "On which avatar is not said"),
    ],
)
def test_the_stability_table_says_on_whose_avatar_it_was_measured(run, checkpoints, words):
    (run / "avatar.onnx").unlink()
    (run / "avatar.ckpt").write_bytes(b"trained")
    own = sha256_of(run / "avatar.ckpt")
    rows = [
        {"id": "P1", "what": "edges"} | ({} if name is None else {"checkpoint_sha256": name})
        for name in (own if name == "own" else name for name in checkpoints)
    ]
    (_bench(run / "bench") / "stability.json").write_text(json.dumps(rows))
    assert words in _write(run)[1].text


def test_a_run_without_a_checkpoint_claims_no_measurement(run):
    _bench(run / "bench", {"id": "P1", "what": "edges", "checkpoint_sha256": OTHER})
    assert "checkpoint 0123456789ab; this run has no avatar.ckpt to compare" in _write(run)[1].text


def _table(page_text: str, title: str) -> list[list[tuple[str, str]]]:
    """Rows of (class, text) of the table below ``title``, the headings first."""
    body = page_text.partition(title)[2].partition("</table>")[0]
    cells = re.compile(r'<t[hd](?: class="(\w+)")?>([^<]*)</t[hd]>')
    return [cells.findall(line) for line in body.split("<tr>")[1:]]


def test_tables_have_the_columns_that_matter_below_headings_that_stand_as_they_do(run):
    more = {"ssim_n": 0.9, "lpips": 0.0123, "lpips_inner": 0.1, "psnr_albedo": 24.5, "outline_px": 0.25}
    (run / "eval.json").write_text(json.dumps([ROW | more]))
    row = {
        "id": "P1",
        "failure": "a squat",
        "what": "edges",
        "measured": 2.77897,
        "unit": "×",
        "line": "< 3",
        "verdict": "fail",
        "baseline": 3.89788,
        "baseline_name": "LBS",
        "machine": "a",
        "threads": 2,
        "size": 512,
    }
    _bench(run / "bench", row)
    text, _ = _write(run)
    scores, stability = _table(text, "Held-out quality"), _table(text, "Stability</h3>")
    assert [cell for _, cell in scores[0]] == [
        "split",
        "frames",
        "PSNR, dB",
        "SSIM",
        "LPIPS",
        "PSNR in the box, dB",
        "PSNR of normals, dB",
        "normals off by, °",
        "PSNR of albedo, dB",
        "outline off by, px",
    ]
    assert [cell for _, cell in scores[1]] == [
        "novel_view",
        "2",
        "27.35",
        "0.9500",
        "0.0123",
        "22.00",
        "19.00",
        "10.0",
        "24.50",
        "0.25",
    ]
    assert [cell for _, cell in stability[0]] == [
        "id",
        "failure",
        "what was measured",
        "measured",
        "limit",
        "verdict",
        "the plain method",
    ]
    cells = [cell.replace("\N{NO-BREAK SPACE}", " ") for _, cell in stability[1]]
    assert cells == ["P1", "a squat", "edges", "2.779 ×", "&lt; 3", "✗", "LBS: 3.898 ×"]
    for head, *lines in (scores, stability):
        assert all([kind for kind, _ in line] == [kind for kind, _ in head] for line in lines)


@pytest.mark.parametrize(
    ("counts", "words"),
    [
        ({"steps": 240, "step": 360}, "· 360 steps, 240 of them with a picture ·"),
        ({"steps": 240, "step": 240}, "· 240 steps ·"),
        ({"steps": 240, "step": 100}, "· 100 of 240 steps ·"),
        ({"steps": 240, "step": None}, "· 240 steps ·"),
        ({"steps": None, "step": 240}, "800 Gaussians · 6.5 minutes"),
    ],
)
def test_the_facts_count_steps_with_and_without_a_picture(run, counts, words):
    (run / "eval.json").write_text(json.dumps([ROW | counts | {"capture": "capture"}]))
    _, page = _write(run)
    assert words in page.text
    assert "trained on capture ·" in page.text and "capture capture" not in page.text
    assert "flicker 24.09 of 255 (what jumps from frame to frame" in page.text


def test_pictures_of_a_split_that_are_those_of_another_are_left_out(run, tmp_path):
    (run / "avatar.onnx").unlink()
    (run / "eval/novel_view").rename(run / "eval/relight")
    scaled = run / "eval/relight_albedo_scaled"
    shutil.copytree(run / "eval/relight", scaled)
    _, page = _write(run)
    assert "relight" in page.text and "The same frames" not in page.text
    assert sum(tag == "img" for tag, _ in page.tags) == 5 * 3
    write_image(scaled / "a.png", _strip() // 2)
    _, page = _write(run)
    assert "The same frames, with the learned albedo brought to the scale of the true one" in page.text
    assert sum(tag == "img" for tag, _ in page.tags) == 5 * 6


def test_a_name_that_is_not_utf8_and_a_folder_called_as_a_chart_are_no_mistake(run, tmp_path):
    shutil.rmtree(run / "eval")
    (run / "avatar.onnx").unlink()
    renamed = run.rename(tmp_path / os.fsdecode(b"r\xe9n"))
    (tmp_path / "bench" / "grid.svg").mkdir(parents=True)
    _, page = _write(renamed, "--bench", str(tmp_path / "bench"))
    assert "r\\udce9n" in page.text and "neither crossed.svg nor grid.svg nor stability.json" in page.text


def test_what_a_run_lacks_is_named(run):
    for name in ("avatar.onnx", "eval.json", "metrics.jsonl"):
        (run / name).unlink()
    shutil.rmtree(run / "eval")
    _, page = _write(run)
    for words in ("rnd-export", "no eval.json", "--pictures RUN/eval", "no metrics.jsonl", "--bench FOLDER"):
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
    assert made_of in page.text and f"note: {made_of}" in capsys.readouterr().out
    assert not any(tag == "video" for tag, _ in page.tags)


def test_a_second_stage_is_marked_where_the_rows_begin_it(run):
    second = "where the second stage, the light, begins"
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
    pictures = [_pictures(_write(run, *sky, "--hdr-up", up)[1], tmp_path)["sky"] for up in "yz"]
    assert (pictures[0] != pictures[1]).any()
    assert main([str(run), "--hdr-up", "z"]) == 2


def test_pictures_are_shown_once(run, tmp_path):
    (run / "avatar.onnx").unlink()
    for words, expected in ((("--pictures", "9"), "abcd"), (("--pictures", "2"), "ac"), (("--pictures", "0"), "")):
        _, page = _write(run, *words)
        names = [name for name in _pictures(page, tmp_path) if name.startswith("truth, ")]
        assert names == [f"truth, {letter}" for letter in expected]
        assert sum(tag == "img" for tag, _ in page.tags) == 5 * len(expected)


def test_pictures_that_nobody_asked_for_are_not_missed(run):
    assert "--pictures" not in _write(run, "--pictures", "0")[1].text


def test_a_loss_that_was_no_number_is_left_out_of_its_curve(run):
    rows = [{"step": k, "image": None if k == 1 else 0.5, "normal": None} for k in range(3)]
    (run / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    _, page = _write(run)
    assert "image, last 0.5" in page.text and "normal, last" not in page.text


def test_a_line_that_was_begun_when_the_training_was_ended_is_left_out(run):
    rows = [{"step": 1, "image": 0.5}, {"step": 0, "image": 1e305}]
    (run / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows) + '{"step": 2, "ima')
    _, page = _write(run)
    assert "image, last 0.5" in page.text and "2 steps" in page.text


def test_what_is_wrong_with_motion_and_light_is_told(run, tmp_path, capsys):
    broken = np.ones((16, 32, 3), np.float32)
    broken[3, 4] = np.nan
    write_image(tmp_path / "nan.exr", broken)
    np.savez(tmp_path / "still.npz", poses=np.zeros((2, 72)), trans=np.zeros((2, 3)))
    _, page = _write(run, "--hdr", str(tmp_path / "nan.exr"), "--motion", str(tmp_path / "still.npz"))
    printed = capsys.readouterr().out
    for note in ("nan.exr: 1 texels of the light were NaN", "no frame rate in the file: 60 frames per second"):
        assert f"Note: {note}" in page.text and f"note: {note}" in printed


def test_a_folder_of_charts_that_is_not_there_is_refused(run, capsys):
    assert main([str(run), "--bench", str(run / "bemch")]) == 2
    assert capsys.readouterr().err == f"rnd-report: {run / 'bemch'}: folder of --bench not found\n"


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
        ("metrics.jsonl", '{"step": 1e999}', "metrics.jsonl: step: expected a number, 0 to 1e+12, got Infinity"),
        ("metrics.jsonl", f'{{"step": 1, "image": 1{"0" * 400}}}', "image: expected a number, got 1000"),
        ("eval.json", f'[{{"split": "a", "psnr": 1{"0" * 400}}}]', "psnr: expected a number, got 1000"),
        ("metrics.jsonl", "3", "metrics.jsonl: expected a step in every line"),
        ("metrics.jsonl", '{"step": "1"}', 'metrics.jsonl: step: expected a number, got "1"'),
        ("metrics.jsonl", '{"step": null}', "metrics.jsonl: step: expected a number, got null"),
        ("metrics.jsonl", '{"step": 0, "image": [1]}', "metrics.jsonl: image: expected a number, got [1]"),
        ("config.json", "[]", "config.json of rnd-train: expected an object"),
        ("config.json", "[" * 100_000, "config.json: not JSON"),
        ("eval.json", '[{"split": 3}]', "eval.json: split: expected a text, got 3"),
        ("eval.json", '[{"split": "a", "psnr": "?"}]', 'eval.json: psnr: expected a number, got "?"'),
        ("eval.json", '{"summary": [], "rows": []}', "eval.json: expected rows of rnd-eval"),  # of an ablation
        ("bench/stability.json", "{", "stability.json: not JSON"),
        ("bench/stability.json", '[{"id": "P1"}]', "stability.json: expected rows of rnd-bench stability"),
        ("bench/grid.json", "3", "grid.json: expected rows of rnd-bench"),
        ("avatar.onnx", "onnx", "avatar.onnx: not a readable ONNX model"),
    ],
)
def test_a_damaged_run_is_one_line_and_exit_2(run, name, content, message, capsys):
    _bench(run / "bench", None, "grid")
    (run / name).unlink() if content is None else (run / name).write_text(content)
    assert main([str(run)]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert not (run / "report.html").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--loop", "--smooth", "2"), "--smooth: expected the default, got 2.0"),
        (("--loop",), "--loop: expected the default, got True"),
        (("--motion-up", "z"), "--motion-up: expected the default, got z"),
    ],
)
def test_options_of_a_motion_that_is_not_there_are_refused(run, words, message, capsys):
    assert main([str(run), *words]) == 2
    error = capsys.readouterr().err
    assert f"{message} (needs --motion" in error and error.count("\n") == 1
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
    monkeypatch.setattr(report_shots.Avatar, "load", None)
    before = (run / "config.json").read_bytes()
    assert main([str(run), "--out", str(run / out)]) == 2
    assert message in capsys.readouterr().err and (run / "config.json").read_bytes() == before


@pytest.mark.skipif(shutil.which("chromium") is None, reason="chromium is not installed")
def test_the_slider_moves_in_a_browser(run, tmp_path):
    text, _ = _write(run)
    script = """<script>const i = document.querySelector(".ab input"); i.value = 20;
      i.dispatchEvent(new Event("input"));
      const ok = [...document.images].every(p => p.complete && p.naturalWidth);
      document.title = [ok, getComputedStyle(i.parentElement.children[1]).clipPath].join(" ");</script></body>"""
    page = tmp_path / "page.html"
    page.write_text(text.replace("</body>", script), encoding="utf-8")
    line = ["chromium", "--headless", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=1500"]
    line += [f"--user-data-dir={tmp_path / 'profile'}", "--dump-dom", page.as_uri()]
    dom = subprocess.run(line, capture_output=True, text=True, timeout=120, check=True).stdout
    assert "<title>true inset(0px 0px 0px 20%)</title>" in dom


@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")
def test_tables_fit_a_window_and_what_does_not_scrolls_in_its_own_box(run, tmp_path):
    (run / "avatar.onnx").unlink()
    scores = json.loads((ASSETS / "bench/capture.json").read_text())
    (run / "eval.json").write_text(json.dumps(scores))
    (run / "config.json").write_text(json.dumps(to_dict(TrainConfig(steps=100)) | {"x" * 400: 1}))
    write_image(run / "eval/novel_view/a.png", np.full((30, 5 * 500, 3), 99, np.uint8))
    _write(run, "--bench", str(ASSETS / "bench"))
    with chromium(tmp_path / "profile", size=(1200, 900)) as page:
        page.open((run / "report.html").as_uri())
        page.wait("document.readyState === 'complete' && document.querySelector('table')")
        page.run("document.querySelector('details').open = true")
        boxes = "[...document.querySelectorAll('table')].map((t) => [t.offsetWidth, t.parentElement.clientWidth])"
        (quality, box), (stability, _), (options, _) = page.run(boxes)
        assert max(quality, stability, box) <= 1150 < options
        assert page.run("document.documentElement.scrollWidth") <= 1200
        cut = """[...document.querySelectorAll("*")].filter((e) => e.scrollWidth > e.clientWidth + 1
            && getComputedStyle(e).overflowX === "hidden").length"""
        assert page.run(cut) == 0
