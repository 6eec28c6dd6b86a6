"""What ``rnd-convert`` does with its options."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.avatar.avatar import Avatar, Encoded
from rnd_runtime.capture.body import Body, posed_vertices
from rnd_runtime.core.errors import InputError, check_option, refuse_outside
from rnd_runtime.core.files import existing_file, output_folder, refuse_input
from rnd_runtime.core.gaussians import Gaussians
from rnd_runtime.motion.amass import write_amass
from rnd_runtime.motion.motion import Motion, motion_inputs
from rnd_runtime.motion.skeleton import Skeleton
from rnd_runtime.playback.framing import CameraOptions, CameraPath, frame_motion, front_path
from rnd_runtime.posing.forearm import share_twists
from rnd_runtime.shading.light import Light, light_notes
from rnd_runtime.shading.shader import Shader
from rnd_viewer.inputs.cameras import file_path
from rnd_viewer.inputs.lights import chosen_light
from rnd_viewer.inputs.options import parse_frames

from .cli import AmassOptions, MeshOptions, Options, SplatOptions
from .mesh_files import write_obj, write_rigged_glb
from .splat_files import splat_transform, transform_ply, write_ply, write_splat_glb
from .splats import Splats, are_finite, fixed_colour, make_splats, stored_colours, turned_over, view_dependent_colour
from .visionary import check_clip, packed, write_visionary

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]
SPLAT_FORMATS, MESH_FORMATS = ("ply", "glb", "spz", "sog", "visionary"), ("glb", "obj")
# The front camera of rnd-play; only where it stands matters here.
FRONT = CameraOptions(512, 512)


def convert(options: Options) -> Iterator[str]:
    """Write what ``options`` ask for; yields one line for the user about each kind of file written.

    Raises:
        InputError: for whatever cannot be used; what was finished before stays.
    """
    if isinstance(options, SplatOptions):
        return _splats(options)
    if isinstance(options, MeshOptions):
        return _mesh(options)
    return _motion(options)


def _splats(options: SplatOptions) -> Iterator[str]:
    formats = _formats(options.format, SPLAT_FORMATS)
    options.refuse_unfit(formats)
    program = splat_transform() if {"spz", "sog"} & set(formats) else None
    avatar = Avatar.load(options.avatar)
    motion = options.read_motion(options.motion, avatar.skeleton)
    yield from _notes(motion.notes)
    frames = parse_frames(options.frames, motion.frame_count)
    if "visionary" in formats:
        check_clip(len(frames), avatar.gaussians)
    light = _light(options, avatar)
    if options.colour == "lit":
        yield from _notes(light_notes(light))
    shader = Shader(light, mode=options.shade)
    camera_at = _camera_path(options.camera, avatar.skeleton, motion, frames)
    out = output_folder(options.out)
    clip: list[tuple[Floats32, Floats32]] = []  # no more of a frame than the file holds
    left_out = 0
    for number in frames:
        encoded = avatar.encode(motion, number / motion.fps)
        gaussians = avatar.posed(encoded.in_world())
        finite = are_finite(gaussians)
        left_out = max(left_out, int((~finite).sum()))
        gaussians, lit = gaussians.only(finite), _lit_as_played(avatar, encoded, shader, finite)
        eye = camera_at(number, number / motion.fps).position
        splats = make_splats(gaussians, _harmonics(options, avatar, gaussians, lit, eye))
        stored = turned_over(splats) if options.ply_axes == "3dgs" else splats
        if "ply" in formats:
            write_ply(out / f"{number:06d}.ply", stored)
        if "glb" in formats:
            write_splat_glb(out / f"{number:06d}.glb", splats, options.coding)
        if program is not None:
            _transformed(program, out / f"{number:06d}", stored, formats)
        if "visionary" in formats:
            clip.append(packed(stored))
    if left_out:
        yield from _notes([f"Gaussians with numbers that are not finite were left out, {left_out} of a frame at most"])
    if clip:
        write_visionary(out / "visionary.onnx", clip, motion.fps)
    files = {suffix: f"{number:06d}.{suffix}" for suffix in formats} | {"visionary": "visionary.onnx"}
    listed = ", ".join(f"{name} ({(out / files[name]).stat().st_size / 1e6:.2f} MB)" for name in formats)
    yield f"{len(frames)} frames of {avatar.gaussians - left_out} Gaussians in {out}: {listed}"


def _lit_as_played(
    avatar: Avatar, encoded: Encoded, shader: Shader, kept: NDArray[np.bool_]
) -> Callable[[Floats], Floats32]:
    """Radiance of the Gaussians ``kept`` [N] towards a place in the world; shaded in the root's frame, where the
    player's shadow maps lie.
    """
    gaussians, turn, place = avatar.posed(encoded).only(kept), encoded.root[:3, :3], encoded.root[:3, 3]
    here = shader.in_frame(turn)
    return lambda eye: here.shade(gaussians, turn.T @ (eye - place))


def _harmonics(
    options: SplatOptions, avatar: Avatar, gaussians: Gaussians, lit: Callable[[Floats], Floats32], eye: Floats
) -> Floats:
    def stored(linear: NDArray[np.float32]) -> Floats:
        return stored_colours(gaussians, linear, options.coding, avatar.spacing)

    if options.colour == "albedo":
        return fixed_colour(stored(gaussians.albedo))
    if options.sh_degree == 0:
        return fixed_colour(stored(lit(eye)))
    return view_dependent_colour(gaussians, lambda position: stored(lit(position)), options.sh_degree)


def _transformed(program: str, stem: Path, splats: Splats, formats: tuple[str, ...]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        ply = Path(folder) / "splats.ply"
        write_ply(ply, splats)
        for suffix in ("spz", "sog"):
            if suffix in formats:
                transform_ply(program, ply, stem.with_suffix(f".{suffix}"))


def _mesh(options: MeshOptions) -> Iterator[str]:
    formats = _formats(options.format, MESH_FORMATS)
    options.refuse_unfit(formats)
    body = Body.load(options.body)
    motion = options.read_motion(options.motion, body.skeleton)
    yield from _notes(motion.notes)
    shared = share_twists(body.skeleton, motion.rotations)  # as in pictures of an avatar
    motion = replace(motion, rotations=shared)
    frames = parse_frames(options.frames, motion.frame_count)
    out = output_folder(options.out)
    if "glb" in formats:
        write_rigged_glb(out / "body.glb", body, motion)
        yield f"{out / 'body.glb'}: {len(body.vertices)} vertices, {motion.duration:.1f} s of motion"
    if "obj" in formats:
        for number in frames:
            now = motion.at([number / motion.fps])
            vertices = posed_vertices(body, now.rotations[0], now.translations[0])
            write_obj(out / f"{number:06d}.obj", vertices, body.faces)
        yield f"{len(frames)} posed meshes as obj in {out}"


def _motion(options: AmassOptions) -> Iterator[str]:
    check_option(options.out.suffix.lower() == ".npz", "--out", "a name in .npz", options.out)
    file = existing_file(options.skeleton, what="avatar or body")
    refuse_input(options.out, file, *motion_inputs(options.motion), options.joint_map)
    skeleton = Body.load(file).skeleton if file.suffix.lower() == ".npz" else Avatar.load(file).skeleton
    motion = options.read_motion(options.motion, skeleton)
    yield from _notes(motion.notes)
    if motion.left_out:
        yield f"joints that turn and the skeleton lacks are left out: {', '.join(motion.left_out)}"
    lost = write_amass(options.out, motion, skeleton)
    if lost:
        yield f"joints that SMPL-H lacks were left out: {', '.join(lost)}"
    yield f"{options.out}: {motion.frame_count} frames at {motion.fps:g} per second"


def _notes(notes: Iterable[str]) -> Iterator[str]:
    return (f"note: {note}" for note in notes)


def _light(options: SplatOptions, avatar: Avatar) -> Light:
    refuse_outside(options, {"exposure": (-30, 30), "hdr_yaw": (-1e6, 1e6)})
    return chosen_light(avatar, options.hdr, up=options.hdr_up, yaw=options.hdr_yaw, exposure=options.exposure)


def _camera_path(text: str, skeleton: Skeleton, motion: Motion, frames: range) -> CameraPath:
    if text == "front":
        return front_path(frame_motion(skeleton, motion), FRONT)
    return file_path(text, None, frames)


def _formats(text: str, known: tuple[str, ...]) -> tuple[str, ...]:
    names = {name.strip() for name in text.split(",") if name.strip()}
    if not names or names - set(known):
        raise InputError("--format", expected=f"some of {','.join(known)}", got=text or "nothing")
    return tuple(name for name in known if name in names)
