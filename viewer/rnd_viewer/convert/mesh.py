"""``rnd-convert mesh``: the clothed, textured and rigged surface of an avatar."""

from __future__ import annotations

from dataclasses import replace

from rnd_runtime.avatar.avatar import Avatar
from rnd_runtime.capture.body import Body
from rnd_runtime.cli.command import finish, log
from rnd_runtime.cli.progress import track
from rnd_runtime.core.files import output_folder
from rnd_runtime.core.images import write_image
from rnd_runtime.posing.forearm import share_twists
from rnd_viewer.inputs.options import parse_frames

from .mesh_files import write_mtl, write_obj, write_rigged_glb
from .options import MeshOptions, chosen_formats
from .surface import clothed_surface
from .texture import bake, load_xatlas, unwrap
from .usd_files import load_usd, write_rigged_usd

FORMATS = ("glb", "usd", "obj")


def convert_mesh(options: MeshOptions) -> None:
    """Write the files of ``options`` and report them."""
    formats = chosen_formats(options.format, FORMATS)
    options.refuse_unfit(formats)
    load_xatlas()
    if "usd" in formats:
        load_usd()
    avatar, body = Avatar.load(options.avatar), Body.load(options.body)
    motion = options.reading.read_motion(options.motion, avatar.skeleton)
    for note in motion.notes:
        log(f"note: {note}")
    frames = parse_frames(options.frames, motion.frame_count)
    out = output_folder(options.out)
    log("the surface takes a minute: unwrapping and baking")
    surface = clothed_surface(avatar, body, motion)
    charts = unwrap(surface)
    textures = bake(surface, charts, options.texture)
    parts = surface, charts, textures
    rigged = replace(motion, rotations=share_twists(avatar.skeleton, motion.rotations))  # as in the avatar
    if "glb" in formats:
        write_rigged_glb(out / "avatar.glb", *parts, avatar.skeleton, rigged)
    if "usd" in formats:
        write_rigged_usd(out / "avatar.usdz", *parts, avatar.skeleton, rigged)
    if "obj" in formats:
        write_image(out / "albedo.png", textures.albedo)
        write_mtl(out / "avatar.mtl", "albedo.png")
        for number in track("writing meshes", frames, len(frames)):
            write_obj(
                out / f"{number:06d}.obj", surface.posed(avatar, motion, number / motion.fps), charts, surface.faces
            )
    made = f"{len(surface.vertices)} vertices, {motion.duration:.1f} s of motion"
    finish(out, f"{made}; four joints a vertex are within {1e3 * surface.error_m:.2f} mm of the avatar's own posing")
