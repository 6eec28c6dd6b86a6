"""Broken files, kills and threads: short runs of what ``rnd-bench stability`` does for hours."""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from rnd_bench.stability.determinism import backends_agree
from rnd_bench.stability.fuzzing import run as module
from rnd_bench.stability.fuzzing.damage import Random, damage
from rnd_bench.stability.fuzzing.honest import write_files
from rnd_bench.stability.fuzzing.readers import READERS
from rnd_bench.stability.fuzzing.run import figures_of, fuzz
from rnd_bench.stability.kill import incomplete_files
from rnd_bench.stability.processes import environment
from rnd_runtime.core.errors import InputError

pytestmark = pytest.mark.slow
INPUTS = 40
ALONE = ("pickle", "exr", "avatar")
"""readers that are tested as the laboratory does, each in a process of its own"""


@pytest.fixture(scope="module")
def honest(subject):
    """One honest file of every kind."""
    folder = subject.work / "fuzz/files"
    write_files(folder, subject.avatar_file, subject.checkpoint, subject.capture.folder)
    return folder


@pytest.mark.parametrize("reader", ALONE)
def test_broken_files_are_refused_or_read_by_a_process_that_may_die(reader, honest):
    record = fuzz(honest, INPUTS, (reader,))
    assert record[reader]["inputs"] == INPUTS and record[reader]["refused"] > 0
    assert [figure for figure in figures_of(record) if not figure.passes] == []


@pytest.mark.parametrize("name", [name for name in READERS if name not in ALONE])
def test_broken_files_are_refused_or_read(name, honest, tmp_path):
    reader = READERS[name]
    valid, own = (honest / reader.file).read_bytes(), tmp_path / "own"
    shutil.copytree(honest, own)
    read, rng, refused = reader.prepare(honest), Random(0), 0
    read(own / reader.file)
    for _ in range(INPUTS):
        (own / reader.file).write_bytes(damage(rng, valid, reader.mutation))
        try:
            read(own / reader.file)
        except InputError as error:
            refused += 1
            assert "\n" not in str(error)
    assert refused > 0


def test_batches_that_were_fed_are_not_fed_again(honest, monkeypatch):
    monkeypatch.setattr(module, "BATCH", 6)
    fed, batch = [], module._batch
    monkeypatch.setattr(module, "_batch", lambda *words: fed.append(words) or batch(*words))
    first = fuzz(honest, 12, ("hdr",))
    again = fuzz(honest, 20, ("hdr",))
    assert [(seed, size) for _, _, seed, size in fed] == [(0, 6), (1, 6), (2, 6), (3, 2)]
    assert first["hdr"]["inputs"] == 12 and again["hdr"]["inputs"] == 20
    assert again["hdr"]["refused"] >= first["hdr"]["refused"]


_WRITER = """
import itertools, sys
from pathlib import Path
import numpy as np
from rnd_runtime.core.images import write_image
from rnd_runtime.core.npz import save_npz
folder, noise = Path(sys.argv[1]), np.random.default_rng(0).integers(0, 255, (200, 200, 3)).astype(np.uint8)
print("ready", flush=True)
for number in itertools.count():
    write_image(folder / f"{number % 3}.png", noise)
    save_npz(folder / "numbers.npz", {"values": np.arange(50_000.0) + number})
"""


def test_a_killed_writer_leaves_complete_files(tmp_path):
    rng = np.random.default_rng(1)
    for _ in range(3):
        process = subprocess.Popen(
            [sys.executable, "-c", _WRITER, str(tmp_path)], env=environment(), stdout=subprocess.PIPE, text=True
        )
        with process:
            assert process.stdout is not None and process.stdout.readline() == "ready\n"
            time.sleep(float(rng.uniform(0.05, 0.3)))
            process.send_signal(signal.SIGKILL)
        assert incomplete_files(tmp_path) == []
        if (tmp_path / "numbers.npz").exists():
            values = np.load(tmp_path / "numbers.npz")["values"]
            assert len(values) == 50_000 and np.all(np.diff(values) == 1)
    assert list(tmp_path.glob("[0-2].png"))


def test_incomplete_files_are_found(tmp_path):
    (tmp_path / "half.json").write_text('{"a": ')
    (tmp_path / "whole.json").write_text("{}")
    assert incomplete_files(tmp_path) == ["half.json: JSONDecodeError"]


def test_both_backends_of_opengl_render_the_same_bits(subject):
    assert backends_agree(subject).passes
