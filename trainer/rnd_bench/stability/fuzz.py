"""Hostile files: every reader is fed broken copies of an honest file, in a process that may die.

``python -m rnd_bench.stability.fuzz READER COUNT SEED FOLDER`` reads COUNT inputs and prints one line of JSON. It
runs under an address-space limit; an alarm ends it when an input takes over five seconds of work; an audit hook notes
whatever is executed, and every file opened for writing outside FOLDER. Hypothesis draws the damage.
"""

from __future__ import annotations

import io
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import zipfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rnd_bench.scenes.avatars import content_key, sources
from rnd_bench.scenes.figures import Figure, at_most, holds
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import write_json

from .commands import environment

HANG_S = 5.0
"""of processor time for one input, so that a busy machine is not taken for a hang"""
WAIT_S = 3600.0
"""for a batch: what waits for ever does no work"""
ROOM_BYTES = 2 << 30
"""address space beyond what importing took: a reader that asks for more is refused it"""
BATCH = 2000
"""inputs in one process: what a crash loses"""
MEMORY_FACTOR = 2.0
EVENTS = {"subprocess.Popen", "os.system", "os.exec", "os.posix_spawn", "os.fork", "pickle.find_class"}
"""of Python's audit: what no reader of ours has a reason to do"""
HOSTILE: tuple[Any, ...] = (
    None,
    True,
    -1,
    0,
    1e308,
    float("nan"),
    10**30,
    "",
    "../../outside.txt",
    "/etc/passwd",
    "a\0b",
    "\ud800",
    [],
    {},
    [[[[[[]]]]]],
    "x" * 10_000,
    {"__class__": "os.system"},
)

Reader = Callable[[Path], object]


class Target(NamedTuple):
    """A reader, the honest file it reads, and how to get below its outer layer (None: bytes only)."""

    read: Reader
    honest: Path
    inner: Callable[[bytes, Any], bytes] | None


READERS = ("capture", "motion", "body", "exr", "hdr", "checkpoint", "avatar")


def target_of(name: str, folder: Path) -> Target:
    """The reader ``name`` of ``folder``'s honest files (see ``prepare``). Imports what it needs and no more."""
    if name == "capture":
        from rnd_runtime.capture.capture import load_capture

        return Target(load_capture, folder / "capture/capture.json", _json_damage)
    if name in ("motion", "body"):
        from rnd_runtime.capture.body import Body
        from rnd_runtime.motion.motion import load_motion

        if name == "body":
            return Target(Body.load, folder / "body.npz", _npz_damage)
        skeleton = Body.load(folder / "body.npz").skeleton
        return Target(lambda path: load_motion(path, skeleton), folder / "motion.npz", _npz_damage)
    if name in ("exr", "hdr"):
        from rnd_runtime.shading.light import load_light

        return Target(load_light, folder / f"light.{name}", None)
    if name == "checkpoint":
        from rnd_trainer.model.checkpoint import load_checkpoint

        return Target(load_checkpoint, folder / "avatar.ckpt", _safetensors_damage)
    return Target(_posed_once, folder / "avatar.onnx", None)


def _posed_once(path: Path) -> object:
    """An avatar, and its rest pose: what is wrong with a graph may show only when it is evaluated."""
    from rnd_runtime.avatar.avatar import Avatar
    from rnd_runtime.motion.motion import Motion

    avatar = Avatar.load(path)
    names = avatar.skeleton.names
    rest = Motion(np.eye(3)[None, None].repeat(len(names), 1), np.zeros((1, 3)), 30.0, names, "the rest pose")
    return avatar, avatar.pose(rest, 0.0)


def damage(draw: Any, honest: bytes, inner: Callable[[bytes, Any], bytes] | None) -> bytes:
    """A broken copy, by choices that ``draw`` (hypothesis' data.draw) makes."""
    from hypothesis import strategies as st

    if inner is not None and draw(st.booleans()):
        return inner(honest, draw)
    data = bytearray(honest)
    for _ in range(draw(st.integers(1, 4))):
        kind = draw(st.sampled_from(("flip", "write", "cut", "insert", "repeat")))
        # half of all damage goes to the head, where the structure is
        reach = min(len(data), 256) if draw(st.booleans()) else len(data)
        place = draw(st.integers(0, max(reach - 1, 0)))
        if not data:
            break
        if kind == "flip":
            data[place] ^= 1 << draw(st.integers(0, 7))
        elif kind == "write":
            given = draw(st.sampled_from((b"\xff\xff\xff\x7f", b"\0\0\0\0", b"\xff" * 8, b"\x80" * 10, b"../../x")))
            data[place : place + len(given)] = given
        elif kind == "cut":
            del data[place:]
        elif kind == "insert":
            data[place:place] = draw(st.binary(min_size=1, max_size=12))
        else:
            data[place:place] = data[place : place + 64]
    return bytes(data)


def _json_damage(honest: bytes, draw: Any) -> bytes:
    """JSON with one value replaced by a hostile one, or a key renamed."""
    from hypothesis import strategies as st

    tree = json.loads(honest)
    places = list(_places(tree))
    holder, key = places[draw(st.integers(0, len(places) - 1))]
    if isinstance(holder, dict) and draw(st.integers(0, 4)) == 0:
        holder[draw(st.text(max_size=5))] = holder.pop(key)
    else:
        holder[key] = draw(st.sampled_from(HOSTILE))
    return json.dumps(tree).encode("utf-8", "surrogatepass")


def _places(tree: Any) -> Any:
    """Every (container, key) of a JSON tree."""
    entries = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    for key, value in list(entries):
        yield tree, key
        yield from _places(value)


def _npz_damage(honest: bytes, draw: Any) -> bytes:
    """An archive whose checksums are right and one of whose members is not."""
    from hypothesis import strategies as st

    with zipfile.ZipFile(io.BytesIO(honest)) as source:
        members = {name: source.read(name) for name in source.namelist()}
    name = draw(st.sampled_from(sorted(members)))
    kind = draw(st.sampled_from(("bytes", "shape", "type", "gone", "rename", "random")))
    if kind == "bytes":
        members[name] = damage(draw, members[name], None)
    elif kind == "shape":
        array = np.load(io.BytesIO(members[name]), allow_pickle=False)
        rows = draw(st.integers(-2, 2**62))
        head = f"{{'descr': '{array.dtype.str}', 'fortran_order': False, 'shape': ({rows}, 3), }}"
        members[name] = b"\x93NUMPY\x01\x00" + len(head).to_bytes(2, "little") + head.encode() + b"\0" * 64
    elif kind == "type":
        made = io.BytesIO()
        others = (np.array(["a"]), np.array(1j), np.zeros((0, 3)), np.array(np.nan), np.zeros((2, 2, 2, 2)))
        np.save(made, draw(st.sampled_from(others)))
        members[name] = made.getvalue()
    elif kind == "gone":
        del members[name]
    elif kind == "rename":
        members[draw(st.sampled_from(("../../x.npy", "/etc/x.npy", "betas.npy", "Rh.npy")))] = members.pop(name)
    else:
        array = np.load(io.BytesIO(members[name]), allow_pickle=False)
        if array.dtype.kind in "fiu" and array.size:
            array = array.copy()
            extreme = draw(st.sampled_from((np.nan, np.inf, -1, 1e30, 2**31 - 1)))
            with np.errstate(all="ignore"):
                array.flat[draw(st.integers(0, array.size - 1))] = np.array(extreme).astype(array.dtype)
            made = io.BytesIO()
            np.save(made, array)
            members[name] = made.getvalue()
    result = io.BytesIO()
    with zipfile.ZipFile(result, "w") as target:
        for member, content in members.items():
            target.writestr(member, content)
    return result.getvalue()


def _safetensors_damage(honest: bytes, draw: Any) -> bytes:
    """A safetensors file whose JSON header is broken and whose length is right."""
    size = int.from_bytes(honest[:8], "little")
    head = _json_damage(honest[8 : 8 + size], draw)
    return len(head).to_bytes(8, "little") + head + honest[8 + size :]


def prepare(folder: Path, avatar: Path, checkpoint: Path, capture: Path) -> None:
    """Small honest files of every kind in ``folder``; the capture's pictures are linked, not copied."""
    import OpenImageIO as oiio

    from rnd_runtime.core.images import write_image

    folder.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(avatar, folder / "avatar.onnx")
    shutil.copyfile(checkpoint, folder / "avatar.ckpt")
    shutil.copytree(capture, folder / "capture", dirs_exist_ok=True)
    for name in ("body.npz", "motion.npz"):
        shutil.copyfile(capture / name, folder / name)
    pixels = np.random.default_rng(0).uniform(0, 4, (16, 32, 3)).astype(np.float32)
    write_image(folder / "light.exr", pixels)
    target: Any = oiio.ImageOutput.create(str(folder / "light.hdr"))
    target.open(str(folder / "light.hdr"), oiio.ImageSpec(32, 16, 3, "float"))
    target.write_image(pixels)
    target.close()


def fuzz_here(name: str, count: int, seed: int, folder: Path) -> dict[str, Any]:
    """Feed ``count`` inputs to the reader ``name`` in this process; counts and what escaped."""
    from hypothesis import HealthCheck, Phase, given, settings
    from hypothesis import seed as seeded
    from hypothesis import strategies as st

    target = target_of(name, folder)
    honest = target.honest.read_bytes()
    place = target.honest.with_name(f"broken{target.honest.suffix}")
    report: dict[str, Any] = {"inputs": 0, "refused": 0, "read": 0, "escaped": {}, "audit": [], "peak_bytes": 0}
    target.read(target.honest)  # whatever is loaded late is loaded now
    start = _status("VmRSS")
    report["honest_bytes"] = start + _used(lambda: target.read(target.honest))
    _limit()
    _watch(folder, report["audit"])

    @seeded(seed)
    @settings(
        max_examples=count,
        database=None,
        deadline=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(st.data())
    def run(data: Any) -> None:
        content = damage(data.draw, honest, target.inner)
        place.write_bytes(content)
        signal.setitimer(signal.ITIMER_PROF, HANG_S)  # ends the process, whatever it is stuck in

        def read() -> None:
            try:
                target.read(place)
                report["read"] += 1
            except InputError:
                report["refused"] += 1
            except Exception as error:
                report["escaped"].setdefault(f"{type(error).__name__}: {str(error)[:120]}", content[:200].hex())

        report["peak_bytes"] = max(report["peak_bytes"], start + _used(read))
        signal.setitimer(signal.ITIMER_PROF, 0)
        report["inputs"] += 1

    run()
    return report


def _used(work: Callable[[], object]) -> int:
    """Bytes by which resident memory rose at its highest while ``work`` ran; what the harness holds does not count."""
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")  # the high-water mark starts anew
    before = _status("VmRSS")
    work()
    return max(_status("VmHWM") - before, 0)


def _status(name: str) -> int:
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return 1024 * int(next(line for line in lines if line.startswith(f"{name}:")).split()[1])


def _limit() -> None:
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    limit = pages * resource.getpagesize() + ROOM_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))


def _watch(folder: Path, seen: list[str]) -> None:
    """Note forbidden events, and files opened for writing outside ``folder``."""
    inside = str(folder.resolve())

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        if event in EVENTS:
            seen.append(event)
        elif event == "open" and isinstance(arguments[0], str):
            path, mode, flags = arguments
            writes = (
                bool(flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)) if isinstance(flags, int) else "w" in (mode or "")
            )
            if (
                writes
                and not os.path.realpath(path).startswith(inside)
                and not path.startswith(("/dev/", "/proc/self/"))
            ):
                seen.append(f"wrote {path}")

    sys.addaudithook(hook)


def fuzz(
    folder: Path, count: int, only: tuple[str, ...] = (), on_batch: Callable[[], object] = lambda: None
) -> tuple[list[Figure], dict[str, Any]]:
    """Feed ``count`` inputs to every reader; figures and the record.

    Readers run side by side, as many as there are cores, each on its own copy of ``folder``, and their inputs batch by
    batch, each in a process of its own. What a batch found is kept beside its files: a run that was stopped goes on.
    ``on_batch`` is called after each.
    """
    names = only or READERS
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        totals = list(pool.map(lambda name: _all_batches(_own_copy(folder, name), name, count, on_batch), names))
    figures = []
    for name, total in zip(names, totals):
        faults = [f"{len(total['died'])} processes died"] * bool(total["died"])
        faults += list(total["escaped"]) + total["audit"]
        figures += [
            holds(f"{name}: {total['inputs']} inputs, {total['refused']} refused: crashes, hangs, escapes", faults),
            at_most(f"{name}: peak memory over that of the honest file", total["memory"], MEMORY_FACTOR, "×"),
        ]
    return figures, dict(zip(names, totals))


def batches(count: int) -> int:
    """How many a reader's ``count`` inputs are fed in."""
    return -(-count // BATCH)


def _own_copy(folder: Path, name: str) -> Path:
    own = folder / "readers" / name
    if not own.exists():
        half = own.with_name(f".{name}")
        shutil.rmtree(half, ignore_errors=True)
        shutil.copytree(folder, half, ignore=shutil.ignore_patterns("readers"))
        half.rename(own)
    return own


def _all_batches(folder: Path, name: str, count: int, on_batch: Callable[[], object]) -> dict[str, Any]:
    total: dict[str, Any] = {
        "inputs": 0,
        "refused": 0,
        "read": 0,
        "died": [],
        "escaped": {},
        "audit": [],
        "memory": 0.0,
    }
    readers = _readers_key()
    for seed in range(batches(count)):
        size = min(BATCH, count - seed * BATCH)
        kept = folder / f"batch_{seed}_{size}_{readers}.json"
        if not kept.exists():
            write_json(kept, _batch(folder, name, seed, size))
        batch = json.loads(kept.read_text(encoding="utf-8"))
        on_batch()
        if "died" in batch:
            total["died"].append(batch["died"])
            continue
        for key in ("inputs", "refused", "read"):
            total[key] += batch[key]
        total["escaped"] |= batch["escaped"]
        total["audit"] += batch["audit"]
        total["memory"] = max(total["memory"], batch["peak_bytes"] / batch["honest_bytes"])
    return total


def _readers_key() -> str:
    """Of the code that reads: what another one did says nothing of this one."""
    return content_key(*sources("rnd_runtime"), *sources("rnd_trainer"))


def _batch(folder: Path, name: str, seed: int, size: int) -> dict[str, Any]:
    """What ``fuzz_here`` reports from a process of its own, or how that died."""
    words = [name, str(size), str(seed), str(folder)]
    code, lines, said = _run([sys.executable, "-m", "rnd_bench.stability.fuzz", *words], folder)
    if code != 0 or not lines:
        _keep_killer(folder, name, seed)
        return {"died": {"seed": seed, "code": code, "said": said[-300:]}}
    report: dict[str, Any] = json.loads(lines[-1])
    return report


def _run(command: list[str], folder: Path) -> tuple[int | str, list[str], str]:
    """Exit code, lines of stdout, and stderr of a batch."""
    try:
        child = subprocess.run(
            command, cwd=folder, env=environment(), capture_output=True, text=True, check=False, timeout=WAIT_S
        )
    except subprocess.TimeoutExpired:
        return "waits for ever", [], ""
    return child.returncode, child.stdout.strip().splitlines(), child.stderr.strip()


def _keep_killer(folder: Path, name: str, seed: int) -> None:
    """Keep the input that ended a process."""
    honest = target_of(name, folder).honest
    broken = honest.with_name(f"broken{honest.suffix}")
    if broken.exists():
        (folder / f"killer_{name}_{seed}{honest.suffix}").write_bytes(broken.read_bytes())


if __name__ == "__main__":
    reader, amount, first, where = sys.argv[1:]
    sys.stdout.write(json.dumps(fuzz_here(reader, int(amount), int(first), Path(where))) + "\n")
