"""One point of the speed–accuracy chart: a setting, the files it is measured with, and its row."""

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
    """One point: everything that is varied."""

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
    """Files that the points share. Of ``checkpoints`` each stands in for the seeded avatar where N is its own."""

    body: Path
    motion: Path
    hdr: Path
    work: Path
    checkpoints: tuple[Path, ...] = ()

    def checked(self) -> Inputs:
        """Refuse missing files, and two checkpoints for one N, before minutes are spent."""
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
        """Digest of these files and of the code that plays them."""
        code = (*sources("rnd_runtime"), *sources("rnd_export"))
        return content_key(self.body, self.motion, self.hdr, *(self.checkpoints or ("none",)), *code)

    def scene(self, name: str) -> BenchScene:
        """The scene ``name`` of ``scenes.scenes``."""
        key = content_key(self.body, self.motion, *sources("rnd_trainer"))
        return bench_scene(name, self.body, self.motion, self.hdr, self.work, key)

    def source(self, n: int) -> tuple[Path, str]:
        """The checkpoint of ``n`` Gaussians, and which it is: trained or seeded."""
        for file in self.checkpoints:
            if checkpoint_model(file)["gaussians"] == n:
                return file, "trained"
        return seeded_checkpoint(n, self.body, self.work), "seeded"

    def own(self, file: Path, setting: Setting) -> tuple[Setting, Path]:
        """``setting`` with the metadata of the avatar.onnx ``file``, and the full avatar of its checkpoint.

        Raises ``InputError`` where no checkpoint here is the file's.
        """
        about = metadata_of(existing_file(file, what="avatar"))
        for checkpoint in self.checkpoints:
            if sha256_of(checkpoint) == about.checkpoint_sha256:
                variant, poses = about.variant, about.window_poses
                cull = advice_of(file).cull if setting.cull is None else setting.cull
                changed = replace(
                    setting,
                    n=about.gaussians,
                    encoder=variant.encoder,
                    precision=variant.precision,
                    window=None if poses == checkpoint_model(checkpoint)["window_poses"] else poses,
                    cull=cull,
                )
                return changed, exported(checkpoint, Encoders(), self.work)
        raise InputError("--checkpoint", expected=f"the one that {file} was exported from", got="others or none")

    def avatar(self, n: int, encoders: Encoders) -> tuple[Path, str]:
        """The file, and which avatar it is."""
        checkpoint, which = self.source(n)
        return exported(checkpoint, encoders, self.work), which


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

    ``psnr_full_db`` compares with frames of the same kind of avatar with ``full_n`` Gaussians: the cost of fewer
    Gaussians. ``with_suns`` adds ``psnr_suns_db`` to ``table+sun``, against the reference whose suns cast the same
    shadows, which takes twice as long. A ``file`` that was exported from one of the checkpoints is measured as it is.
    """
    if file is None:
        file, which = inputs.avatar(setting.n, Encoders(setting.encoder, setting.precision, setting.window))
        full = None
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
        # a cold start is one with the kernels in numba's cache: what it lacks is compiled meanwhile
        compiled = other.submit(measure, replace(point, frames=1))
        if compare:
            full = full or inputs.avatar(setting.n, Encoders())[0]
            truths[""] = reference(full, scene, setting.size, inputs.work)
            if setting.shade == "table+sun" and with_suns:
                truths["suns"] = reference(full, scene, setting.size, inputs.work, with_suns=True)
            if which != "exported":
                largest, kind = inputs.avatar(full_n or setting.n, Encoders())
                if kind == which:
                    truths["full"] = reference(largest, scene, setting.size, inputs.work)
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
