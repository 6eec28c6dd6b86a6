"""The options of the commands that measure speed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from rnd_runtime.cli.command import Count, File, Flag, Folder, OptionalCount, OptionalFile, OptionalNumber, option
from rnd_runtime.cli.command import Files as Paths

SceneName = Literal["usual", "inside the body", "squat", "sun of 1e6"]


@dataclass(frozen=True)
class Files:
    """What is rendered."""

    assets: Annotated[Path, tyro.conf.Positional, option("ASSETS")]
    """folder with body.npz, walk.npz and sky.exr, such as a clone's assets"""
    checkpoint: Paths = ()
    """trained avatar.ckpt files, each used where N is its own; by default a seeded, untrained avatar on the body"""
    work: Folder = Path("out/bench/work")
    """folder in which avatars and references are stored between runs"""


@dataclass(frozen=True)
class Raster:
    """The CPU and GL rasterisers against a plain-torch tile rasteriser, with their errors to the oracle.

    rnd-bench raster --json out/raster.json
    """

    json: OptionalFile = None
    """write the rows here"""
    n: Count = 30_000
    """Gaussians"""
    size: Count = 512
    """image side in pixels"""
    repeats: Count = 40
    """timed calls of each kernel; the slow reference gets a tenth of them"""
    threads: OptionalCount = None
    """of numba and torch; by default one per core"""


@dataclass(frozen=True)
class Frame:
    """One point: a frame from pose to pixels, all stages, with its error against the full reference.

    rnd-bench frame assets --shade table
    """

    files: tyro.conf.OmitArgPrefixes[Files]
    json: OptionalFile = None
    """write the row here, a list of them with --runs"""
    runs: Count = 1
    """measurements, each in a process of its own"""
    n: Count = 30_000
    """Gaussians"""
    size: Count = 512
    """image side in pixels"""
    shade: Annotated[str, option("MODE")] = "table"
    """ao, table, table+sun, lights:K or brute. The error is that to the sum over all texels with the avatar's own
    visibility; that of table+sun's other shadows is reported besides"""
    encoder: Literal["full", "coarse", "static"] = "full"
    """as of rnd-export"""
    precision: Literal["f32", "f16", "int8"] = "f32"
    """as of rnd-export"""
    window: OptionalCount = None
    """poses in the motion window; by default the checkpoint's"""
    raster: Literal["cpu", "gl-egl", "gl-osmesa"] = "cpu"
    """rasteriser"""
    threads: OptionalCount = None
    """of onnxruntime and of the kernels; by default two, where there are two cores"""
    cull: OptionalNumber = None
    """leave out Gaussians whose n·v is below this cosine, such as -0.5; by default none, but what --avatar says"""
    scene: SceneName = "usual"
    """the walk under the sky, or one of the hardest scenes"""
    no_compare: Flag = False
    """times only: the reference takes half a minute the first time"""
    avatar: OptionalFile = None
    """a file that rnd-export wrote of one of --checkpoint, instead of --n, --encoder, --precision and --window"""


@dataclass(frozen=True)
class Grid:
    """Every point of the speed–accuracy chart, each in a process of its own; resumes; draws the chart.

    rnd-bench grid assets --quick
    """

    files: tyro.conf.OmitArgPrefixes[Files]
    quick: Flag = False
    """the small grid, in two minutes"""
    cross: Annotated[str, option("LIST")] = ""
    """factors to combine with one another instead of one at a time, such as n,size,shade,encoder (300 points, half an
    hour); also precision, window, raster, threads, cull"""
    json: File = Path("out/bench/grid.json")
    """rows; those of this machine, of the same files and code, are not measured again"""
    fresh: Flag = False
    """measure all again, stored avatars and references too"""
    chart: Paths = (Path("out/bench/grid.svg"), Path("out/bench/grid.png"))
    """the chart, SVG or PNG by suffix"""


@dataclass(frozen=True)
class Step:
    """Where the time of a training step goes.

    rnd-bench step assets/capture --preset quick
    """

    capture: Annotated[Path, tyro.conf.Positional, option("CAPTURE")]
    """folder with capture.json"""
    json: OptionalFile = None
    """write the rows here"""
    preset: Literal["quick", "standard", "full"] = "standard"
    """as of rnd-train"""
    perceptual_weights: OptionalFile = None
    """as of rnd-train"""
    repeats: Count = 24
    """timed steps"""


@dataclass(frozen=True)
class Scenes:
    """Levels of detail by height in pixels, with error and time, and the time of 1, 10 and 50 people at 1280 x 720.

    rnd-bench scenes --avatar assets/avatar.onnx --motion assets/walk.npz --hdr assets/sky.exr
    """

    avatar: File
    """avatar.onnx of everybody"""
    motion: File
    """everybody's motion"""
    hdr: File
    """light probe"""
    json: OptionalFile = None
    """write the rows here"""
    repeats: Count = 60
    """timed frames of each"""
    threads: OptionalCount = None
    """by default two, where there are two cores"""


@dataclass(frozen=True)
class Compare:
    """Frames of one avatar by two checkouts of this project, alternating: paired ratios of their times.

    rnd-bench compare ../before . --avatar assets/avatar.onnx --motion assets/walk.npz --hdr assets/sky.exr
    """

    before: Annotated[Path, tyro.conf.Positional, option("BEFORE")]
    """folder of a checkout"""
    after: Annotated[Path, tyro.conf.Positional, option("AFTER")]
    """folder of another one"""
    avatar: File
    """avatar.onnx that both play"""
    motion: File
    """its motion"""
    hdr: File
    """light probe"""
    shade: Annotated[str, option("MODE")] = "table"
    """as of rnd-play"""
    size: Count = 512
    """image side in pixels"""
    pairs: Count = 120
    """pairs of eight frames each"""
    threads: OptionalCount = None
    """of onnxruntime and of the kernels; by default two, where there are two cores"""
    json: OptionalFile = None
    """write the rows here"""


@dataclass(frozen=True)
class Ground:
    """What a shadow on the ground costs a frame, and its error against Mitsuba's path tracing.

    rnd-bench ground assets
    """

    assets: Annotated[Path, tyro.conf.Positional, option("ASSETS")]
    """folder with avatar.onnx, body.npz, walk.npz and sky.exr, such as a clone's assets"""
    json: OptionalFile = None
    """write the rows here"""
    size: Count = 512
    """image side in pixels of the timed frames"""
    pairs: Count = 200
    """frames with and without the ground"""
    samples: Count = 256
    """per pixel, of Mitsuba"""
    threads: OptionalCount = None
    """of onnxruntime and of the kernels; by default two, where there are two cores"""
