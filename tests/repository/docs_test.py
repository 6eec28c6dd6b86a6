"""The documentation: commands run, options exist, links resolve, tables are those of the files, pages are short.

A fenced ``sh`` block is run line by line (``doc_commands``) in a folder that has ``assets``; blocks of one page share
it, and its ``python`` blocks their names. A ``python`` block that starts with ``# file: NAME`` is written to NAME.
"""

from __future__ import annotations

import re
import runpy
import sys
from pathlib import Path

import numpy as np
import pytest

from rnd_runtime.avatar.avatar import Avatar
from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_runtime.motion.motion import Motion
from support.doc_commands import FENCED, ROOT, SCRIPTS, blocks, copy_assets, exit_code, run
from support.tiny import ASSETS
from trainer.losses.perceptual_test import write_alexnet

DOCS = sorted((ROOT / "docs").rglob("*.md"))
FRONT = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "viewer/web/README.md", "assets/README.md")]
PAGES = [*FRONT, *DOCS]
MAX_LINES = {"README.md": 110, "CHANGELOG.md": 40}
MAX_PAGE_LINES = 250
MAX_README_WORDS, MAX_DOCS_WORDS = 1_000, 15_000
LOOKS_LIKE_A_COMMAND = re.compile(r"^ +(?:rnd-\w+|python|pip|npm|\./scripts/\w+) .*|^ +\./scripts/\w+$", re.MULTILINE)
FLOAT32_STEPS = 1e-5  # m: the example computes its bones in float64, the player in its own order


def _text(page: Path) -> str:
    return page.read_text(encoding="utf-8")


def _name(page: Path) -> str:
    return str(page.relative_to(ROOT))


@pytest.mark.slow
# own-video.md needs a video and poses: tests/trainer/importing/own_video_test.py makes them and runs its commands
@pytest.mark.parametrize("page", [page for page in PAGES if page.stem != "own-video"], ids=_name)
def test_commands_run(page, tmp_path, monkeypatch):
    copy_assets(tmp_path)
    write_alexnet(tmp_path / "alexnet.safetensors")
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {"__name__": "__main__"}
    for block in blocks(page):
        if block.reason is not None:
            continue
        if block.kind == "python" and block.body.startswith("# file: "):
            name = block.body.splitlines()[0].removeprefix("# file: ")
            Path(name).write_text(block.body, encoding="utf-8")
        elif block.kind == "python":
            exec(compile(block.body, _name(page), "exec"), names)
        elif block.kind == "sh":
            for words in block.commands():
                run(words, monkeypatch)


@pytest.mark.parametrize("page", PAGES, ids=_name)
def test_what_is_not_run_names_what_runs_it(page):
    for block in blocks(page):
        if block.kind != "sh" or block.reason is None:
            continue
        named = re.search(r"(?:^|\W)((?:tests|scripts)/[\w./-]*\w|\.ci/run|README\.md)", block.reason)
        assert named and (ROOT / named[1]).is_file(), (page.name, block.reason)
        where = _text(ROOT / named[1])
        for words in block.commands():
            name = next(word for word in words if word not in ("python", "-m")).removeprefix("./")
            assert name in where, (page.name, words, named[1])


@pytest.mark.parametrize("page", PAGES, ids=_name)
def test_every_command_is_in_a_fenced_block(page):
    assert not LOOKS_LIKE_A_COMMAND.findall(FENCED.sub("", _text(page)))


def test_options_exist(capsys, monkeypatch):
    """Every option that a page gives to a command of ours is in that command's help."""
    wanted: dict[str, set[str]] = {}
    for page in PAGES:
        text = _text(page).replace("\\\n", " ").replace("-->", "").replace("; rnd-", " | rnd-")
        for name, rest in re.findall(r"\b(rnd-[a-z]+)((?: +[^\s`|]+)*)", text):
            if name in SCRIPTS:
                command = " ".join([name, *_subcommands(name, rest.split())])
                options = {word.strip("(),.;:") for word in rest.split() if word.startswith("--")}
                wanted.setdefault(command, set()).update(options - {"--help"})
    assert len(wanted) > 5
    monkeypatch.setenv("COLUMNS", "300")
    for command, options in wanted.items():
        if options:
            exit_code([*command.split(), "--help"], monkeypatch)
            shown = capsys.readouterr().out
            missing = sorted(option for option in options if option.split("=")[0] not in shown)
            assert not missing, (command, missing)


def _subcommands(name: str, words: list[str]) -> list[str]:
    depth = {"rnd-convert": 1, "rnd-data": 1, "rnd-bench": 2 if words[:1] == ["study"] else 1}.get(name, 0)
    return [word for word in words[:depth] if re.fullmatch(r"[a-z][a-z-]*", word)]


def test_pages_are_short():
    for page in [ROOT / "CHANGELOG.md", *PAGES]:
        lines = len(_text(page).splitlines())
        assert lines <= MAX_LINES.get(page.name if page.parent == ROOT else "", MAX_PAGE_LINES), (_name(page), lines)
    assert len(_text(ROOT / "README.md").split()) <= MAX_README_WORDS
    assert sum(len(_text(page).split()) for page in DOCS) <= MAX_DOCS_WORDS


def test_tables_are_those_of_the_files():
    script = runpy.run_path(str(ROOT / "scripts/doc_tables.py"))
    assert ROOT / "README.md" in script["PAGES"]
    for page, images in script["PAGES"].items():
        text = _text(page)
        for files in re.findall(r"<!-- (?:table|chart): ([^\s#|]+)", text):
            assert all((ASSETS / "bench" / name).is_file() for name in files.split("+")), (_name(page), files)
        assert script["filled"](text, ASSETS / "bench", images) == text, "run: python scripts/doc_tables.py"


def _anchors(page: Path) -> set[str]:
    """What GitHub calls the headings of ``page``."""
    text = re.sub(r"^```.*?^```", "", _text(page), flags=re.MULTILINE | re.DOTALL)
    headings = [re.sub(r"\]\([^)]*\)", "]", line) for line in re.findall(r"^#+ +(.+?) *$", text, re.MULTILINE)]
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=_name)
def test_links_resolve(page):
    for target in re.findall(r"\]\(([^)]+)\)", _text(page)):
        if target.startswith("https://"):
            continue
        path, _, anchor = target.partition("#")
        file = page.parent / path if path else page
        assert file.exists(), (page.name, target)
        assert not anchor or anchor in _anchors(file), (page.name, target, sorted(_anchors(file)))


@pytest.mark.parametrize("page", PAGES, ids=_name)
def test_sources_that_are_named_exist(page):
    text = _text(page)
    for name in re.findall(r"`(?:\w+/)*(\w+\.py)`", text):
        folders = ("*/rnd_*/**", "assets/make", "scripts")
        assert any(list(ROOT.glob(f"{folder}/{name}")) for folder in folders), (_name(page), name)
    for name in re.findall(r"\btests/[\w/]+\w(?:\.py)?", FENCED.sub(lambda block: block["reason"] or "", text)):
        assert (ROOT / name).exists(), (_name(page), name)


def test_the_example_without_our_code_poses_as_we_do(tmp_path, monkeypatch):
    page = blocks(ROOT / "docs/avatar-onnx.md")
    body = next(block.body for block in page if block.body.startswith("# file: pose.py"))
    assert len(body.splitlines()) <= 60 and "rnd_" not in body.replace('"rnd_avatar"', "")
    (tmp_path / "pose.py").write_text(body, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["pose.py", str(ASSETS / "avatar.onnx")])
    example = runpy.run_path("pose.py")
    avatar = Avatar.load(ASSETS / "avatar.onnx", threads=1)
    angles = np.zeros((1, len(avatar.skeleton), 3))
    angles[0, avatar.skeleton.names.index("left_shoulder"), 2] = -1.2
    angles[0, avatar.skeleton.names.index("right_shoulder"), 2] = 1.2
    still = Motion(axis_angle_to_matrix(angles), np.zeros((1, 3)), 30.0, avatar.skeleton.names)
    np.testing.assert_allclose(example["means"], avatar.pose(still, 0.0).means, atol=FLOAT32_STEPS)
    image = np.frombuffer((tmp_path / "pose.ppm").read_bytes()[len(b"P6 400 400 255\n") :], np.uint8)
    assert 0.08 < image.reshape(400, 400, 3).any(axis=2).mean() < 0.5
