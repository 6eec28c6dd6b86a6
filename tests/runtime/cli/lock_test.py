"""One writer a folder."""

import subprocess
import sys

import pytest

from rnd_runtime.cli.lock import LOCK_FILE, file_lock, folder_lock
from rnd_runtime.core.errors import InputError

HOLD = """
import sys
from rnd_runtime.cli.lock import folder_lock
with folder_lock(sys.argv[1], "rnd-train", shared_by=sys.argv[2] or None):
    print("held", flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def holder(tmp_path):
    """Starts another process that holds ``tmp_path`` until its input ends."""
    running = []

    def start(shared_by=""):
        words = [sys.executable, "-c", HOLD, str(tmp_path), shared_by]
        process = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        running.append(process)
        assert process.stdout.readline() == "held\n"
        return process

    yield start
    for process in running:
        process.kill()
        process.communicate()


def test_the_second_is_told_who_holds_the_folder(tmp_path, holder):
    process = holder()
    with pytest.raises(InputError, match=rf"rnd-train \(process {process.pid} on .*--out"), folder_lock(tmp_path, "x"):
        pytest.fail("held twice")


def test_a_holder_that_is_killed_lets_go(tmp_path, holder):
    process = holder()
    process.kill()
    process.wait()
    with folder_lock(tmp_path, "x"):
        pass
    assert not (tmp_path / LOCK_FILE).exists()


def test_parts_of_one_work_share_it_and_others_do_not(tmp_path, holder):
    holder("clip")
    with folder_lock(tmp_path, "rnd-play", shared_by="clip"):
        pass
    for other in ("another clip", None):
        with pytest.raises(InputError), folder_lock(tmp_path, "rnd-play", shared_by=other):
            pytest.fail("held by two works")


def test_it_is_free_again_afterwards(tmp_path):
    for _ in range(2):
        with folder_lock(tmp_path, "x"), pytest.raises(InputError), folder_lock(tmp_path, "y"):
            pytest.fail("held twice")
    assert not (tmp_path / LOCK_FILE).exists()


def test_a_file_is_locked_by_its_name_and_rid_of_what_killed_writers_left(tmp_path):
    left, others = tmp_path / ".a.0123abcd.onnx", [tmp_path / ".b.0123abcd.onnx", tmp_path / "a.onnx"]
    for file in (left, *others):
        file.touch()
    with file_lock(tmp_path / "a.onnx", "rnd-export"), file_lock(tmp_path / "b_long.onnx", "rnd-export"):
        assert not left.exists()
        with pytest.raises(InputError, match=r"a\.onnx: file is being written to: got rnd-export \(process"):
            file_lock(tmp_path / "a.onnx", "rnd-export").__enter__()
    assert sorted(tmp_path.iterdir()) == sorted(others)


def test_parts_that_start_at_once_all_share(tmp_path):
    code = """
import sys, time
from rnd_runtime.cli.lock import folder_lock
print("ready", flush=True)
sys.stdin.readline()
with folder_lock(sys.argv[1], "rnd-play", shared_by="clip"):
    time.sleep(0.2)
"""
    words = [sys.executable, "-c", code, str(tmp_path)]
    parts = [subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) for _ in range(4)]
    assert [part.stdout.readline() for part in parts] == ["ready\n"] * 4
    for part in parts:
        part.stdin.write("go\n")
        part.stdin.flush()
    for part in parts:
        part.communicate(timeout=30)
    assert [part.returncode for part in parts] == [0] * 4
    assert not list(tmp_path.iterdir())
