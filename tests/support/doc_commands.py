"""The commands that the documentation shows: found, made small where a page says how, and run.

Above a fenced block may be ``<!-- tested with COMMAND OPTIONS; COMMAND OPTIONS -->``: the test adds these options.
Or ``<!-- not run: reason -->``. Commands of ``NOT_OURS`` install, or are the tests themselves.
"""

from __future__ import annotations

import importlib
import os
import re
import runpy
import shlex
import subprocess
import sys
import tomllib
import urllib.request
from dataclasses import dataclass
from pathlib import Path

from support.tiny import ASSETS
from support.view_process import running

ROOT = ASSETS.parent
SCRIPTS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
NOT_OURS = {"pip", "source", "pytest", "ruff", "lint-imports", "mypy", "./scripts/test"}
FENCED = re.compile(
    r"(?:<!-- (?:not run: (?P<reason>.+?)|tested with (?P<added>.+?)) -->\n)?"
    r"```(?P<kind>\w+)\n(?P<body>.*?)```",
    re.DOTALL,
)


@dataclass(frozen=True)
class Block:
    """A fenced block of a page, and its comment."""

    kind: str
    body: str
    reason: str | None
    """why it is not run"""
    added: tuple[tuple[str, ...], ...]
    """words of a command and the options that it gets"""

    def commands(self) -> list[list[str]]:
        """Words of every line but those of ``NOT_OURS``, with what is added for the test."""
        lines = (shlex.split(line, comments=True) for line in self.body.replace("\\\n", " ").splitlines())
        return [self._smaller(words) for words in lines if words and words[0] not in NOT_OURS]

    def _smaller(self, words: list[str]) -> list[str]:
        for added in self.added:
            name = added[: next(k for k, word in enumerate(added) if word.startswith("--"))]
            if tuple(words[: len(name)]) == name:
                return [*words, *added[len(name) :]]
        return words


def blocks(page: Path) -> list[Block]:
    """All of a page, in order."""
    return [
        Block(
            found["kind"],
            found["body"],
            found["reason"],
            tuple(tuple(shlex.split(part)) for part in (found["added"] or "").split(";") if part.strip()),
        )
        for found in FENCED.finditer(page.read_text(encoding="utf-8"))
    ]


def copy_assets(folder: Path) -> None:
    """``folder``/assets and ``folder``/scripts, as links."""
    for name in ("assets", "scripts"):
        (folder / name).symlink_to(ROOT / name)


def run(words: list[str], monkeypatch) -> None:
    """One command of a page, in this process: starting Python for each would take most of the time."""
    if words[0] == "rnd-view":
        with running(*words[1:]) as address, urllib.request.urlopen(address) as answer:
            assert answer.status == 200 and b"RnD-Avatar" in answer.read()
        return
    if words[0].startswith("./scripts/"):
        out = {**os.environ, "OUT": str(Path("out").resolve())}
        subprocess.run([ROOT / words[0], *words[1:]], check=True, env=out, capture_output=True)
        return
    if words[0] == "python":
        monkeypatch.setattr(sys, "argv", words[1:])
        runpy.run_path(str(Path(words[1]).resolve()), run_name="__main__")
        return
    assert exit_code(words, monkeypatch) == 0, words


def exit_code(words: list[str], monkeypatch) -> int:
    """Of a command of ours, in this process."""
    assert words[0] in SCRIPTS, f"{words}: no command of ours; mark the block <!-- not run: reason -->"
    monkeypatch.setattr(sys, "argv", words)
    module, function = SCRIPTS[words[0]].split(":")
    try:
        code = getattr(importlib.import_module(module), function)()
    except SystemExit as leaving:
        code = leaving.code
    return code or 0
