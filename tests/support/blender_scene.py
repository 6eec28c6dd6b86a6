"""A scene that tries the add-on within Blender's Python: run by tests/viewer/blender, which passes a JSON object."""

import importlib.util
import json
import math
import os
import sys

import bpy
import numpy as np
from mathutils import Euler


def main(told):
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.fps = 30
    if told["glb"]:
        bpy.ops.import_scene.gltf(filepath=told["glb"])
        armature = next(each for each in scene.objects if each.type == "ARMATURE")
        for each in scene.objects:
            each.hide_render = each.type == "MESH"  # the splats take its place
    else:  # a foreign one: two bones under another name
        bpy.ops.object.armature_add()
        armature = bpy.context.object
    scene.frame_start, scene.frame_end = told["frames"]
    scene.render.resolution_x, scene.render.resolution_y = told["size"]
    camera = bpy.data.cameras.new("shot")
    eye = bpy.data.objects.new("shot", camera)
    scene.collection.objects.link(eye)
    scene.camera = eye
    camera.lens, camera.shift_x, camera.shift_y = 50, 0.03, -0.02
    for step, frame in enumerate(told["frames"]):
        eye.location = (0.6 * step, -4.2, 1.1)
        eye.rotation_euler = Euler((math.radians(89), 0, math.radians(6 * step)))
        eye.keyframe_insert("location", frame=frame)
        eye.keyframe_insert("rotation_euler", frame=frame)
    _world(scene, told["hdr"], told["yaw"], told["strength"])
    spec = importlib.util.spec_from_file_location("rnd_avatar", told["addon"])
    addon = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(addon)
    addon.register()
    settings = scene.rnd_avatar
    settings.avatar, settings.armature, settings.folder = told["avatar"], armature, told["out"]
    settings.program, settings.composite = told["program"], told["composite"]
    try:
        image = addon.render(scene, settings)
    except addon.Problem as problem:
        print(json.dumps({"problem": str(problem)}))
        return
    result = {"file": image.filepath, "source": image.source, "frame": scene.frame_current}
    result["shown"] = [each.image.name for each in camera.background_images]
    if told["composite"]:
        _cube((0, -1.6, 0.3), (1, 0.05, 0.3))  # before the knees
        _cube((0, 1.5, 0.9), (1, 0.05, 2))  # behind the body
        scene.frame_set(told["frames"][1])
        scene.render.engine, scene.cycles.samples = "CYCLES", 1
        scene.view_settings.view_transform = "Raw"
        settings = scene.render.image_settings
        settings.file_format, settings.color_depth = "OPEN_EXR", "32"
        scene.render.filepath = f"{told['out']}/composite.exr"
        bpy.ops.render.render(write_still=True)
    for name in ("gltf", "usd"):
        bpy.ops.object.select_all(action="DESELECT")
        eye.select_set(True)
        if name == "gltf":
            only = {"export_cameras": True, "use_selection": True, "export_frame_range": True}
            bpy.ops.export_scene.gltf(filepath=f"{told['out']}/shot.glb", **only)
        else:
            only = {"selected_objects_only": True, "export_animation": True}
            bpy.ops.wm.usd_export(filepath=f"{told['out']}/shot.usdc", **only)
    print(json.dumps(result))


def _world(scene, hdr, yaw, strength):
    scene.world = bpy.data.worlds.new("world")
    if scene.world.node_tree is None:
        scene.world.use_nodes = True
    tree = scene.world.node_tree
    background = next((node for node in tree.nodes if node.type == "BACKGROUND"), None)
    background = background or tree.nodes.new("ShaderNodeBackground")
    background.inputs["Strength"].default_value = strength
    if not hdr:
        background.inputs["Color"].default_value = (0.2, 0.4, 0.6, 1)
        return
    texture, mapping, source = (
        tree.nodes.new(f"ShaderNode{kind}") for kind in ("TexEnvironment", "Mapping", "TexCoord")
    )
    texture.image = bpy.data.images.load(hdr)
    mapping.inputs["Rotation"].default_value[2] = yaw
    tree.links.new(source.outputs["Generated"], mapping.inputs["Vector"])
    tree.links.new(mapping.outputs[0], texture.inputs[0])
    tree.links.new(texture.outputs[0], background.inputs[0])


def _cube(location, scale):
    bpy.ops.mesh.primitive_cube_add(location=location)
    cube = bpy.context.object
    cube.scale = scale
    material = bpy.data.materials.new("glow")
    if material.node_tree is None:
        material.use_nodes = True
    tree = material.node_tree
    glow = tree.nodes.new("ShaderNodeEmission")
    glow.inputs["Color"].default_value = (0, float(np.sign(location[1]) > 0), 1, 1)
    end = next((node for node in tree.nodes if node.type == "OUTPUT_MATERIAL"), None)
    tree.links.new(glow.outputs[0], (end or tree.nodes.new("ShaderNodeOutputMaterial")).inputs[0])
    cube.data.materials.append(material)


main(json.loads(sys.argv[1]))
sys.stdout.flush()
os._exit(0)  # bpy 4.5 waits for its own threads for ever at an ordinary exit, on some machines
