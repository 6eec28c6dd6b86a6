"""RnD-Avatar for Blender 4.2 or later: renders an avatar by rnd-play in the camera, motion and light of a scene.

Install this file as an add-on (Edit, Preferences, Add-ons, Install from Disk). The panel is in the 3D view's sidebar.

* Motion: an armature whose bones have the names of the avatar's joints, such as that of ``rnd-convert mesh``; its
  animation is taken exactly. Any other armature is exported as BVH, which rnd-play retargets.
* Camera: the scene's, in every frame. Light: the world's environment texture with its rotation and strength, or its
  colour, and the lamps as they shine on the armature in the first frame: suns, and as far ones the others.
* The frames return as an OpenEXR sequence: over the camera's view, and on request in the compositor, which shows what
  is nearer, the avatar or the scene's own render, by their depths.
"""

import json
import math
import shutil
import subprocess
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix, Vector

bl_info = {
    "name": "RnD-Avatar",
    "author": "RnD-Avatar contributors",
    "version": (1, 0, 0),
    "blender": (4, 2, 0),
    "location": "3D View > Sidebar > RnD-Avatar",
    "description": "Render a Gaussian avatar with the scene's motion, camera and light",
    "category": "Render",
}

Z_UP_TO_Y_UP = Matrix(((1, 0, 0, 0), (0, 0, 1, 0), (0, -1, 0, 0), (0, 0, 0, 1)))
FLIP = Matrix.Diagonal((1, -1, -1, 1))  # Blender's camera axes ↔ OpenCV's
OWN_JOINTS = ("pelvis", "left_hip", "right_hip", "left_knee", "right_knee", "left_shoulder", "right_shoulder")
AOVS = "depth,normal,albedo"


class Problem(Exception):
    """What the user can mend, in one line."""


def export_motion(scene, armature, folder):
    """Write the armature's animation in the scene's frames into ``folder``; the file's path."""
    if all(name in armature.data.bones for name in OWN_JOINTS):
        return _export_poses(scene, armature, Path(folder) / "motion.npz")
    path = Path(folder) / "motion.bvh"
    bpy.ops.object.select_all(action="DESELECT")
    armature.select_set(True)
    bpy.context.view_layer.objects.active = armature
    frames = {"frame_start": scene.frame_start, "frame_end": scene.frame_end}
    bpy.ops.export_anim.bvh(filepath=str(path), rotate_mode="XYZ", root_transform_only=True, **frames)
    return path


def _export_poses(scene, armature, path):
    """Local rotations relative to the rest pose, and the root's path, in metres and Y up."""
    bones = list(armature.data.bones)
    order = sorted(bones, key=lambda bone: len(bone.parent_recursive))
    frames = range(scene.frame_start, scene.frame_end + 1)
    poses, positions = np.zeros((len(frames), len(order), 3)), np.zeros((len(frames), 3))
    to_ours = Z_UP_TO_Y_UP.to_3x3()
    rest = {bone.name: bone.matrix_local.to_3x3().inverted() for bone in order}
    for row, frame in enumerate(frames):
        scene.frame_set(frame)
        world = armature.matrix_world
        turned = {}  # rotations of the world, rest → now
        for column, bone in enumerate(order):
            now = (world @ armature.pose.bones[bone.name].matrix).to_3x3().normalized()
            turned[bone.name] = to_ours @ (now @ rest[bone.name]) @ to_ours.transposed()
            parent = turned[bone.parent.name].transposed() if bone.parent else Matrix.Identity(3)
            quaternion = (parent @ turned[bone.name]).to_quaternion()
            axis, angle = quaternion.to_axis_angle()
            poses[row, column] = Vector(axis) * ((angle + math.pi) % (2 * math.pi) - math.pi)
        root = order[0]
        head = world @ armature.pose.bones[root.name].head
        positions[row] = to_ours @ (head - root.head_local)
    np.savez(
        path,
        poses=poses.reshape(len(frames), -1),
        trans=positions,
        mocap_framerate=np.array(_fps(scene)),
        joint_names=np.array([bone.name for bone in order]),
        up_axis=np.array("y"),
    )
    return path


def export_camera(scene, folder):
    """Write the scene's camera in each of its frames; the file's path."""
    camera = scene.camera
    if camera is None or camera.data.type != "PERSP":
        raise Problem("the scene needs an active perspective camera")
    width = max(1, scene.render.resolution_x * scene.render.resolution_percentage // 100)
    height = max(1, scene.render.resolution_y * scene.render.resolution_percentage // 100)
    records = []
    for frame in range(scene.frame_start, scene.frame_end + 1):
        scene.frame_set(frame)
        graph = bpy.context.evaluated_depsgraph_get()
        projection = camera.calc_matrix_camera(graph, x=width, y=height)
        K = [
            [projection[0][0] * width / 2, 0, width / 2 * (1 - projection[0][2])],
            [0, projection[1][1] * height / 2, height / 2 * (1 + projection[1][2])],
            [0, 0, 1],
        ]
        pose = camera.evaluated_get(graph).matrix_world.normalized()
        to_camera = (Z_UP_TO_Y_UP @ pose @ FLIP).inverted()
        rows = [list(row) for row in to_camera]
        records.append({"width": width, "height": height, "K": K, "world_to_camera": rows})
    path = Path(folder) / "camera.json"
    path.write_text(json.dumps({"cameras": records}), encoding="utf-8")
    return path


def export_light(scene, armature, folder):
    """The scene's light as arguments of rnd-play; images that Blender alone has are written into ``folder``."""
    tree = scene.world.node_tree if scene.world else None
    nodes = list(tree.nodes) if tree else []
    background = next((node for node in nodes if node.type == "BACKGROUND"), None)
    strength = background.inputs["Strength"].default_value if background else 1.0
    texture = next((node for node in nodes if node.type == "TEX_ENVIRONMENT" and node.image), None)
    arguments, yaw = ["--exposure", f"{math.log2(max(strength, 1e-6)):.6f}"], 0.0
    mapping = next((node for node in nodes if node.type == "MAPPING"), None)
    if texture is None:
        colour = background.inputs["Color"].default_value[:3] if background else (0.05, 0.05, 0.05)
        pixels = np.tile(np.array(colour, np.float32), (32, 64, 1))
    elif mapping is not None:
        yaw = mapping.inputs["Rotation"].default_value[2]
        arguments += ["--hdr-yaw", f"{math.degrees(yaw):.6f}"]
    lamps = list(lamps_of(scene, _middle(armature)))
    if texture is not None and not lamps:
        path = Path(bpy.path.abspath(texture.image.filepath))
        if not path.is_file() or path.suffix.lower() not in (".exr", ".hdr"):
            path = _saved(texture.image, folder)
        return ["--hdr", str(path), *arguments]
    if texture is not None:
        pixels = np.empty(4 * texture.image.size[0] * texture.image.size[1], np.float32)
        texture.image.pixels.foreach_get(pixels)
        pixels = pixels.reshape(texture.image.size[1], texture.image.size[0], 4)[..., :3]
    if lamps:
        arguments[1] = "0"
        pixels = _with_lamps(strength * pixels, lamps, yaw)
    height, width = pixels.shape[:2]
    image = bpy.data.images.new("rnd_world", width, height, float_buffer=True, is_data=True)
    image.pixels.foreach_set(np.concatenate([pixels, np.ones((height, width, 1))], -1).astype(np.float32).ravel())
    path = _saved(image, folder)
    bpy.data.images.remove(image)
    return ["--hdr", str(path), *arguments]


def _middle(armature):
    """Where the armature's bones are, on average."""
    heads = [armature.matrix_world @ bone.head for bone in armature.pose.bones]
    return sum(heads, Vector()) / len(heads)


def lamps_of(scene, place):
    """Direction, irradiance across it (W/m², RGB) and angular radius (rad) of each lamp as seen from ``place``."""
    for each in scene.objects:
        if each.type != "LIGHT" or each.hide_render:
            continue
        lamp, matrix = each.data, each.matrix_world
        power = np.array(lamp.color) * lamp.energy * 2 ** getattr(lamp, "exposure", 0.0)
        if getattr(lamp, "use_temperature", False):
            power = power * np.array(lamp.temperature_color)
        backwards = matrix.to_3x3().normalized() @ Vector((0, 0, 1))  # lamps shine along their −Z
        if lamp.type == "SUN":
            yield backwards, power, lamp.angle / 2
            continue
        way = matrix.translation - place
        distance, towards = max(way.length, 1e-3), way.normalized()
        ahead, radius = towards.dot(backwards), lamp.shadow_soft_size if lamp.type != "AREA" else 0.0
        share = 1 / (4 * math.pi)
        if lamp.type == "SPOT":
            share *= float(ahead > math.cos(lamp.spot_size / 2))
        elif lamp.type == "AREA":
            sides = matrix.to_scale()
            across = lamp.size_y if lamp.shape in ("RECTANGLE", "ELLIPSE") else lamp.size
            radius = math.sqrt(abs(lamp.size * sides[0] * across * sides[1]) / math.pi)
            share = max(ahead, 0.0) / math.pi
        if share > 0:
            yield towards, share * power / distance**2, math.atan(radius / distance)


def _with_lamps(pixels, lamps, yaw):
    """World ``pixels`` [H, W, 3], from below, at least 512 wide, with discs of the lamps' irradiance."""
    finer = -(-512 // pixels.shape[1])
    pixels = np.repeat(np.repeat(pixels, finer, 0), finer, 1)
    height, width = pixels.shape[:2]
    up = (np.arange(height) + 0.5) / height * math.pi - math.pi / 2
    round_ = (np.arange(width) + 0.5) / width * 2 * math.pi - math.pi + yaw
    flat = np.stack([np.cos(round_), -np.sin(round_), np.zeros(width)], -1)
    texels = np.cos(up)[:, None, None] * flat + np.sin(up)[:, None, None] * np.array([0, 0, 1.0])
    solid = np.cos(up)[:, None] * (math.pi / height) * (2 * math.pi / width)
    for direction, irradiance, radius in lamps:
        cosine = texels @ np.array(direction)
        disc = solid * np.clip(cosine, 0, 1) * (cosine >= min(math.cos(max(radius, math.pi / height)), cosine.max()))
        pixels = pixels + (disc > 0)[..., None] * irradiance / disc.sum()
    return pixels


def _saved(image, folder):
    """A copy of ``image`` as EXR."""
    path = Path(folder) / "world.exr"
    settings = bpy.context.scene.render.image_settings
    before = settings.file_format, settings.color_depth
    settings.file_format, settings.color_depth = "OPEN_EXR", "32"
    image.save_render(str(path))
    settings.file_format, settings.color_depth = before
    return path


def render(scene, settings, progress=lambda line: None):
    """Export, call rnd-play, and bring the frames back; the image sequence."""
    avatar, armature = Path(bpy.path.abspath(settings.avatar)), settings.armature
    if not avatar.is_file():
        raise Problem(f"no avatar at {avatar}")
    if armature is None or armature.type != "ARMATURE":
        raise Problem("choose an armature for the motion")
    program = settings.program or shutil.which("rnd-play")
    if not program:
        raise Problem("rnd-play is not on the PATH: choose it in the panel")
    folder = Path(bpy.path.abspath(settings.folder))
    folder.mkdir(parents=True, exist_ok=True)
    current = scene.frame_current
    try:
        motion = export_motion(scene, armature, folder)
        camera = export_camera(scene, folder)
        scene.frame_set(scene.frame_start)
        light = export_light(scene, armature, folder)
    finally:
        scene.frame_set(current)
    out = folder / "frames"
    if out.exists():
        shutil.rmtree(out)
    line = [bpy.path.abspath(program), str(avatar), "--motion", str(motion), "--camera", str(camera), *light]
    line += ["--fps", f"{_fps(scene):g}", "--format", "exr", "--aov", AOVS, "--out", str(out)]
    count = scene.frame_end - scene.frame_start + 1
    line += ["--frames", f"0:{count}"]
    progress(" ".join(line))
    done = subprocess.run(line, capture_output=True, text=True, check=False)
    if done.returncode:
        raise Problem((done.stderr or done.stdout).strip().splitlines()[-1])
    image = bring_back(scene, out / "frames_exr", count)
    if settings.composite:
        composite(scene, image, count)
    return image


def bring_back(scene, folder, count):
    """The frames as an image sequence: behind the camera's view, and in the list of images."""
    files = sorted(Path(folder).glob("*.exr"))
    if len(files) != count:
        raise Problem(f"{len(files)} frames of {count} were rendered")
    old = bpy.data.images.get("RnD-Avatar")
    if old is not None:
        bpy.data.images.remove(old)
    image = bpy.data.images.load(str(files[0]))
    image.name, image.source = "RnD-Avatar", "SEQUENCE"
    camera = scene.camera.data
    shown = next((each for each in camera.background_images if each.image in (None, image)), None)
    shown = shown or camera.background_images.new()
    shown.image = image
    user = shown.image_user
    user.frame_start, user.frame_duration, user.frame_offset = scene.frame_start, count, -1
    user.use_auto_refresh = True
    shown.alpha, shown.display_depth = 1.0, "FRONT"
    camera.show_background_images = True
    return image


def composite(scene, image, count):
    """A compositor that shows, of the frames and of the scene's own render, what is nearer; its node tree."""
    for layer in scene.view_layers:
        layer.use_pass_z = True
    if hasattr(scene, "compositing_node_group"):  # Blender 5
        tree = bpy.data.node_groups.new("RnD-Avatar", "CompositorNodeTree")
        scene.compositing_node_group = tree
        tree.interface.new_socket("Image", in_out="OUTPUT", socket_type="NodeSocketColor")
        end, math_node = tree.nodes.new("NodeGroupOutput"), "ShaderNodeMath"
    else:
        scene.use_nodes = True
        tree = scene.node_tree
        tree.nodes.clear()
        end, math_node = tree.nodes.new("CompositorNodeComposite"), "CompositorNodeMath"
    scene.render.use_compositing = True
    layers, ours = tree.nodes.new("CompositorNodeRLayers"), tree.nodes.new("CompositorNodeImage")
    layers.scene, ours.image = scene, image
    ours.frame_start, ours.frame_duration, ours.frame_offset = scene.frame_start, count, -1
    ours.use_auto_refresh = True
    outside, far = tree.nodes.new(math_node), tree.nodes.new(math_node)
    outside.operation, far.operation = "LESS_THAN", "MULTIPLY_ADD"  # depth is 0 where there is no avatar
    outside.inputs[1].default_value, far.inputs[1].default_value = 0.5, 1e10
    nearer = tree.nodes.new("CompositorNodeZcombine")
    if "Use Alpha" in nearer.inputs:
        nearer.inputs["Use Alpha"].default_value = True
    else:
        nearer.use_alpha = True
    link = tree.links.new
    link(ours.outputs["Alpha"], outside.inputs[0])
    link(outside.outputs[0], far.inputs[0])
    link(ours.outputs["Depth"], far.inputs[2])
    link(ours.outputs[0], nearer.inputs[0])
    link(far.outputs[0], nearer.inputs[1])
    link(layers.outputs["Image"], nearer.inputs[2])
    link(layers.outputs["Depth"], nearer.inputs[3])
    link(nearer.outputs[0], end.inputs[0])
    return tree


def _fps(scene):
    return scene.render.fps / scene.render.fps_base


class RndSettings(bpy.types.PropertyGroup):
    """The panel's fields."""

    avatar: bpy.props.StringProperty(name="Avatar", subtype="FILE_PATH", description="avatar.onnx of rnd-export")
    armature: bpy.props.PointerProperty(
        name="Motion", type=bpy.types.Object, poll=lambda self, each: each.type == "ARMATURE"
    )
    folder: bpy.props.StringProperty(name="Folder", subtype="DIR_PATH", default="//rnd_avatar")
    composite: bpy.props.BoolProperty(
        name="Composite by depth", description="replace the scene's compositor by one that combines both renders"
    )
    program: bpy.props.StringProperty(name="rnd-play", subtype="FILE_PATH", description="empty: found on the PATH")


class RndRender(bpy.types.Operator):
    """Render the avatar in the scene's frames and show it in the camera's view"""

    bl_idname = "rnd_avatar.render"
    bl_label = "Render avatar"

    def execute(self, context):
        try:
            image = render(context.scene, context.scene.rnd_avatar, lambda line: self.report({"INFO"}, line))
        except (Problem, OSError) as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.report({"INFO"}, f"frames in {image.filepath}")
        return {"FINISHED"}


class RndPanel(bpy.types.Panel):
    """The fields and the button."""

    bl_label = "RnD-Avatar"
    bl_idname = "VIEW3D_PT_rnd_avatar"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "RnD-Avatar"

    def draw(self, context):
        settings = context.scene.rnd_avatar
        for name in ("avatar", "armature", "folder", "composite", "program"):
            self.layout.prop(settings, name)
        self.layout.operator(RndRender.bl_idname)


CLASSES = (RndSettings, RndRender, RndPanel)


def register():
    for each in CLASSES:
        bpy.utils.register_class(each)
    bpy.types.Scene.rnd_avatar = bpy.props.PointerProperty(type=RndSettings)


def unregister():
    del bpy.types.Scene.rnd_avatar
    for each in reversed(CLASSES):
        bpy.utils.unregister_class(each)
