"""The work of ``rnd-convert``."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.avatar.avatar import Avatar, Encoded
from rnd_runtime.capture.body import Body
from rnd_runtime.cli.command import finish, log
from rnd_runtime.cli.progress import track
from rnd_runtime.core.errors import check_option
from rnd_runtime.core.files import existing_file, output_folder, refuse_input
from rnd_runtime.core.gaussians import Gaussians
from rnd_runtime.core.signals import temporary_folder
from rnd_runtime.motion.amass import write_amass
from rnd_runtime.motion.edit import resampled
from rnd_runtime.motion.motion import Motion, motion_inputs
from rnd_runtime.motion.skeleton import Skeleton
from rnd_runtime.playback.framing import CameraOptions as FramingOptions
from rnd_runtime.playback.framing import CameraPath, frame_motion, front_path
from rnd_runtime.shading.light import light_notes
from rnd_runtime.shading.shader import Shader
from rnd_viewer.inputs.cameras import file_path
from rnd_viewer.inputs.lights import chosen_light
from rnd_viewer.inputs.options import parse_frames

from .cameras import read_cameras, write_cameras
from .options import AmassOptions, CameraOptions, MeshOptions, Options, SplatOptions, chosen_formats
from .splat_files import splat_transform, transform_ply, write_ply, write_splat_glb
from .splats import Splats, are_finite, fixed_colour, half_turned, make_splats, stored_colours, view_dependent_colour
from .usd_files import load_usd, write_splat_usd
from .visionary import check_clip, packed, write_visionary

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]
SPLAT_FORMATS = ("ply", "glb", "spz", "sog", "visionary", "usd")
# rnd-play's front camera; only its position matters here.
FRONT = FramingOptions(512, 512)


def convert(options: Options) -> None:
    """Write the files of ``options`` and report them."""
    if isinstance(options, SplatOptions):
        _splats(options)
    elif isinstance(options, MeshOptions):
        from .mesh import convert_mesh

        convert_mesh(options)
    elif isinstance(options, CameraOptions):
        _camera(options)
    else:
        _motion(options)


def _splats(options: SplatOptions) -> None:
    formats = chosen_formats(options.format, SPLAT_FORMATS)
    options.refuse_unfit(formats)
    if "usd" in formats:
        load_usd()
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
    samples: list[Splats] = []
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
            material = gaussians if options.material else None
            write_ply(out / f"{number:06d}.ply", stored, material)
        if "glb" in formats:
            write_splat_glb(out / f"{number:06d}.glb", splats, options.coding)
        if program is not None:
            _transform(program, out / f"{number:06d}", stored, formats)
        if "visionary" in formats:
            clip.append(packed(stored))
        if "usd" in formats:
            samples.append(splats)
    if left_out:
        _log_notes([f"Gaussians with numbers that are not finite were left out, {left_out} of a frame at most"])
    if clip:
        write_visionary(out / "visionary.onnx", clip, motion.fps)
    if samples:
        write_splat_usd(out / "splats.usdc", samples, frames, motion.fps)
    files = {suffix: f"{number:06d}.{suffix}" for suffix in formats}
    files |= {"visionary": "visionary.onnx", "usd": "splats.usdc"}
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


def _camera(options: CameraOptions) -> None:
    check_option(options.out.suffix.lower() == ".json", "--out", "a name in .json", options.out)
    refuse_input(options.out, options.source)
    width, height = options.size or (1920, 1080)
    cameras = read_cameras(options.source, options.name, (width, height or width), options.fps or 30.0)
    write_cameras(options.out, cameras)
    first = cameras[0]
    finish(
        options.out,
        f"{len(cameras)} of {first.width}x{first.height}, the first at {first.position.round(3).tolist()} m",
    )


def _log_notes(notes: Iterable[str]) -> None:
    for note in notes:
        log(f"note: {note}")


def _camera_path(text: str, skeleton: Skeleton, motion: Motion, frames: range) -> CameraPath:
    if text == "front":
        return front_path(frame_motion(skeleton, motion), FRONT)
    return file_path(text, None, frames)
