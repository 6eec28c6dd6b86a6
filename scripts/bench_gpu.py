"""Frames drawn by OpenGL on a graphics card beside those of the CPU kernel, at 512² and 1080².

python scripts/bench_gpu.py --checkpoint runs/park/avatar.ckpt [--json assets/bench/gpu.json]

Every stage is timed until the device has finished it, and the read-back into memory is counted: see
``rnd_runtime.gl.frame``. Refuses OpenGL that runs on the CPU, which ``rnd-bench grid`` has.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from rnd_bench.speed.point import Inputs, Setting, measured
from rnd_runtime.core.errors import InputError, run_command
from rnd_runtime.core.files import write_json
from rnd_runtime.gl.context import create_context, is_software, renderer

ROOT = Path(__file__).parent.parent
SIZES = (512, 1080)
SHADES = ("table", "table+sun")
RASTERS = ("gl-egl", "cpu")
N = 30_000


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--checkpoint", type=Path, help="trained avatar.ckpt of 30 000 Gaussians; else a seeded one")
    parser.add_argument("--json", type=Path, default=Path("assets/bench/gpu.json"))
    parser.add_argument("--threads", type=int, default=2, help="of onnxruntime and of the CPU's kernels")
    parser.add_argument("--no-compare", action="store_true", help="leave out the errors, which take minutes")
    options = parser.parse_args()

    def command() -> None:
        context = create_context("egl")
        software, name = is_software(context), renderer(context)
        context.release()  # each point opens its own
        if software:
            raise InputError("a graphics card", expected="OpenGL through EGL that runs on one", got=name)
        assets = ROOT / "assets"
        checkpoints = (options.checkpoint,) if options.checkpoint else ()
        inputs = Inputs(
            assets / "body.npz", assets / "walk.npz", assets / "sky.exr", Path(".cache/bench"), checkpoints
        ).checked()
        rows = []
        for size in SIZES:
            for shade in SHADES:
                for raster in RASTERS:
                    setting = Setting(N, size, shade, raster=raster, threads=options.threads)
                    row = measured(setting, inputs, compare=not options.no_compare and size == SIZES[0])
                    row["fps"] = 1e3 / row["ms_median"]
                    stages = ", ".join(f"{name} {ms:.2f}" for name, ms in row["stages"].items())
                    print(f"{raster:7} {size:5} {shade:10} {row['ms_median']:6.2f} ms  ({stages})", flush=True)
                    rows.append(row)
                    write_json(options.json, rows)

    raise SystemExit(run_command("bench_gpu", command))


if __name__ == "__main__":
    main()
