"""What a hostile file may cost: one line and exit code 2, within seconds and a few hundred MB."""

import bz2
import gzip
import io
import lzma
import pickle  # noqa: TID251  # to write what others write
import resource
import subprocess
import sys
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pytest

from rnd_runtime.core.budget import Budget, set_max_expanded
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.images import read_image
from rnd_runtime.core.npz import Npz
from rnd_runtime.motion.readers.unpickle import read_pickle

CASES = Path(__file__).parents[2] / "cases/reliability"
MAX_ADDRESSES = 3 << 30  # bytes of addresses, libraries and threads' stacks among them
MAX_MEMORY_KB = 1 << 20
SECONDS = 30  # of the processor; of a machine that is busy more

READ_PICKLE = "from rnd_runtime.motion.readers.unpickle import read_pickle as read"
READ_LIGHT = "from rnd_runtime.shading.files.load import load_light as read"


def _command(reader: str, path: Path) -> tuple[int, str, int]:
    """Exit code, stderr and KB of memory that a command takes to read ``path``."""
    program = (
        f"import sys\n{reader}\nfrom rnd_runtime.cli.command import run_command\n"
        # VmHWM is of this program alone, ru_maxrss of those before it in its process too
        "def peak(): return int(open('/proc/self/status').read().split('VmHWM:')[1].split()[0])\n"
        "before = peak()\n"
        f"code = run_command('rnd-x', lambda: (read({str(path)!r}), None)[1])\n"
        "print(peak() - before)\nsys.exit(code)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=300, preexec_fn=_limit, check=False
    )
    return done.returncode, done.stderr, int(done.stdout or 0)


def _limit() -> None:
    resource.setrlimit(resource.RLIMIT_AS, (MAX_ADDRESSES, MAX_ADDRESSES))
    resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS))


def _punycode() -> bytes:
    letters = "".join(map(chr, range(0x100, 0xD000))) * 4
    return b"\x80\x02c_codecs\nencode\n" + pickle.dumps((letters, "punycode"), 2)[2:-1] + b"R."


def _endless_text() -> bytes:
    """A call of a list that holds itself twice, thirty times over: its text would have 2^30 words."""
    value: list = [1]
    for _ in range(30):
        value = [value, value]
    return pickle.dumps(value, 2)[:-1] + b")R."


def _hashed_alike() -> bytes:
    """A dictionary whose keys share one hash."""
    return pickle.dumps({(2**61 - 1) * k: 0 for k in range(1, 300)}, 2)


def _nested_keys() -> bytes:
    key: tuple = (1,)
    for _ in range(30):
        key = (key, key)
    return pickle.dumps(key, 2)[:-1].replace(b"\x80\x02", b"\x80\x02}", 1) + b"K\x01s."


MADE = {
    "bz2": lambda: bz2.compress(bytes(260 << 20)),
    "gzip": lambda: gzip.compress(bytes(260 << 20), 1),
    "zlib": lambda: zlib.compress(bytes(260 << 20), 6),
    "lzma": lambda: lzma.compress(bytes(260 << 20), preset=0),
    "punycode": _punycode,
    "text of a call": _endless_text,
    "keys of one hash": _hashed_alike,
    "nested keys": _nested_keys,
    "dictionaries": lambda: gzip.compress(b"\x80\x02(" + b"}" * (8 << 20), 1),
    "long of 2 GB": lambda: b"\x80\x02\x8b\xff\xff\xff\x7f.",
    "bytes of 2^62": lambda: b"\x80\x04\x8e" + (2**62).to_bytes(8, "little") + b".",
}
KEPT = ["bz2bomb.pkl", "bytearray8.pkl", "doubling.pkl", "repeat_tensors.pt", "exp_load_from_bytes.pkl", "terminal.pkl"]


@pytest.mark.parametrize("name", KEPT)
def test_pickles_of_the_collection_are_refused(name):
    _refused(READ_PICKLE, CASES / "pickle" / name)


@pytest.mark.parametrize("name", MADE)
def test_made_pickles_are_refused(tmp_path, name):
    (tmp_path / "a.pkl").write_bytes(MADE[name]())
    _refused(READ_PICKLE, tmp_path / "a.pkl")


def _refused(reader: str, path: Path) -> None:
    code, line, memory = _command(reader, path)
    assert code == 2, line
    assert line.startswith(f"rnd-x: {path}: ") and line.count("\n") == 1
    assert line.rstrip("\n").isprintable() and len(line) < 520
    assert memory < MAX_MEMORY_KB, memory


def test_a_wide_archive_is_refused_before_it_is_read(tmp_path):
    path = tmp_path / "a.npz"
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (1 << 27,)})
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("poses.npy", "w") as member:
        member.write(header.getvalue())
        for _ in range(16):
            member.write(bytes(64 << 20))
    with (
        Npz(path, what="motion") as held,
        pytest.raises(InputError, match=r"a\.npz: poses.* expands too far") as caught,
    ):
        held.numbers("poses")
    assert "--max-expand-mb" in str(caught.value)


@pytest.mark.parametrize(("kind", "shape"), [("<f8", (1 << 40,)), ("<U0", (1 << 40,)), ("|S0", (1 << 60,))])
def test_a_header_of_more_than_the_archive_is_refused(tmp_path, kind, shape):
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": kind, "fortran_order": False, "shape": shape})
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("poses.npy", header.getvalue())
    with Npz(tmp_path / "a.npz", what="motion") as held, pytest.raises(InputError, match="expands too far"):
        held.strings("poses")


def test_an_array_in_place_of_an_archive_is_not_read(tmp_path):
    with (tmp_path / "a.npz").open("wb") as stream:
        header = {"descr": "<f8", "fortran_order": False, "shape": (1 << 40,)}
        np.lib.format.write_array_header_1_0(stream, header)
    with pytest.raises(InputError, match=r"a\.npz: motion cannot be read: expected an \.npz archive, got an array"):
        Npz(tmp_path / "a.npz", what="motion")
    with pytest.raises(InputError, match=r"a\.npz: array expands too far"):
        read_pickle(tmp_path / "a.npz")


def test_an_image_of_more_than_its_budget_is_refused():
    with pytest.raises(InputError, match=r"16k_dwab\.exr: image expands too far"):
        read_image(CASES / "hdr/16k_dwab.exr")


@pytest.mark.slow
def test_a_map_of_16k_costs_less_than_a_gigabyte():
    code, line, memory = _command(READ_LIGHT, CASES / "hdr/16k_dwab.exr")
    assert (code, line) == (0, "")
    assert memory < MAX_MEMORY_KB, memory


def test_the_limit_is_by_size_or_as_an_option_sets_it(tmp_path):
    assert Budget(1).limit == 256 << 20 and Budget(1 << 30).limit == 16 << 30
    path = tmp_path / "a.pkl"
    path.write_bytes(bz2.compress(pickle.dumps(bytes(2 << 20))))
    try:
        set_max_expanded(1)
        with pytest.raises(InputError, match="at most 1 MB in all"):
            read_pickle(path)
        set_max_expanded(4)
        assert len(read_pickle(path)) == 2 << 20
        with pytest.raises(InputError, match="--max-expand-mb: expected at least 1, got 0"):
            set_max_expanded(0)
    finally:
        set_max_expanded(None)


def test_time_is_part_of_the_budget():
    with pytest.raises(InputError, match=r"a\.pkl: pickle: expected to be read within 0 s"):
        Budget(1, file="a.pkl", seconds=0).take(1, "pickle")


def test_memory_that_runs_out_is_no_fault_of_the_file(tmp_path, monkeypatch):
    path = tmp_path / "a.pkl"
    path.write_bytes(pickle.dumps([1, 2]))

    def full(*_: object) -> None:
        raise MemoryError

    monkeypatch.setattr("rnd_runtime.motion.readers.unpickle.understand", full)
    with pytest.raises(MemoryError):
        read_pickle(path)


def test_data_within_its_budget_is_read(tmp_path):
    """Arrays that share their bytes, and keys that repeat, as honest files have them."""
    shared = np.arange(1000.0)
    content = {f"frame {k}": {"pose": shared, "name": "person"} for k in range(200)}
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(content))
    read = read_pickle(tmp_path / "a.pkl")
    assert len(read) == 200 and read["frame 7"]["pose"] is read["frame 8"]["pose"]
