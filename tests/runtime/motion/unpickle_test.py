"""Other programs' pickles: every layout reads as plain data, and nothing in them is ever run."""

import bz2
import collections
import gzip
import io
import pickle  # noqa: TID251  # to write what others write
import sys
import types
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse
import torch
from numpy.testing import assert_array_equal

from rnd_runtime.core.errors import InputError
from rnd_runtime.motion.readers.unpickle import read_pickle

RNG = np.random.default_rng(0)
ARRAYS = {
    "f8": RNG.normal(size=(3, 2)),
    "fortran": np.asfortranarray(RNG.normal(size=(2, 3))).astype(np.float32),
    "strided": np.arange(12, dtype=np.int64)[::3],
    "big endian": np.arange(4, dtype=">i4"),
    "empty": np.zeros((0, 3), np.uint8),
    "text": np.array(["neutral", "féminin"]),
    "bytes": np.array([b"male"]),
}
PLAIN = {"name": "é", "raw": b"\xff\0", "nested": [(1, 2.5), {"a": None, 3: True}], "set": {1}}


def _file(tmp_path: Path, content: bytes, name: str = "a.pkl") -> Path:
    (tmp_path / name).write_bytes(content)
    return tmp_path / name


def _same(read, wanted):
    assert read.keys() == wanted.keys()
    for name, array in wanted.items():
        assert_array_equal(read[name], array, err_msg=name, strict=True)


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_arrays_and_plain_data_of_every_protocol(tmp_path, protocol):
    content = {"arrays": ARRAYS, "plain": PLAIN, "scalar": np.float32(1.5), "ordered": collections.OrderedDict(a=1)}
    read = read_pickle(_file(tmp_path, pickle.dumps(content, protocol)))
    _same(read["arrays"], ARRAYS)
    assert read["plain"] == {**PLAIN, "set": (1,)}
    assert read["scalar"] == np.float32(1.5) and read["ordered"] == {"a": 1}


def test_python_2_strings_and_array_bytes(tmp_path):
    """Protocol 2 of Python 2 stores an array's bytes, and every string, as a byte string."""
    array = np.array([1.0, -2.5])
    body = (
        b"\x80\x02}(U\x04posecnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\nK\x00\x85U\x01btR"
        b"(K\x01K\x02\x85cnumpy\ndtype\n(U\x02f8K\x00K\x01tR(K\x03U\x01<NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb\x89U\x10"
    )
    read = read_pickle(_file(tmp_path, body + array.tobytes() + b"tbu."))
    assert_array_equal(read["pose"], array, strict=True)


@pytest.mark.parametrize("pack", [bytes, zlib.compress, gzip.compress, bz2.compress])
@pytest.mark.parametrize("aligned", [False, True])
def test_joblib_files_plain_and_compressed(tmp_path, monkeypatch, pack, aligned):
    """joblib puts each array's bytes behind a pickled wrapper, since version 1.2 aligned by counted padding."""
    content = {"person": ARRAYS}
    _same(read_pickle(_file(tmp_path, pack(_joblib(content, monkeypatch, aligned))))["person"], ARRAYS)
    alone = np.arange(6.0).reshape(2, 3)
    assert_array_equal(read_pickle(_file(tmp_path, pack(_joblib(alone, monkeypatch, aligned)))), alone)


def _joblib(content: object, monkeypatch, aligned: bool) -> bytes:
    module = types.ModuleType("joblib.numpy_pickle")
    wrapper_class = type("NumpyArrayWrapper", (), {"__module__": module.__name__})
    module.NumpyArrayWrapper = wrapper_class
    monkeypatch.setitem(sys.modules, "joblib", types.ModuleType("joblib"))
    monkeypatch.setitem(sys.modules, module.__name__, module)
    stream = io.BytesIO()

    class Pickler(pickle._Pickler):
        def save(self, value, *rest):
            if not isinstance(value, np.ndarray):
                return super().save(value, *rest)
            wrapper = wrapper_class()
            order = "F" if value.flags.f_contiguous and not value.flags.c_contiguous else "C"
            wrapper.__dict__ = {
                "subclass": np.ndarray,
                "shape": value.shape,
                "order": order,
                "dtype": value.dtype,
                "allow_mmap": True,
                **({"numpy_array_alignment_bytes": 16} if aligned else {}),
            }
            super().save(wrapper)
            self.framer.commit_frame(force=True)
            if aligned:
                padding = 16 - (stream.tell() + 1) % 16
                stream.write(bytes([padding]) + b"\xff" * padding)
            stream.write(value.tobytes(order))
            return None

    Pickler(stream, protocol=4).dump(content)
    return stream.getvalue()


@pytest.mark.parametrize("writer", ["zip", "before 1.6", "pickled"])
def test_torch_files_without_torch(tmp_path, writer):
    base = torch.arange(24, dtype=torch.float32).reshape(4, 6)
    wanted = {
        "whole": base,
        "slice": base[1:3, ::2],
        "transposed": base.T,
        "long": torch.tensor([1, 2]),
        "half": torch.tensor([0.5]).half(),
        "bool": torch.tensor([True, False]),
        "scalar": torch.tensor(3.0),
        "empty": torch.zeros(0, 3),
        "parameter": torch.nn.Parameter(torch.ones(2)),
    }
    content = {"nested": wanted, "size": base.shape}
    if writer == "pickled":
        _file(tmp_path, pickle.dumps(content), "a.pt")
    else:
        torch.save(content, tmp_path / "a.pt", _use_new_zipfile_serialization=writer == "zip")
    read = read_pickle(tmp_path / "a.pt")
    _same(read["nested"], {name: tensor.detach().numpy() for name, tensor in wanted.items()})
    assert read["size"] == (4, 6)


def test_objects_that_numpy_saved(tmp_path):
    content = {"cams": {"K": [np.eye(3)]}, "ims": [{"ims": ["a/0.jpg"]}]}
    np.save(tmp_path / "one.npy", content, allow_pickle=True)
    read = read_pickle(tmp_path / "one.npy")
    assert read["ims"] == content["ims"]
    assert_array_equal(read["cams"]["K"][0], np.eye(3))
    np.save(tmp_path / "many.npy", np.array([[{"a": 1}, None], ["b", 2]], object), allow_pickle=True)
    assert read_pickle(tmp_path / "many.npy") == [[{"a": 1}, None], ["b", 2]]
    np.save(tmp_path / "numbers.npy", np.arange(3))
    assert_array_equal(read_pickle(tmp_path / "numbers.npy"), np.arange(3), strict=True)


def test_body_model_pickles_need_neither_chumpy_nor_scipy(tmp_path, monkeypatch):
    module = types.ModuleType("chumpy.ch")
    module.Ch = type("Ch", (), {"__module__": "chumpy.ch"})
    monkeypatch.setitem(sys.modules, "chumpy", types.ModuleType("chumpy"))
    monkeypatch.setitem(sys.modules, "chumpy.ch", module)
    wrapped = module.Ch()
    wrapped.__dict__ = {"x": np.ones((2, 3)), "_dirty_vars": {"x"}}
    regressor = scipy.sparse.csc_matrix(np.array([[0, 2.0, 0], [1, 0, 3]]))
    read = read_pickle(_file(tmp_path, pickle.dumps({"v_template": wrapped, "J_regressor": regressor}, 2)))
    assert_array_equal(read["v_template"], np.ones((2, 3)))
    assert_array_equal(read["J_regressor"], regressor.toarray())


# Hostile and damaged files


class _Bomb:
    def __init__(self, call, *args):
        self.call = (call, args)

    def __reduce__(self):
        return self.call


BOMB = Path("/tmp/rnd-unpickle-went-off")
ATTACKS = {
    "call": lambda: pickle.dumps(_Bomb(BOMB.touch.__func__, "x")),
    "eval": lambda: pickle.dumps({"poses": _Bomb(eval, f"open({str(BOMB)!r}, 'w')")}),
    "exec, protocol 0": lambda: pickle.dumps(_Bomb(exec, f"open({str(BOMB)!r}, 'w')"), 0),
    "inst": lambda: f"(S'touch {BOMB}'\nios\nsystem\n.".encode(),
    "obj": lambda: f"(cos\nsystem\nS'touch {BOMB}'\no.".encode(),
    "numpy's own loader": lambda: pickle.dumps(_Bomb(np.loadtxt, str(BOMB))),
    "state of a name": lambda: b"cos\nsystem\n}S'a'\nI1\nsb.",
    "persistent id": lambda: b"Pabc\n.",
    "extension": lambda: b"\x82\x01.",
    "object dtype from bytes": lambda: (
        b"\x80\x02cnumpy\nndarray\ncnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\nK\x00\x85C\x01btR"
        b"(K\x01K\x01\x85cnumpy\ndtype\n(U\x02O8K\x00K\x01tRI00\nC\x08\x41\x41\x41\x41\x41\x41\x41\x41tb."
    ),
    "far offset": lambda: _torch_file((5, (1,), (1,))),
    "negative stride": lambda: _torch_file((2, (2,), (-1,))),
    "huge size": lambda: _torch_file((0, (2**40,), (1,))),
    "one number said too often": lambda: _torch_file((0, (50_000, 50_000), (0, 0))),
    "deep nest": lambda: b"(" * 5000 + b"l" * 5000 + b".",
    "nothing": lambda: b"",
    "text": lambda: b"hello",
}


def _torch_file(view) -> bytes:
    class Rebuild:
        def __reduce__(self):
            return torch._utils._rebuild_tensor_v2, (Storage(), *view, False, {})

    class Storage:
        pass

    class Pickler(pickle.Pickler):
        def persistent_id(self, value):
            return ("storage", torch.FloatStorage, "0", "cpu", 4) if isinstance(value, Storage) else None

    pickled, archive = io.BytesIO(), io.BytesIO()
    Pickler(pickled, 2).dump(Rebuild())
    with zipfile.ZipFile(archive, "w") as file:
        file.writestr("a/data.pkl", pickled.getvalue())
        file.writestr("a/data/0", bytes(16))
    return archive.getvalue()


@pytest.mark.parametrize("attack", ATTACKS)
def test_nothing_is_run_and_one_line_says_why(tmp_path, attack):
    BOMB.unlink(missing_ok=True)
    content = ATTACKS[attack]()
    with pytest.raises(InputError) as caught:
        read_pickle(_file(tmp_path, content))
    assert "a.pkl" in str(caught.value) and "\n" not in str(caught.value)
    assert not BOMB.exists()


def test_cut_files_are_refused(tmp_path):
    content = pickle.dumps({"arrays": ARRAYS})
    for size in (1, 20, len(content) // 2, len(content) - 1):
        with pytest.raises(InputError, match=r"a\.pkl"):
            read_pickle(_file(tmp_path, content[:size]))


@pytest.mark.parametrize("held", [np.arange(6.0), np.array([{"a": 1}, None], object)])
def test_cut_and_foreign_npy_files_are_refused(tmp_path, held):
    stream = io.BytesIO()
    np.save(stream, held, allow_pickle=True)
    content = stream.getvalue()
    strange = content.replace(b"'descr'", b"'desc\xff'", 1), content[:6] + b"\x09\x00" + content[8:]
    for damaged in (*(content[:size] for size in range(7, len(content))), *strange):
        with pytest.raises(InputError, match=r"a\.pkl"):
            read_pickle(_file(tmp_path, damaged))


def test_shared_parts_are_read_once_and_count_as_often_as_they_are_referred_to(tmp_path):
    """After thirty doublings a reader that follows every path needs a thousand million steps."""
    value: list = [1]
    for count in range(30):
        value = [value, value]
        if count == 10:
            read = read_pickle(_file(tmp_path, pickle.dumps(value)))
            assert read[0] is read[1]
    with pytest.raises(InputError, match="data that repeats its parts: expected at most 256 MB of copies"):
        read_pickle(_file(tmp_path, pickle.dumps(value)))
