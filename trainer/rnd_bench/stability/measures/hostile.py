"""Rows H1, H4, H6 and H9 to H11: what a hostile or unlucky file costs, and how it is refused."""

from __future__ import annotations

import bz2
import io
import json
import os
import pickle  # noqa: TID251  # writes what must be refused
import stat
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import OpenImageIO as oiio
from onnx import TensorProto, helper, numpy_helper

from rnd_bench.scenes.lights import sun_and_sky
from rnd_bench.scenes.subject import Subject
from rnd_bench.stability.figures import Result, at_most, below, holds, refusal, result
from rnd_bench.stability.fuzzing.honest import COMPLETE, write_files
from rnd_bench.stability.fuzzing.run import figures_of, fuzz
from rnd_bench.stability.processes import environment
from rnd_runtime.avatar.avatar import Avatar
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import write_json
from rnd_runtime.motion.motion import load_motion
from rnd_runtime.shading.files.load import load_light, repair
from rnd_runtime.shading.light import texel_solid_angles
from rnd_trainer.importing.pose_files import read_poses

MEMORY_MB, SECONDS = 1024, 30
HUGE = 2**63
_COST = """
import json, sys, time
from pathlib import Path
from rnd_bench.stability.fuzzing.readers import READERS
from rnd_runtime.core.errors import InputError
def status(name): return int(Path("/proc/self/status").read_text().split(name + ":")[1].split()[0]) / 1024
for kind, path in json.loads(sys.argv[1]):
    read = READERS[kind].prepare(Path(sys.argv[2]))
    Path("/proc/self/clear_refs").write_text("5")
    before, start = status("VmRSS"), time.process_time()
    try:
        read(Path(path)); said = None
    except InputError as error:
        said = str(error)
    print(json.dumps([said, status("VmHWM") - before, time.process_time() - start]), flush=True)
"""
"""reads files in one process; prints each one's refusal, MB and seconds of the processor"""


def valid_files(subject: Subject) -> Path:
    """A folder of small valid files of every kind."""
    folder = subject.work / "fuzz/files"
    if not (folder / COMPLETE).exists():
        write_files(folder, subject.avatar_file, subject.checkpoint, subject.capture.folder)
    return folder


def calibration_text(subject: Subject) -> Result:
    """H1: damaged calibration files of OpenCV, in a process that may die."""
    record = fuzz(valid_files(subject), subject.few(40, 5000), ("calibration",))
    died = len(record["calibration"]["died"])
    return result(at_most("processes that damaged calibrations end", died, 0), *figures_of(record))


def bombs(subject: Subject) -> Result:
    """H4: small files that would fill the memory or never end are refused in one line."""
    folder = subject.work / "bombs"
    folder.mkdir(parents=True, exist_ok=True)
    files = [("pickle", _written(folder / f"{name}.pkl", make())) for name, make in _PICKLES.items()]
    files.append(("motion", _written(folder / "zeros.npz", _wide_archive())))
    words = [json.dumps([(kind, str(path)) for kind, path in files]), str(valid_files(subject))]
    done = subprocess.run(
        [sys.executable, "-c", _COST, *words], env=environment(), capture_output=True, text=True, check=False
    )
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    wrong = [f"{path.name}: died" for _, path in files[len(rows) :]]
    wrong += [f"{path.name}: read" for (_, path), (said, _, _) in zip(files, rows) if said is None]
    wrong += [
        f"{path.name}: more than one line" for (_, path), (said, _, _) in zip(files, rows) if said and "\n" in said
    ]
    return result(
        holds(f"{len(files)} bombs not refused in one line", wrong),
        at_most("largest memory of a bomb", max(mb for _, mb, _ in rows), MEMORY_MB, "MB"),
        at_most("longest time of a bomb", max(seconds for _, _, seconds in rows), SECONDS, "s of processor time"),
    )


def _doubling() -> bytes:
    value: tuple[object, ...] = (1,)
    for _ in range(40):
        value = (value, value)
    return pickle.dumps(value, 2)


_PICKLES: dict[str, Callable[[], bytes]] = {
    "bz2": lambda: bz2.compress(bytes(300 << 20)),
    "doubling": _doubling,
    "one_hash": lambda: pickle.dumps({(2**61 - 1) * k: 0 for k in range(1, 300)}, 2),
    "long_2_gb": lambda: b"\x80\x02\x8b\xff\xff\xff\x7f.",
    "bytes_2_62": lambda: b"\x80\x04\x8e" + (2**62).to_bytes(8, "little") + b".",
}


def _written(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


def _wide_archive() -> bytes:
    """An .npz of zeros: 0.5 GB in 0.5 MB."""
    header, whole = io.BytesIO(), io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (1 << 26,)})
    with zipfile.ZipFile(whole, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("poses.npy", "w") as member:
        member.write(header.getvalue())
        for _ in range(8):
            member.write(bytes(64 << 20))
    return whole.getvalue()


def foreign_graphs(subject: Subject) -> Result:
    """H6: avatars with subgraphs, data in other files, or constants larger than the file."""
    folder, data = subject.work / "graphs", subject.avatar_file.read_bytes()
    folder.mkdir(parents=True, exist_ok=True)
    wrong: list[str] = []
    body = helper.make_graph(
        [helper.make_node("Identity", ["go_on"], ["again"]), helper.make_node("Identity", ["x"], ["y"])],
        "body",
        [
            helper.make_tensor_value_info("i", TensorProto.INT64, []),
            helper.make_tensor_value_info("go_on", TensorProto.BOOL, []),
            helper.make_tensor_value_info("x", TensorProto.FLOAT, None),
        ],
        [
            helper.make_tensor_value_info("again", TensorProto.BOOL, []),
            helper.make_tensor_value_info("y", TensorProto.FLOAT, None),
        ],
    )
    outside = numpy_helper.from_array(np.zeros(4, np.float32), "t")
    onnx.external_data_helper.set_external_data(outside, "/etc/passwd")
    outside.ClearField("raw_data")
    outside.data_location = TensorProto.EXTERNAL
    nodes = {
        "loop": helper.make_node("Loop", ["n", "", "v"], ["w"], body=body),
        "if": helper.make_node("If", ["c"], ["w"], then_branch=body, else_branch=body),
        "constant": helper.make_node("Constant", [], ["w"], value=outside),
        "fill": helper.make_node("ConstantOfShape", ["n"], ["w"]),
    }
    for name, node in nodes.items():
        model = onnx.load_from_string(data)
        model.graph.initializer.append(numpy_helper.from_array(np.array([2**62], np.int64), "n"))
        model.graph.node.insert(0, node)
        file = _written(folder / f"{name}.onnx", model.SerializeToString())
        wrong += refusal(file.name, Avatar.load, file, words=(file.name,))
    return result(holds("foreign graphs not refused by name", wrong))


def cut_sun(subject: Subject) -> Result:
    """H9: the energy of a HALF map whose sun is infinite, against that of 65 504."""
    height, file = 64, subject.work / "cut.exr"
    whole = sun_and_sky(height).radiance.copy()
    sun = whole.max(-1) > 100
    whole[sun] = 65504
    cut = np.where(sun[..., None], np.inf, whole).astype(np.float32)
    target = oiio.ImageOutput.create(str(file))
    assert target is not None
    target.open(str(file), oiio.ImageSpec(2 * height, height, 3, "half"))
    target.write_image(cut)
    target.close()
    weights = texel_solid_angles(height, 2 * height)[..., None]
    light, energy = load_light(file), float((whole * weights).sum())
    filled = float((repair(cut)[0] * weights).sum())
    lost = 1 - float((light.radiance * weights).sum()) / energy
    noted = [] if any("a sun was cut" in note for note in light.notes) else ["no note"]
    baseline = ("filled from the neighbours", 100 * (1 - filled / energy))
    return result(
        below("energy lost of a cut sun", 100 * abs(lost), 1, "%", baseline=baseline), holds("its note", noted)
    )


def odd_motions(subject: Subject) -> Result:
    """H10: millimetres are noted; times and frame numbers that do not increase are refused."""
    skeleton, file = subject.avatar.skeleton, subject.work / "odd.npz"
    poses, count = np.zeros((6, 72)), 6
    members: dict[str, Any] = {"poses": poses, "trans": np.zeros((count, 3)), "mocap_framerate": 30.0}
    wrong = []
    np.savez(file, **{**members, "trans": np.outer(np.arange(count), [188 / 30, 0, 0])})
    if not any("millimetres" in note for note in load_motion(file, skeleton).notes):
        wrong.append("millimetres: not noted")
    for name, values in {
        "duplicate": [0, 1, 2, 2, 3, 4],
        "reversed": [5, 4, 3, 2, 1, 0],
        "shuffled": [0, 2, 1, 3, 5, 4],
    }.items():
        for member in ("times", "frame_ids"):
            np.savez(file, **{**members, member: np.array(values)})
            wrong += refusal(f"{name} {member}", load_motion, file, skeleton, words=(member, "frame"))
    return result(holds("odd motions not noted or refused", wrong))


def small_print(subject: Subject) -> Result:
    """H11: numbers beyond 64 bits, names for a terminal, leftovers, modes and checksums."""
    folder, wrong = subject.work / "small_print", list[str]()
    fit = {"id": HUGE, "Rh": [[0.1, 0, 0]], "Th": [[0, 1, 2]], "poses": [[0.0] * 72], "shapes": [[0.0] * 10]}
    for name, numbers in {"ids": range(3), "names": range(HUGE, HUGE + 3)}.items():
        (folder / name).mkdir(parents=True, exist_ok=True)
        for number in numbers:
            (folder / name / f"{number:06d}.json").write_text(json.dumps([fit]), encoding="utf-8")
        wrong += [fault for fault in refusal(name, read_poses, folder / name) if not fault.endswith(": accepted")]
    line = str(InputError("motion", file=folder / ("\x1b[2J\n" + "x" * 5_000_000)))
    if not line.isprintable() or len(line) > 1000:
        wrong.append("a name reaches the terminal")
    before = os.umask(0o027)
    try:
        write_json(folder / "mode.json", [])
    finally:
        os.umask(before)
    if stat.S_IMODE((folder / "mode.json").stat().st_mode) != 0o640:
        wrong.append("the umask is not respected")
    return result(holds("numbers, names and modes", wrong))
