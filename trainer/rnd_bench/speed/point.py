"""One point of the speed–accuracy chart: its setting, files and row."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from rnd_bench.scenes.avatars import Encoders, checkpoint_model, content_key, exported, seeded_checkpoint, sources
from rnd_bench.scenes.scenes import USUAL, BenchScene, bench_scene
from rnd_runtime import __version__
from rnd_runtime.avatar.file import advice_of, metadata_of
from rnd_runtime.core.errors import InputError, check_option
from rnd_runtime.core.files import existing_file, output_folder, sha256_of
from rnd_runtime.playback.doctor import machine

from .frame import Point, measure
from .reference import Reference, errors, reference

FULL_N = 30_000
Row = dict[str, Any]


@dataclass(frozen=True)
class Setting:
    n: int = FULL_N
    size: int = 512
    shade: str = "table+sun"
    encoder: str = "full"
    window: int | None = None
    precision: str = "f32"
    raster: str = "cpu"
    threads: int = 2
    cull: float | None = None
    scene: str = USUAL


@dataclass(frozen=True)
class Inputs:
    """Files that the points share; a checkpoint replaces the seeded avatar of the same number of Gaussians."""

    body: Path
    motion: Path
    hdr: Path
    work: Path
    checkpoints: tuple[Path, ...] = ()

    def checked(self) -> Inputs:
        """Refuse missing files, and two checkpoints for one N."""
        for what, file in (("body", self.body), ("motion", self.motion), ("light", self.hdr)):
            existing_file(file, what=what)
        by_size: dict[int, Path] = {}
        for file in self.checkpoints:
            n = checkpoint_model(existing_file(file, what="checkpoint"))["gaussians"]
            check_option(n not in by_size, "--checkpoint", f"one avatar of {n} Gaussians", f"{by_size.get(n)}, {file}")
            by_size[n] = file
        output_folder(self.work)
        return self

    def key(self) -> str:
        """Digest of these files and of the code."""
        code = (*sources("rnd_runtime"), *sources("rnd_export"))
        return content_key(self.body, self.motion, self.hdr, *(self.checkpoints or ("none",)), *code)

    def scene(self, name: str) -> BenchScene:
        key = content_key(self.body, self.motion, *sources("rnd_trainer"))
        return bench_scene(name, self.body, self.motion, self.hdr, self.work, key)

    def source(self, n: int) -> tuple[Path, str]:
        """The checkpoint of ``n`` Gaussians, and "trained" or "seeded"."""
        for file in self.checkpoints:
            if checkpoint_model(file)["gaussians"] == n:
                return file, "trained"
        return seeded_checkpoint(n, self.body, self.work), "seeded"

    def own(self, file: Path, setting: Setting) -> tuple[Setting, Path]:
        """``setting`` with the metadata of the avatar.onnx ``file``, and the full avatar of its checkpoint."""
        about = metadata_of(existing_file(file, what="avatar"))
        for checkpoint in self.checkpoints:
            if sha256_of(checkpoint) == about.checkpoint_sha256:
                variant, poses = about.variant, about.window_poses
                changed = replace(
                    setting,
                    n=about.gaussians,
                    encoder=variant.encoder,
                    precision=variant.precision,
                    window=None if poses == checkpoint_model(checkpoint)["window_poses"] else poses,
                    cull=advice_of(file).cull if setting.cull is None else setting.cull,
                )
                return changed, exported(checkpoint, Encoders(), self.work)
        raise InputError("--checkpoint", expected=f"the one that {file} was exported from", got="others or none")


def measured(
    setting: Setting,
    inputs: Inputs,
    *,
    seconds: float = 4.0,
    compare: bool = True,
    with_suns: bool = True,
    full_n: int | None = None,
    file: Path | None = None,
) -> Row:
    """One row: the setting, times and sizes, and the errors against the full avatar's reference.

    Args:
        seconds: time to spend on frames.
        compare: measure errors too.
        full_n: add ``psnr_full_db``, against the same kind of avatar with ``full_n`` Gaussians.
        with_suns: add ``psnr_suns_db`` to ``table+sun``: against the reference with the same shadows of suns.
        file: an avatar.onnx exported from one of the checkpoints, instead of the setting's.
    """
    if file is None:
        checkpoint, which = inputs.source(setting.n)
        file = exported(checkpoint, Encoders(setting.encoder, setting.precision, setting.window), inputs.work)
        full = exported(checkpoint, Encoders(), inputs.work) if compare else file
    else:
        setting, full, which = *inputs.own(file, setting), "exported"
    scene = inputs.scene(setting.scene)
    point = Point(
        str(file),
        str(scene.motion),
        str(scene.hdr),
        setting.size,
        setting.shade,
        setting.raster,
        setting.threads,
        seconds=seconds,
        cull=setting.cull,
        view=scene.view,
    )
    truths: dict[str, Reference] = {}
    with ThreadPoolExecutor(1) as other:
        # fills numba's cache meanwhile: a cold start is timed with compiled kernels
        compiled = other.submit(measure, replace(point, frames=1))
        if compare:
            truths[""] = reference(full, scene, setting.size, inputs.work)
            if setting.shade == "table+sun" and with_suns:
                truths["suns"] = reference(full, scene, setting.size, inputs.work, with_suns=True)
            if which != "exported":
                largest, kind = inputs.source(full_n or setting.n)
                if kind == which:
                    whole = exported(largest, Encoders(), inputs.work)
                    truths["full"] = reference(whole, scene, setting.size, inputs.work)
        compiled.result()
    result = measure(point)
    row: Row = {**asdict(setting), "avatar": which, **result.row, "machine": machine(), "version": __version__}
    if compare:
        row |= errors(result, truths[""])
    if "suns" in truths:
        off = errors(result, truths["suns"])
        row |= {f"psnr_suns_db{part}": off[f"psnr_db{part}"] for part in ("", "_worst")}
    if "full" in truths:
        row["psnr_full_db"], row["full_n"] = errors(result, truths["full"])["psnr_db"], full_n or setting.n
    return row
