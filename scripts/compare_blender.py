"""Renders the mesh of rnd-convert in Blender's Cycles beside rnd-play's frame, under the same light and camera.

    BLENDER_PYTHON=bpy/bin/python python scripts/compare_blender.py out/mesh --out out/blender

OUT gets Cycles' frames as EXR and PNGs with both and three times their difference; rows go to
assets/bench/blender.json. BLENDER_PYTHON is a Python with the module bpy. The folder holds avatar.glb and avatar.usdz
of ``rnd-convert mesh --format glb,usd``.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path

ASSETS = Path(__file__).parent.parent / "assets"
FRAMES, SIZE, SAMPLES, FPS = (20, 75), 512, 32, 30


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("mesh", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    files = [options.mesh / name for name in ("avatar.glb", "avatar.usdz")]
    rows = [_compared(file, frame, options.out) for file in files for frame in FRAMES]
    (ASSETS / "bench/blender.json").write_text(json.dumps(rows, indent=1) + "\n")


def _compared(mesh: Path, frame: int, out: Path) -> dict[str, object]:
    import numpy as np

    import rnd_runtime as rnd
    from rnd_runtime.core.images import linear_to_srgb, read_image, to_bytes, write_image
    from rnd_runtime.playback.frame import FrameRenderer

    avatar = rnd.load_avatar(ASSETS / "avatar.onnx")
    walk = rnd.load_motion(ASSETS / "walk.npz", avatar.skeleton)
    camera = rnd.framing_camera(avatar, walk, width=SIZE, height=SIZE)
    told = {"mesh": str(mesh.resolve()), "hdr": str(ASSETS / "sky.exr"), "frame": frame, "K": camera.K.tolist()}
    file = out / f"cycles_{mesh.suffix[1:]}_{frame}.exr"
    told |= {"world_to_camera": camera.world_to_camera.tolist(), "out": str(file.resolve())}
    subprocess.run([os.environ["BLENDER_PYTHON"], __file__, json.dumps(told)], check=True, stdout=subprocess.DEVNULL)
    renderer = FrameRenderer(avatar, rnd.load_light(ASSETS / "sky.exr"), camera)
    ours, theirs = renderer.render(walk, frame / walk.fps).linear(), read_image(file)
    a, b = (image[..., 3] > 0.5 for image in (ours, theirs))
    over = [linear_to_srgb(image[..., :3] + (1 - image[..., 3:]) * 0.2).clip(0, 1) for image in (ours, theirs)]
    inside = (ours[..., 3] > 0.99) & (theirs[..., 3] > 0.99)
    rows, columns = np.nonzero(ours[..., 3] > 0.1)
    part = slice(max(rows.min() - 8, 0), rows.max() + 8), slice(max(columns.min() - 24, 0), columns.max() + 24)
    both = np.concatenate([*over, 3 * np.abs(over[0] - over[1])], axis=1)[part[0]]
    wide = [both[:, k * SIZE :][:, part[1]] for k in range(3)]
    write_image(out / f"beside_{mesh.suffix[1:]}_{frame}.png", to_bytes(np.concatenate(wide, axis=1)))
    return {
        "file": mesh.name,
        "frame": frame,
        "size": SIZE,
        "samples": SAMPLES,
        "psnr": float(-10 * np.log10(np.mean((over[0] - over[1]) ** 2))),
        "psnr_inside": float(-10 * np.log10(np.mean((over[0] - over[1])[inside] ** 2))),
        "iou": float((a & b).sum() / (a | b).sum()),
        "radiance_ratio": float(theirs[..., :3][inside].mean() / ours[..., :3][inside].mean()),
    }


def _render(told: dict[str, object]) -> None:
    """Within Blender."""
    import bpy
    from mathutils import Matrix

    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.fps = FPS
    if str(told["mesh"]).endswith(".glb"):
        bpy.ops.import_scene.gltf(filepath=told["mesh"])
    else:
        bpy.ops.wm.usd_import(filepath=told["mesh"])
    lens = bpy.data.cameras.new("camera")
    camera = bpy.data.objects.new("camera", lens)
    scene.collection.objects.link(camera)
    to_z_up = Matrix(((1, 0, 0, 0), (0, 0, -1, 0), (0, 1, 0, 0), (0, 0, 0, 1)))
    camera.matrix_world = to_z_up @ Matrix(told["world_to_camera"]).inverted() @ Matrix.Diagonal((1, -1, -1, 1))
    lens.sensor_width, lens.lens = 36, told["K"][0][0] * 36 / SIZE
    scene.camera, scene.world = camera, bpy.data.worlds.new("sky")
    if scene.world.node_tree is None:
        scene.world.use_nodes = True
    tree = scene.world.node_tree
    background = next((node for node in tree.nodes if node.type == "BACKGROUND"), None)
    sky = tree.nodes.new("ShaderNodeTexEnvironment")
    sky.image = bpy.data.images.load(told["hdr"])
    tree.links.new(sky.outputs[0], (background or tree.nodes.new("ShaderNodeBackground")).inputs[0])
    render = scene.render
    render.engine, render.resolution_x, render.resolution_y, render.film_transparent = "CYCLES", SIZE, SIZE, True
    scene.cycles.samples, scene.cycles.use_denoising = SAMPLES, True
    render.image_settings.file_format, render.image_settings.color_depth = "OPEN_EXR", "32"
    render.image_settings.color_mode = "RGBA"
    scene.frame_set(told["frame"])
    render.filepath = told["out"]
    bpy.ops.render.render(write_still=True)


if __name__ == "__main__":
    if sys.argv[1][:1] == "{":
        _render(json.loads(sys.argv[1]))
        os._exit(0)  # bpy 4.5 waits for its own threads for ever at an ordinary exit, on some machines
    else:
        main()
