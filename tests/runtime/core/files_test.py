"""A final name never holds half a file."""

import json
import os
import signal
import stat
import subprocess
import sys

import pytest

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import (
    atomic_path,
    earlier_rows,
    existing_file,
    output_file,
    output_folder,
    refuse_input,
    write_json,
)


def _names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_a_file_appears_whole_under_its_name(tmp_path):
    with atomic_path(tmp_path / "new" / "a.png") as temporary:
        assert temporary.suffix == ".png" and temporary.name.startswith(".")
        assert temporary.parent == tmp_path / "new"  # the same file system: renaming is atomic
        temporary.write_text("whole")
        assert not (tmp_path / "new" / "a.png").exists()
    assert (tmp_path / "new" / "a.png").read_text() == "whole"
    assert _names(tmp_path / "new") == ["a.png"]


@pytest.mark.parametrize(("umask", "mode"), [(0o022, 0o644), (0o077, 0o600), (0o002, 0o664)])
def test_the_mode_is_the_umasks(tmp_path, umask, mode):
    before = os.umask(umask)
    try:
        write_json(tmp_path / "a.json", [])
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "a.json").stat().st_mode) == mode


def test_the_content_is_on_the_disk_before_it_gets_its_name(tmp_path, monkeypatch):
    synced = []
    sync = os.fsync

    def fsync(handle: int) -> None:
        assert not (tmp_path / "a.json").exists()
        synced.append(os.fstat(handle).st_size)
        sync(handle)

    monkeypatch.setattr(os, "fsync", fsync)
    write_json(tmp_path / "a.json", [])
    assert synced == [3] == [(tmp_path / "a.json").stat().st_size]


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt, InputError])
def test_a_failure_keeps_what_was_there_and_leaves_nothing_else(tmp_path, error):
    (tmp_path / "a.png").write_text("old")

    def fail():
        with atomic_path(tmp_path / "a.png") as temporary:
            temporary.write_text("ha")
            raise error("midway")

    with pytest.raises(error):
        fail()
    assert (tmp_path / "a.png").read_text() == "old"
    assert _names(tmp_path) == ["a.png"]


def test_a_killed_writer_leaves_the_old_file(tmp_path):
    """FAILURES.md R12: kill −9 while writing."""
    (tmp_path / "a.bin").write_text("old")
    code = (
        "import sys, time\nfrom rnd_runtime.core.files import atomic_path\n"
        "with atomic_path(sys.argv[1]) as temporary:\n"
        "    temporary.write_text('half')\n    print('writing', flush=True)\n    time.sleep(60)\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code, str(tmp_path / "a.bin")], stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout.readline() == "writing\n"
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert (tmp_path / "a.bin").read_text() == "old"
    assert all(name.startswith(".") for name in _names(tmp_path) if name != "a.bin")


def test_a_folder_cannot_be_overwritten(tmp_path):
    (tmp_path / "a.png").mkdir()
    with pytest.raises(InputError, match=r"a\.png: cannot be written: it is a folder"), atomic_path(tmp_path / "a.png"):
        pass


def test_output_folder_is_made_with_its_parents(tmp_path):
    assert output_folder(tmp_path / "a" / "b") == tmp_path / "a" / "b"
    assert (tmp_path / "a" / "b").is_dir()
    output_folder(tmp_path / "a" / "b")  # and may be there already


def test_output_folder_without_permission_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "access", lambda *_: False)  # root, who may run this, could write anywhere
    with pytest.raises(InputError, match="output folder cannot be written"):
        output_folder(tmp_path)


def test_an_output_is_looked_at_before_what_takes_long(tmp_path):
    assert output_file(tmp_path / "new" / "a.json") == tmp_path / "new" / "a.json"
    assert not _names(tmp_path / "new")
    with pytest.raises(InputError, match="new: cannot be written: it is a folder"):
        output_file(tmp_path / "new")
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="output folder cannot be made"):
        output_file(tmp_path / "file" / "a.json")


def test_an_input_is_no_output_under_any_name(tmp_path):
    (tmp_path / "a").write_text("")
    (tmp_path / "link").symlink_to("a")
    refuse_input(tmp_path / "b", tmp_path / "a", None, tmp_path / "none")
    for out in (tmp_path / "a", tmp_path / "link", tmp_path / "new" / ".." / "a", tmp_path / "none"):
        with pytest.raises(InputError, match="output: expected another file than what is read, got"):
            refuse_input(out, None, tmp_path / "a", tmp_path / "none")


def test_existing_file(tmp_path):
    (tmp_path / "a.npz").write_text("")
    assert existing_file(tmp_path / "a.npz", what="motion") == tmp_path / "a.npz"
    with pytest.raises(InputError, match=r"b\.npz: motion not found$"):
        existing_file(tmp_path / "b.npz", what="motion")
    with pytest.raises(InputError, match="motion not found: got a folder"):
        existing_file(tmp_path, what="motion")
    with pytest.raises(InputError, match="motion not found: got File name too long") as refused:
        existing_file(tmp_path / ("x" * 10_000), what="motion")
    assert len(str(refused.value)) < 300


def test_a_path_that_is_no_utf_8_stands_in_json(tmp_path):
    content = {"settings": {"motion": "K\udcf6rper.npz"}}
    write_json(tmp_path / "a.json", content)
    assert json.loads((tmp_path / "a.json").read_text("utf-8")) == content


def test_rows_to_add_to_are_what_was_written_or_none_yet(tmp_path):
    path = tmp_path / "rows.json"
    assert earlier_rows(path, what="rows", names=("n",)) == []
    rows = [{"n": 1, "more": [2]}, {"n": 2}]
    write_json(path, rows)
    assert earlier_rows(path, what="rows", names=("n",)) == rows


@pytest.mark.parametrize("content", [b"[{", b"\xff", b'{"n": 1}', b'[{"n": 1}, {"m": 2}]', b"[3]"])
def test_other_files_are_not_added_to(tmp_path, content):
    path = tmp_path / "rows.json"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"rows\.json: file of rows: expected rows of a bench, got another file"):
        earlier_rows(path, what="rows of a bench", names=("n",))
    with pytest.raises(InputError):
        earlier_rows(tmp_path, what="rows of a bench", names=("n",))
