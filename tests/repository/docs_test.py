"""The documentation is true: its commands run, their options exist, its errors are raised, its figures are the files'.

A fenced ``sh`` block is run line by line (``doc_commands``) in a folder that has ``assets``; blocks of one page
share it. A ``python`` block that starts with ``# file: NAME`` is written to NAME.
"""

from __future__ import annotations

import importlib
import re
import runpy
import sys
from pathlib import Path

import numpy as np
import pytest

from rnd_runtime.avatar.avatar import Avatar
from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_runtime.motion.motion import Motion
from support.doc_commands import FENCED, ROOT, SCRIPTS, blocks, copy_assets, run
from support.tiny import ASSETS
from trainer.losses.perceptual_test import write_alexnet

PAGES = sorted((ROOT / "docs").glob("*.md"))
FRONT_PAGES = [ROOT / name for name in ("README.md", "viewer/web/README.md", "assets/README.md")]
LOOKS_LIKE_A_COMMAND = re.compile(r"^ +(?:rnd-\w+|python|pip|npm|\./scripts/\w+) .*|^ +\./scripts/\w+$", re.MULTILINE)
FLOAT32_STEPS = 1e-5  # m: the example computes its bones in float64, the player in its own order


def _page(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


# own-video.md needs a video and poses: tests/own_video_test.py makes them and runs its commands
@pytest.mark.parametrize(
    "page", [p for p in (*PAGES, *FRONT_PAGES) if p.stem != "own-video"], ids=lambda page: str(page.relative_to(ROOT))
)
def test_commands_run(page, tmp_path, monkeypatch):
    copy_assets(tmp_path)
    write_alexnet(tmp_path / "alexnet.safetensors")
    monkeypatch.chdir(tmp_path)
    for block in blocks(page):
        if block.kind == "python" and block.body.startswith("# file: "):
            name = block.body.splitlines()[0].removeprefix("# file: ")
            Path(name).write_text(block.body, encoding="utf-8")
        elif block.kind == "sh" and block.reason is None:
            for words in block.commands():
                run(words, monkeypatch)


@pytest.mark.parametrize("page", [*PAGES, *FRONT_PAGES], ids=lambda page: str(page.relative_to(ROOT)))
def test_what_is_not_run_installs_or_names_the_test_that_runs_it(page):
    for block in blocks(page):
        if block.kind != "sh" or block.reason is None:
            continue
        named = re.search(r"(?:^|\W)((?:tests|scripts)/[\w./-]*\w|\.ci/run)", block.reason)
        assert named and (ROOT / named[1]).is_file(), (page.name, block.reason)
        where = (ROOT / named[1]).read_text(encoding="utf-8")
        for words in block.commands():
            name = next(word for word in words if word not in ("python", "-m")).removeprefix("./")
            assert name in where, (page.name, words, named[1])


@pytest.mark.parametrize("page", [*PAGES, *FRONT_PAGES], ids=lambda page: str(page.relative_to(ROOT)))
def test_every_command_stands_in_a_block_that_is_run(page):
    """None is merely indented, where ``test_commands_run`` would not see it."""
    outside = FENCED.sub("", page.read_text(encoding="utf-8"))
    assert not LOOKS_LIKE_A_COMMAND.findall(outside)


def _help(command: str, capsys, monkeypatch) -> str:
    module, function = SCRIPTS[command.split()[0]].split(":")
    monkeypatch.setattr(sys, "argv", [*command.split(), "--help"])
    monkeypatch.setenv("COLUMNS", "300")
    with pytest.raises(SystemExit):
        raise SystemExit(getattr(importlib.import_module(module), function)())
    return capsys.readouterr().out


def test_options_exist(capsys, monkeypatch):
    """Every option that a page or the README gives to a command of ours is in that command's help."""
    wanted: dict[str, set[str]] = {}
    for page in [*PAGES, ROOT / "README.md"]:
        text = page.read_text(encoding="utf-8").replace("\\\n", " ").replace("-->", "").replace("; rnd-", " | rnd-")
        for name, rest in re.findall(r"\b(rnd-[a-z]+)((?: +[^\s`|]+)*)", text):
            if name not in SCRIPTS:
                continue
            words = rest.split()
            grouped = name in ("rnd-convert", "rnd-bench", "rnd-data", "rnd-stage")
            grouped = grouped and bool(words) and words[0].replace("-", "").isalpha()
            if grouped and name == "rnd-stage" and words[0].startswith("--"):
                grouped = False  # filming, which has no name of its own
            command = f"{name} {words[0]}" if grouped else name
            options = {word.strip("(),.;:") for word in words if word.startswith("--")}
            wanted.setdefault(command, set()).update(options - {"--help"})
    assert len(wanted) > 5
    for command, options in wanted.items():
        if options:
            shown = _help(command, capsys, monkeypatch)
            missing = sorted(option for option in options if option.split("=")[0] not in shown)
            assert not missing, (command, missing)


def test_the_errors_explained_are_those_raised():
    """Each message in the first column of a table is made by the sources; … stands for what differs each time."""
    sources = "\n".join(
        file.read_text(encoding="utf-8")
        for folder in ("runtime", "trainer", "export", "viewer")
        for file in (ROOT / folder).rglob("*.py")
    )
    literals = set(re.findall(r"""["']([^"'\n]+)["']""", re.sub(r'"\s*\n\s*f?"', "", sources)))
    fixed = {text: re.sub(r"\{.*?\}", "", text) for text in literals}
    patterns = [
        re.compile(re.sub(r"\\\{.*?\\\}", ".+", re.escape(text)))
        for text in literals
        if "{" in text and "{}" not in text and re.search(r"[a-z]{2}", fixed[text])
    ]
    rows = re.findall(r"^\| (`.+?) \|", _page("docs/troubleshooting.md"), re.MULTILINE)
    messages = [message for row in rows for message in re.findall(r"`([^`]+)`", row)]
    assert len(messages) > 40
    for message in messages:
        for piece in re.split(r"^expected |: expected |, got |: |, no |\(|…", message):
            words = piece.strip()
            made = any(words in text for text in literals) or any(p.fullmatch(words) for p in patterns)
            assert not words or words.endswith((".json", ".onnx")) or made, (message, words)


def test_tables_are_those_of_the_files():
    script = runpy.run_path(str(ROOT / "scripts/doc_tables.py"))
    for page, pictures in script["PAGES"].items():
        text = page.read_text(encoding="utf-8")
        assert "<!-- table: " in text
        assert script["filled"](text, ASSETS / "bench", pictures) == text, "run: python scripts/doc_tables.py"


def _anchors(page: Path) -> set[str]:
    """What GitHub calls the headings of ``page``."""
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    headings = [re.sub(r"\]\([^)]*\)", "]", line) for line in re.findall(r"^#+ +(.+?) *$", text, re.MULTILINE)]
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", [*PAGES, *FRONT_PAGES], ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)]+)\)", page.read_text(encoding="utf-8")):
        if target.startswith("https://"):
            continue
        path, _, anchor = target.partition("#")
        file = page.parent / path if path else page
        assert file.exists(), (page.name, target)
        assert not anchor or anchor in _anchors(file), (page.name, target, sorted(_anchors(file)))


def test_sources_that_are_named_are_there():
    for page in PAGES:
        for name in re.findall(r"`(?:\w+/)?(\w+\.py)`", page.read_text(encoding="utf-8")):
            assert list(ROOT.glob(f"*/rnd_*/**/{name}")), (page.name, name)


def test_the_example_without_our_code_poses_as_we_do(tmp_path, monkeypatch):
    page = blocks(ROOT / "docs/avatar-onnx.md")
    body = next(block.body for block in page if block.body.startswith("# file: pose.py"))
    assert len(body.splitlines()) <= 60 and "rnd_" not in body.replace('"rnd_avatar"', "")
    (tmp_path / "pose.py").write_text(body, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["pose.py", str(ASSETS / "avatar.onnx")])
    theirs = runpy.run_path("pose.py")
    avatar = Avatar.load(ASSETS / "avatar.onnx", threads=1)
    angles = np.zeros((1, len(avatar.skeleton), 3))
    angles[0, avatar.skeleton.names.index("left_shoulder"), 2] = -1.2
    angles[0, avatar.skeleton.names.index("right_shoulder"), 2] = 1.2
    still = Motion(axis_angle_to_matrix(angles), np.zeros((1, 3)), 30.0, avatar.skeleton.names)
    ours = avatar.pose(still, 0.0)
    np.testing.assert_allclose(theirs["means"], ours.means, atol=FLOAT32_STEPS)
    picture = np.frombuffer((tmp_path / "pose.ppm").read_bytes()[len(b"P6 400 400 255\n") :], np.uint8)
    covered = picture.reshape(400, 400, 3).any(axis=2)
    assert 0.08 < covered.mean() < 0.5
