"""Rows R4 and R12: broken avatars and checkpoints; machines without a display."""

from __future__ import annotations

import io
import pickle  # noqa: TID251 (writes a payload that must never be run)
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, external_data_helper
from safetensors import safe_open
from safetensors.torch import save_file

from rnd_bench.scenes.subject import Subject
from rnd_bench.stability.figures import Result, at_most, holds, refusal, result
from rnd_bench.stability.processes import export, play, run_commands
from rnd_runtime.avatar.avatar import Avatar
from rnd_runtime.avatar.file import METADATA_KEY
from rnd_runtime.gl import context as gl_context
from rnd_runtime.playback.rasterizer import make_rasterizer
from rnd_trainer.model.checkpoint import load_checkpoint

CUTS = (0.1, 0.5, 0.99)  # of a file's length
_READERS: dict[str, Callable[[Path], object]] = {".onnx": Avatar.load, ".ckpt": load_checkpoint}


class _Payload:
    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> tuple[Callable[..., object], tuple[object, ...]]:
        return Path.touch, (self.mark,)


def broken_files(subject: Subject) -> Result:
    """R4: truncated, flipped bits, an older schema, external data, foreign operators, a renamed pickle."""
    folder = subject.work / "broken"
    folder.mkdir(parents=True, exist_ok=True)
    mark = folder / "executed"
    mark.unlink(missing_ok=True)
    files = [*_avatars(subject, folder, mark), *_checkpoints(subject, folder, mark)]
    wrong = []
    for file in files:
        wrong += refusal(file.name, _READERS[file.suffix], file, words=(file.name,))
    flips = _flipped_bytes(subject, folder)
    out = folder / "out"
    runs = [play(f, subject.still_file, out) if f.suffix == ".onnx" else export(f, out) for f in files]
    for file, done in zip(files, run_commands(folder, runs)):
        if not done.refused:
            wrong.append(f"{file.name}: {done}")
    return result(
        holds("broken files not refused in one line with exit 2", wrong),
        holds("flipped bytes that crash a reader", flips),
        at_most("payloads executed", float(mark.exists()), 0),
    )


def _avatars(subject: Subject, folder: Path, mark: Path) -> list[Path]:
    data = subject.avatar_file.read_bytes()
    files = {f"cut_{round(100 * cut)}.onnx": data[: int(cut * len(data))] for cut in CUTS}
    older = onnx.load_from_string(data)
    for entry in older.metadata_props:
        if entry.key == METADATA_KEY:
            entry.value = entry.value.replace("rnd-avatar/1", "rnd-avatar/0")
    files["older.onnx"] = older.SerializeToString()
    bare = onnx.load_from_string(data)
    del bare.metadata_props[:]
    files["no_metadata.onnx"] = bare.SerializeToString()
    foreign = onnx.load_from_string(data)
    foreign.opset_import.append(onnx.helper.make_opsetid("com.evil", 1))
    foreign.graph.node[0].domain = "com.evil"
    files["foreign_operator.onnx"] = foreign.SerializeToString()
    outside = onnx.load_from_string(data)
    tensor = max(outside.graph.initializer, key=lambda t: len(t.raw_data))
    external_data_helper.set_external_data(tensor, "../../../../etc/passwd")
    tensor.ClearField("raw_data")
    tensor.data_location = TensorProto.EXTERNAL
    files["external_data.onnx"] = outside.SerializeToString()
    files["pickle.onnx"] = pickle.dumps(_Payload(mark))
    return _written(folder, files)


def _checkpoints(subject: Subject, folder: Path, mark: Path) -> list[Path]:
    data = subject.checkpoint.read_bytes()
    files = {f"cut_{round(100 * cut)}.ckpt": data[: int(cut * len(data))] for cut in CUTS}
    files["pickle.ckpt"] = pickle.dumps(_Payload(mark))
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w") as torch_like:  # what torch.save writes
        torch_like.writestr("archive/data.pkl", pickle.dumps(_Payload(mark)))
    files["torch_save.ckpt"] = archive.getvalue()
    written = _written(folder, files)
    with safe_open(subject.checkpoint, framework="pt") as source:
        tensors = {name: source.get_tensor(name) for name in source.keys()}  # noqa: SIM118
        header = {key: text.replace("rnd-checkpoint/1", "rnd-checkpoint/0") for key, text in source.metadata().items()}
    older = folder / "older.ckpt"
    save_file(tensors, older, metadata=header)
    return [*written, older]


def _written(folder: Path, files: dict[str, bytes]) -> list[Path]:
    for name, data in files.items():
        (folder / name).write_bytes(data)
    return [folder / name for name in files]


def _flipped_bytes(subject: Subject, folder: Path) -> list[str]:
    """Faults of readers on single flipped bits: anything but a refusal or a valid file."""
    rng, faults = np.random.default_rng(9), list[str]()
    for source in (subject.avatar_file, subject.checkpoint):
        data = source.read_bytes()
        ends = min(20_000, len(data))  # structure is dense at the head and, for ONNX, at the tail
        count = subject.few(6, 60)
        offsets = [*rng.integers(0, ends, count), *(len(data) - 1 - rng.integers(0, ends, count))]
        for offset in offsets:
            flipped = bytearray(data)
            flipped[offset] ^= 1 << int(rng.integers(8))
            file = folder / f"flipped{source.suffix}"
            file.write_bytes(flipped)
            faults += refusal(f"{source.suffix} byte {offset}", _READERS[source.suffix], file)
    return [fault for fault in faults if not fault.endswith(": accepted")]


def no_display(subject: Subject) -> Result:
    """R12: without display, EGL and OSMesa errors name the package to install, and the CPU kernel renders."""
    wrong = []
    loaders = dict(gl_context._LOADERS)
    try:
        for name in loaders:
            gl_context._LOADERS[name] = _broken
        for backend, hint in gl_context.INSTALL.items():
            wrong += refusal(backend, gl_context.create_context, backend, words=(hint,))
        with make_rasterizer("auto") as raster:
            if raster.name != "cpu":
                wrong.append(f"auto took {raster.name}")
        wrong += refusal("gl", make_rasterizer, "gl", words=("apt-get install",))
    finally:
        gl_context._LOADERS.update(loaders)
    command = play(subject.avatar_file, subject.still_file, subject.work / "out_dark", "--size", 24)
    done = run_commands(subject.work, [command], DISPLAY="", WAYLAND_DISPLAY="")[0]
    if done.code != 0:
        wrong.append(f"rnd-play: {done}")
    return result(holds("faults without a display", wrong))


def _broken(version: int) -> gl_context.Loader:
    raise OSError("not there")
