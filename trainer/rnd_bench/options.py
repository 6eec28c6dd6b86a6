"""The options of rnd-bench's commands."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from rnd_bench.scenes.scenes import SceneName


def _two_at_most() -> int:
    from rnd_runtime.core.threads import most_threads

    return min(2, most_threads())


@dataclass(frozen=True)
class Files:
    """What is drawn; the defaults are those of a clone."""

    checkpoint: tuple[Path, ...] = ()
    """trained avatar.ckpt files, each used where N is its own; else a seeded, untrained avatar on the body stands in"""
    body: Path = Path("assets/body.npz")
    """of the seeded avatar"""
    motion: Path = Path("assets/walk.npz")
    """how it moves"""
    hdr: Path = Path("assets/sky.exr")
    """and what lights it"""
    work: Path = Path(".cache/bench")
    """folder in which avatars and references are kept between runs"""


@dataclass(frozen=True)
class Raster:
    """The CPU and GL rasterisers against a plain-torch tile rasteriser, with their errors to the oracle."""

    json: Path | None = None
    """write the rows here"""
    n: int = 30_000
    """Gaussians"""
    size: int = 512
    """picture side in pixels"""
    repeats: int = 40
    """timed calls of each kernel; the slow reference gets a tenth of them"""
    threads: int | None = None
    """of numba and torch; by default one per core"""


@dataclass(frozen=True)
class Frame:
    """One point: a frame from pose to pixels, all stages, with its error against the full reference."""

    json: Path | None = None
    """write the row here, a list of them with --runs"""
    runs: int = 1
    """measure so many times, each in a process of its own: a shared machine is not as fast in every minute"""
    n: int = 30_000
    """Gaussians"""
    size: int = 512
    """picture side in pixels"""
    shade: str = "table"
    """ao, table, table+sun, lights:K or brute. The error is that to the sum over all texels with the avatar's own
    visibility; suns of table+sun cast other shadows, and its error behind the same ones is told besides"""
    encoder: Literal["full", "rates", "coarse", "static"] = "full"
    """as of rnd-export; 'rates': skinning at a quarter of the nodes, offsets at an eighth, the rest in full"""
    precision: Literal["f32", "f16", "int8"] = "f32"
    """as of rnd-export"""
    window: int | None = None
    """poses in the motion window; by default the checkpoint's"""
    raster: Literal["cpu", "gl-egl", "gl-osmesa"] = "cpu"
    """what splats"""
    threads: int = field(default_factory=_two_at_most)
    """of onnxruntime and of the kernels; by default two, where there are two cores"""
    cull: float | None = None
    """leave out Gaussians whose n·v is below this cosine, such as -0.5: the back of the body; by default none, but what
    --avatar says"""
    scene: SceneName = "usual"
    """the walk under the light of --hdr, or what is hardest"""
    compare: bool = True
    """measure the error too: the reference takes half a minute the first time"""
    avatar: Path | None = None
    """a file that rnd-export wrote, of one of --checkpoint, instead of what --n, --encoder, --precision and --window
    describe; its error is that against the whole avatar"""
    files: tyro.conf.OmitArgPrefixes[Files] = field(default_factory=Files)


@dataclass(frozen=True)
class Grid:
    """Every point of the speed–accuracy chart, each in a process of its own; resumes; draws the chart."""

    quick: bool = False
    """the small grid, in two minutes"""
    cross: Annotated[str, tyro.conf.arg(metavar="LIST")] = ""
    """factors to combine with one another instead of one at a time, such as n,size,shade,encoder (300 points, half an
    hour);
    also precision, window, raster, threads, cull: all nine are days"""
    sample: int | None = None
    """so many of the combinations of --cross, or of all nine factors, drawn at random; more of them go on with fewer"""
    json: Path = Path("out/bench/grid.json")
    """rows; those measured on this machine, of the same files and by the same code, are not measured again"""
    fresh: bool = False
    """measure all again, kept avatars and references too: on another machine of the same name"""
    chart: tuple[Path, ...] = (Path("out/bench/grid.svg"), Path("out/bench/grid.png"))
    """the chart, SVG or PNG by suffix"""
    files: tyro.conf.OmitArgPrefixes[Files] = field(default_factory=Files)


@dataclass(frozen=True)
class Peers:
    """The same work done by others, side by side, and how each stage's time grows, with the floor beside it."""

    json: Path | None = None
    """write the rows here"""
    n: int = 30_000
    """Gaussians"""
    size: int = 512
    """picture side in pixels"""
    threads: int = field(default_factory=_two_at_most)
    """of everybody; by default two, where there are two cores"""
    files: tyro.conf.OmitArgPrefixes[Files] = field(default_factory=Files)


@dataclass(frozen=True)
class Shards:
    """One clip by one process, by several threads, and by several processes with a part each."""

    json: Path | None = None
    """write the rows here"""
    avatar: Path = Path("assets/avatar.onnx")
    """what is played"""
    motion: Path = Path("assets/walk.npz")
    """how it moves"""
    hdr: Path = Path("assets/sky.exr")
    """and what lights it"""
    frames: int = 480
    """of the clip at 120 frames a second, from its start"""
    size: int = 512
    """picture side in pixels"""
    cores: int = 2
    """processes, or threads, at most"""


@dataclass(frozen=True)
class Step:
    """Where the time of a training step goes."""

    capture: Annotated[Path, tyro.conf.Positional]
    """folder with capture.json"""
    json: Path | None = None
    """write the rows here"""
    preset: Literal["quick", "standard", "full"] = "standard"
    """as of rnd-train"""
    perceptual_weights: Path | None = None
    """as of rnd-train"""
    repeats: int = 24
    """steps that are timed"""
