"""The work of ``rnd-convert``."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.avatar.avatar import Avatar, Encoded
from rnd_runtime.capture.body import Body, posed_vertices
from rnd_runtime.cli.command import finish, log
from rnd_runtime.cli.progress import track
from rnd_runtime.core.errors import InputError, check_option
from rnd_runtime.core.files import existing_file, output_folder, refuse_input
from rnd_runtime.core.gaussians import Gaussians
from rnd_runtime.core.signals import temporary_folder
from rnd_runtime.motion.amass import write_amass
from rnd_runtime.motion.edit import resampled
from rnd_runtime.motion.motion import Motion, motion_inputs
from rnd_runtime.motion.skeleton import Skeleton
from rnd_runtime.playback.framing import CameraOptions, CameraPath, frame_motion, front_path
from rnd_runtime.posing.forearm import share_twists
from rnd_runtime.shading.light import light_notes
from rnd_runtime.shading.shader import Shader
from rnd_viewer.inputs.cameras import file_path
from rnd_viewer.inputs.lights import chosen_light
from rnd_viewer.inputs.options import parse_frames

from .mesh_files import write_obj, write_rigged_glb
from .options import AmassOptions, MeshOptions, Options, SplatOptions
from .splat_files import splat_transform, transform_ply, write_ply, write_splat_glb
from .splats import Splats, are_finite, fixed_colour, half_turned, make_splats, stored_colours, view_dependent_colour
from .visionary import check_clip, packed, write_visionary

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]
SPLAT_FORMATS, MESH_FORMATS = ("ply", "glb", "spz", "sog", "visionary"), ("glb", "obj")
# rnd-play's front camera; only its position matters here.
FRONT = CameraOptions(512, 512)


def convert(options: Options) -> None:
    """Write the files of ``options`` and report them."""
    if isinstance(options, SplatOptions):
        _splats(options)
    elif isinstance(options, MeshOptions):
        _mesh(options)
    else:
        _motion(options)


def _splats(options: SplatOptions) -> None:
    formats = _formats(options.format, SPLAT_FORMATS)
    options.refuse_unfit(formats)
    program = splat_transform() if {"spz", "sog"} & set(formats) else None
    avatar = Avatar.load(options.avatar)
    motion = options.reading.read_motion(options.motion, avatar.skeleton)
    _log_notes(motion.notes)
    frames = parse_frames(options.frames, motion.frame_count)
    if "visionary" in formats:
        check_clip(len(frames), avatar.gaussians)
    light = chosen_light(avatar, options.hdr, up=options.hdr_up, yaw=options.hdr_yaw, exposure=options.exposure)
    if options.colour == "lit":
        _log_notes(light_notes(light))
    shader = Shader(light, mode=options.shade)
    camera_at = _camera_path(options.camera, avatar.skeleton, motion, frames)
    out = output_folder(options.out)
    clip: list[tuple[Floats32, Floats32]] = []
    left_out = 0
    for number in track("writing splats", frames, len(frames)):
        time = number / motion.fps
        encoded = avatar.encode(motion, time)
        gaussians = avatar.posed(encoded.in_world())
        finite = are_finite(gaussians)
        left_out = max(left_out, int((~finite).sum()))
        gaussians, shade = gaussians.only(finite), _shade_in_root_frame(avatar, encoded, shader, finite)
        splats = make_splats(gaussians, _sh(options, avatar, gaussians, shade, camera_at(number, time).position))
        stored = half_turned(splats) if options.ply_axes == "3dgs" else splats
        if "ply" in formats:
            write_ply(out / f"{number:06d}.ply", stored)
        if "glb" in formats:
            write_splat_glb(out / f"{number:06d}.glb", splats, options.coding)
        if program is not None:
            _transform(program, out / f"{number:06d}", stored, formats)
        if "visionary" in formats:
            clip.append(packed(stored))
    if left_out:
        _log_notes([f"Gaussians with numbers that are not finite were left out, {left_out} of a frame at most"])
    if clip:
        write_visionary(out / "visionary.onnx", clip, motion.fps)
    files = {suffix: f"{number:06d}.{suffix}" for suffix in formats} | {"visionary": "visionary.onnx"}
    listed = ", ".join(f"{name} ({(out / files[name]).stat().st_size / 1e6:.2f} MB)" for name in formats)
    finish(out, f"{len(frames)} frames of {avatar.gaussians - left_out} Gaussians: {listed}")


def _shade_in_root_frame(
    avatar: Avatar, encoded: Encoded, shader: Shader, kept: NDArray[np.bool_]
) -> Callable[[Floats], Floats32]:
    """Radiance of the Gaussians ``kept`` [N] towards a position in the world; the player's shadow maps are in the
    root's frame.
    """
    gaussians, rotation, position = avatar.posed(encoded).only(kept), encoded.root[:3, :3], encoded.root[:3, 3]
    here = shader.in_frame(rotation)
    return lambda eye: here.shade(gaussians, rotation.T @ (eye - position))


def _sh(
    options: SplatOptions, avatar: Avatar, gaussians: Gaussians, shade: Callable[[Floats], Floats32], eye: Floats
) -> Floats:
    def stored(linear: NDArray[np.float32]) -> Floats:
        return stored_colours(gaussians, linear, options.coding, avatar.spacing)

    if options.colour == "albedo":
        return fixed_colour(stored(gaussians.albedo))
    if options.sh_degree == 0:
        return fixed_colour(stored(shade(eye)))
    return view_dependent_colour(gaussians, lambda position: stored(shade(position)), options.sh_degree)


def _transform(program: str, stem: Path, splats: Splats, formats: tuple[str, ...]) -> None:
    with temporary_folder() as folder:
        ply = folder / "splats.ply"
        write_ply(ply, splats)
        for suffix in ("spz", "sog"):
            if suffix in formats:
                transform_ply(program, ply, stem.with_suffix(f".{suffix}"))


def _mesh(options: MeshOptions) -> None:
    formats = _formats(options.format, MESH_FORMATS)
    options.refuse_unfit(formats)
    body = Body.load(options.body)
    motion = options.reading.read_motion(options.motion, body.skeleton)
    _log_notes(motion.notes)
    motion = replace(motion, rotations=share_twists(body.skeleton, motion.rotations))  # as in the avatar
    frames = parse_frames(options.frames, motion.frame_count)
    out = output_folder(options.out)
    if "glb" in formats:
        write_rigged_glb(out / "body.glb", body, motion)
        finish(out / "body.glb", f"{len(body.vertices)} vertices, {motion.duration:.1f} s of motion")
    if "obj" in formats:
        for number in track("writing meshes", frames, len(frames)):
            now = motion.at([number / motion.fps])
            vertices = posed_vertices(body, now.rotations[0], now.translations[0])
            write_obj(out / f"{number:06d}.obj", vertices, body.faces)
        finish(out, f"{len(frames)} posed meshes as obj")


def _motion(options: AmassOptions) -> None:
    check_option(options.out.suffix.lower() == ".npz", "--out", "a name in .npz", options.out)
    file = existing_file(options.skeleton, what="avatar or body")
    refuse_input(options.out, file, *motion_inputs(options.motion), options.reading.joint_map)
    skeleton = Body.load(file).skeleton if file.suffix.lower() == ".npz" else Avatar.load(file).skeleton
    motion = options.reading.read_motion(options.motion, skeleton)
    _log_notes(motion.notes)
    if options.fps is not None:
        _log_notes(motion.loop_notes(options.fps))
        motion = resampled(motion, options.fps)
    if motion.left_out:
        _log_notes([f"joints that move and the skeleton lacks are left out: {', '.join(motion.left_out)}"])
    if lost := write_amass(options.out, motion, skeleton):
        _log_notes([f"joints that SMPL-H lacks are left out: {', '.join(lost)}"])
    finish(options.out, f"{motion.frame_count} frames at {motion.fps:g} per second")


def _log_notes(notes: Iterable[str]) -> None:
    for note in notes:
        log(f"note: {note}")


def _camera_path(text: str, skeleton: Skeleton, motion: Motion, frames: range) -> CameraPath:
    if text == "front":
        return front_path(frame_motion(skeleton, motion), FRONT)
    return file_path(text, None, frames)


def _formats(text: str, known: tuple[str, ...]) -> tuple[str, ...]:
    names = {name.strip() for name in text.split(",") if name.strip()}
    if not names or names - set(known):
        raise InputError("--format", expected=f"some of {','.join(known)}", got=text or "nothing")
    return tuple(name for name in known if name in names)
