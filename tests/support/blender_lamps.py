"""Lamps over a white floor within Blender's Python: what Cycles sees, and what the add-on exports."""

import importlib.util
import json
import math
import os
import sys

import bpy
import numpy as np
from mathutils import Euler, Vector

LAMPS = {
    "SUN": {"energy": 3.0, "angle": math.radians(4), "color": (1, 0.5, 0.25)},
    "POINT": {"energy": 400.0, "shadow_soft_size": 0.1},
    "SPOT": {"energy": 400.0, "spot_size": 1.0, "spot_blend": 0.0, "shadow_soft_size": 0.1},
    "AREA": {"energy": 400.0, "size": 0.3, "size_y": 0.2, "shape": "RECTANGLE"},
}


def main(told):
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    spec = importlib.util.spec_from_file_location("rnd_avatar", told["addon"])
    addon = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(addon)
    bpy.ops.mesh.primitive_plane_add(size=0.5)
    bpy.context.object.data.materials.append(_white())
    camera = bpy.data.objects.new("eye", bpy.data.cameras.new("eye"))
    scene.collection.objects.link(camera)
    camera.location, scene.camera = (0, 0, 6), camera
    camera.data.lens = 500
    scene.render.engine, scene.cycles.samples, scene.cycles.max_bounces = "CYCLES", 64, 0
    scene.render.resolution_x = scene.render.resolution_y = 8
    scene.view_settings.view_transform = "Raw"
    settings = scene.render.image_settings
    settings.file_format, settings.color_depth, settings.color_mode = "OPEN_EXR", "32", "RGB"
    scene.render.filepath = f"{told['out']}/floor.exr"
    bpy.ops.object.armature_add()
    armature = bpy.context.object
    rows = {}
    for kind, values in LAMPS.items():
        lamp = bpy.data.lights.new(kind, kind)
        for name, value in values.items():
            setattr(lamp, name, value)
        each = bpy.data.objects.new(kind, lamp)
        scene.collection.objects.link(each)
        each.location, each.rotation_euler = (1.2, -0.8, 3.0), Euler((math.radians(15), math.radians(22), 0))
        bpy.context.view_layer.update()
        bpy.ops.render.render(write_still=True)
        seen = bpy.data.images.load(scene.render.filepath, check_existing=False)
        pixels = np.array(seen.pixels[:]).reshape(8, 8, -1)[..., :3]
        ((direction, irradiance, radius),) = addon.lamps_of(scene, Vector())
        rows[kind] = {
            "cycles": (math.pi * pixels.mean((0, 1))).tolist(),
            "ours": (irradiance * direction[2]).tolist(),
            "direction": list(direction),
            "radius": radius,
        }
        if kind == "SUN":
            arguments = addon.export_light(scene, armature, told["out"])
        bpy.data.objects.remove(each)
    print(json.dumps({"lamps": rows, "arguments": arguments}))


def _white():
    material = bpy.data.materials.new("white")
    if material.node_tree is None:
        material.use_nodes = True
    tree = material.node_tree
    tree.nodes.clear()
    diffuse, end = tree.nodes.new("ShaderNodeBsdfDiffuse"), tree.nodes.new("ShaderNodeOutputMaterial")
    diffuse.inputs["Color"].default_value = (1, 1, 1, 1)
    tree.links.new(diffuse.outputs[0], end.inputs[0])
    return material


main(json.loads(sys.argv[1]))
sys.stdout.flush()
os._exit(0)  # bpy 4.5 waits for its own threads for ever at an ordinary exit, on some machines
