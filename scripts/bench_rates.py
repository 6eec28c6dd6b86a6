"""What nodes of its own for each network are worth beside fewer for all.

python scripts/bench_rates.py CHECKPOINT OUT.json

Files of one checkpoint, timed and compared with the whole avatar as a bound's search of ``rnd-export`` does it, by
``table`` under the embedded walk and sky, in shots on both sides of the search; the best of several times counts.
"""

from __future__ import annotations

import sys
from pathlib import Path

from numba import get_num_threads

from rnd_export.reduce.variant import Variant
from rnd_export.search.candidates import Recipe, Scene, Workbench
from rnd_runtime.core.files import write_json
from rnd_runtime.motion.motion import load_motion
from rnd_runtime.playback.doctor import machine
from rnd_runtime.shading.light import load_light
from rnd_trainer.model.checkpoint import load_checkpoint

ASSETS = Path(__file__).parent.parent / "assets"
ROUNDS = 3
"""times that every file is measured, in turn with the others"""


def variants(nodes: int) -> dict[str, Variant]:
    """By what is said of them, for a checkpoint of so many ``nodes``."""
    half, third, quarter, eighth = (nodes // share for share in (2, 3, 4, 8))
    return {
        "everything at all nodes": Variant(),
        "skinning at a quarter": Variant(skinning_nodes=quarter),
        "offsets at an eighth": Variant(offset_nodes=eighth),
        "visibility at a quarter": Variant(visibility_nodes=quarter),
        "skinning at a quarter, offsets at an eighth": Variant(skinning_nodes=quarter, offset_nodes=eighth),
        "all at a half": Variant("coarse", nodes=half),
        "all at a half, skinning at a quarter": Variant("coarse", nodes=half, skinning_nodes=quarter),
        "all at a third": Variant("coarse", nodes=third),
        "all at a quarter": Variant("coarse", nodes=quarter),
    }


def main(checkpoint: Path, out: Path) -> None:
    """Measure and write the rows."""
    trained = load_checkpoint(checkpoint)
    motion = load_motion(ASSETS / "walk.npz", trained.skeleton)
    bench = Workbench(trained, Scene(motion, load_light(ASSETS / "sky.exr"), shade="table"))
    models = {name: bench.model(Recipe(variant)) for name, variant in variants(bench.config.nodes).items()}
    shots = [*bench.seen, *bench.held_out]
    found = {name: [] for name in models}
    for _ in range(ROUNDS):
        for name, model in models.items():
            found[name].append(bench.measure(model, shots))
    rows = [
        {
            "networks": name,
            "ms": min(one.ms for one in took),
            "psnr_db": took[0].psnr,
            "mb": took[0].mb,
            "nodes": bench.config.nodes,
            "gaussians": bench.config.gaussians,
            "size": 512,
            "shade": "table",
            "threads": get_num_threads(),
            "machine": machine(),
        }
        for name, took in found.items()
    ]
    write_json(out, rows)


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit("usage: bench_rates.py CHECKPOINT OUT.json")
    main(Path(sys.argv[1]), Path(sys.argv[2]))
