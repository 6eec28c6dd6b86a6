"""The process in which a reader reads broken files, and may die.

``python -m rnd_bench.stability.hostile READER COUNT SEED FOLDER`` reads COUNT inputs and prints one line of JSON.
Address space and processor time per input are limited. An audit hook records executed code and files written outside
FOLDER.
"""

from __future__ import annotations

import json
import os
import resource
import shutil
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st

from rnd_runtime.core.errors import InputError

from .damage import damage, json_damage, npz_damage, safetensors_damage

HANG_S = 5.0  # processor time for one input
SPARE_BYTES = 2 << 30  # address space beyond that of the imports
EVENTS = {"subprocess.Popen", "os.system", "os.exec", "os.posix_spawn", "os.fork", "pickle.find_class"}
"""audit events that no reader may cause"""
READERS = ("capture", "motion", "body", "exr", "hdr", "checkpoint", "avatar")


class Target(NamedTuple):
    """A reader, a valid file, and a function that damages it below its outer layer (None: bytes only)."""

    read: Callable[[Path], object]
    honest: Path
    inner: Callable[[bytes, Any], bytes] | None

    @property
    def broken(self) -> Path:
        return self.honest.with_name(f"broken{self.honest.suffix}")


def target_of(name: str, folder: Path) -> Target:
    """The reader ``name`` of ``folder``'s valid files; only its own imports are loaded."""
    if name == "capture":
        from rnd_runtime.capture.capture import load_capture

        return Target(load_capture, folder / "capture/capture.json", json_damage)
    if name in ("motion", "body"):
        from rnd_runtime.capture.body import Body
        from rnd_runtime.motion.motion import load_motion

        if name == "body":
            return Target(Body.load, folder / "body.npz", npz_damage)
        skeleton = Body.load(folder / "body.npz").skeleton
        return Target(lambda path: load_motion(path, skeleton), folder / "motion.npz", npz_damage)
    if name in ("exr", "hdr"):
        from rnd_runtime.shading.light import load_light

        return Target(load_light, folder / f"light.{name}", None)
    if name == "checkpoint":
        from rnd_trainer.model.checkpoint import load_checkpoint

        return Target(load_checkpoint, folder / "avatar.ckpt", safetensors_damage)
    return Target(_posed_once, folder / "avatar.onnx", None)


def _posed_once(path: Path) -> object:
    """An avatar and its rest pose: some faults of a graph show only in its evaluation."""
    from rnd_runtime.avatar.avatar import Avatar
    from rnd_runtime.motion.motion import Motion

    avatar = Avatar.load(path)
    names = avatar.skeleton.names
    rest = Motion(np.eye(3)[None, None].repeat(len(names), 1), np.zeros((1, 3)), 30.0, names, "the rest pose")
    return avatar, avatar.pose(rest, 0.0)


def prepare(folder: Path, avatar: Path, checkpoint: Path, capture: Path) -> None:
    """Write small valid files of every kind into ``folder``, light.hdr last."""
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


def feed(name: str, count: int, first: int, folder: Path) -> dict[str, Any]:
    """Feed ``count`` inputs of the seed ``first`` to the reader ``name`` in this process; counts and escapes."""
    target = target_of(name, folder)
    honest = target.honest.read_bytes()
    report: dict[str, Any] = {"inputs": 0, "refused": 0, "read": 0, "escaped": {}, "audit": [], "peak_bytes": 0}
    target.read(target.honest)  # fills imports and caches
    start = _status("VmRSS")
    report["honest_bytes"] = start + _used(lambda: target.read(target.honest))
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    limit = pages * resource.getpagesize() + SPARE_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    _watch(folder, report["audit"])

    @seed(first)
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
        target.broken.write_bytes(content)
        signal.setitimer(signal.ITIMER_PROF, HANG_S)  # ends the process

        def read() -> None:
            try:
                target.read(target.broken)
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
    """Peak increase of resident memory during ``work``, bytes."""
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")  # resets the high-water mark
    before = _status("VmRSS")
    work()
    return max(_status("VmHWM") - before, 0)


def _status(name: str) -> int:
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return 1024 * int(next(line for line in lines if line.startswith(f"{name}:")).split()[1])


def _watch(folder: Path, seen: list[str]) -> None:
    """Record forbidden events, and files opened for writing outside ``folder``, in ``seen``."""
    inside = str(folder.resolve())

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        if event in EVENTS:
            seen.append(event)
        elif event == "open" and isinstance(arguments[0], str):
            path, mode, flags = arguments
            writes = "w" in (mode or "")
            if isinstance(flags, int):
                writes = bool(flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT))
            allowed = os.path.realpath(path).startswith(inside) or path.startswith(("/dev/", "/proc/self/"))
            if writes and not allowed:
                seen.append(f"wrote {path}")

    sys.addaudithook(hook)


if __name__ == "__main__":
    reader, amount, first_seed, where = sys.argv[1:]
    sys.stdout.write(json.dumps(feed(reader, int(amount), int(first_seed), Path(where))) + "\n")
