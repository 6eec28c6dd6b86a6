"""One run of ``rnd-play``: from options to files."""

from __future__ import annotations

import math
from dataclasses import asdict
from pathlib import Path
from time import perf_counter

import numpy as np

from rnd_runtime import __version__
from rnd_runtime.avatar import Avatar, Encoded
from rnd_runtime.camera import Camera
from rnd_runtime.errors import InputError
from rnd_runtime.files import is_folder, output_folder
from rnd_runtime.light import Light, load_light
from rnd_runtime.motion import motion_inputs
from rnd_runtime.raster import make_rasterizer
from rnd_runtime.shading import Shader
from rnd_runtime.threads import set_threads

from .aov import parse_aovs
from .background import Background
from .cameras import (
    CameraPath,
    Framing,
    View,
    file_path,
    frame_motion,
    front_path,
    orbit_path,
    split_camera,
)
from .governor import FULL, Governor, Quality
from .options import OWN_CAMERAS, PlayOptions, parse_frames, parse_size
from .pipeline import run
from .player import Frame, Player
from .report import FRAME, LATENCY, print_summary, warn, with_progress
from .run_folder import claim, part_name
from .timing import StageTimes
from .writers import frame_writer, parse_formats, tone_map_for, write_report

DEFAULT_SIZE = 512
OWN_TO_A_PROCESS = (
    "frames",
    "threads",
    "format",
    "pipeline",
)  # options that do not tell one run from another
DIM = 1e-3  # largest radiance below which every 8-bit pixel of a body would be black or next to it


def play(options: PlayOptions) -> int:
    """Render the run that ``options`` describe into ``options.out`` and print a summary.

    Raises:
        InputError: for whatever cannot be used; what was finished before stays.
    """
    avatar_file, motion_file, out = _required(options)
    background, aovs = Background.parse(options.background), parse_aovs(options.aov)
    formats, size = parse_formats(options.format), parse_size(options.size)
    set_threads(options.threads)

    times = StageTimes()
    with times.stage("load"):
        avatar = Avatar.load(avatar_file, threads=options.threads)
        motion = options.read_motion(motion_file, avatar.skeleton)
        light = _light(options, avatar)
        shader = Shader(light, mode=options.shade)
        rasterizer = make_rasterizer(options.raster)
    player = Player(avatar, light, shader, rasterizer, background, aovs, times)

    fps = options.fps or motion.fps
    count = motion.frames_at(fps)
    frames = parse_frames(options.frames, count)
    framing = frame_motion(avatar.skeleton, motion)
    camera_at = _camera_path(options, size, framing, frames)
    notes = [*motion.notes, *_light_notes(light)]
    for note in notes:
        warn(note)

    governor = Governor(options.fps_floor) if options.fps_floor else None
    qualities: list[Quality] = []
    in_view = False

    def encode(number: int) -> tuple[float, float, Encoded]:
        started = perf_counter()
        encoded = player.encode(motion, number / fps)
        return started, perf_counter() - started, encoded

    def draw(number: int, turn: tuple[float, float, Encoded]) -> tuple[Frame, Camera]:
        nonlocal in_view
        asked, encoding, encoded = turn
        started = perf_counter()
        camera = camera_at(number, number / fps)
        if options.hdr_turn:
            player.turn(light.yaw + math.tau * number / fps / options.hdr_turn)
        qualities.append(governor.quality if governor else FULL)
        frame = player.draw(encoded, camera, qualities[-1])
        in_view = in_view or bool(frame.alpha.any())
        if number == 0 and not in_view:
            raise _out_of_view(framing, camera, number)
        with times.stage("tonemap"):
            tone_map_for(formats, frame)
        now = perf_counter()
        times.add(LATENCY, now - asked)
        if governor:
            drawing = now - started
            governor.observe(max(encoding, drawing) if options.pipeline else encoding + drawing)
        return frame, camera

    name = part_name("play", frames, count)
    common = {key: value for key, value in _settings(options).items() if key not in OWN_TO_A_PROCESS}
    inputs = _inputs(options)
    with rasterizer, frame_writer(out, formats, name=name, fps=fps, times=times) as write:
        started = before = perf_counter()

        def put(number: int, drawn: tuple[Frame, Camera]) -> None:
            if number == frames.start:  # not before: what fails at once leaves the folder as it was
                claim(out, common, inputs)
            write(number, drawn[0], _reach(framing, drawn[1]))

        for _ in with_progress(frames, run(frames, encode, draw, put, overlap=options.pipeline)):
            now = perf_counter()
            times.add(FRAME, now - before)
            before = now
    seconds = perf_counter() - started

    if lowered := sum(quality != FULL for quality in qualities):
        notes.append(
            f"{lowered} of {len(frames)} frames at less than full quality, for {options.fps_floor:g} frames/s"
        )
        warn(notes[-1])
    if not in_view:
        notes.append("nothing of the avatar is in view in any of these frames")
        warn(notes[-1])
    camera = camera_at(frames.stop - 1, (frames.stop - 1) / fps)
    summary = times.summary()
    report = {
        "version": __version__,
        "settings": _settings(options),
        "frames": [frames.start, frames.stop],
        "fps": fps,
        "size": [camera.width, camera.height],
        "raster": rasterizer.name,
        "light": {"maximum": light.maximum, "repaired_texels": light.repaired},
        "notes": notes,
        "times": summary,
    }
    write_report(out / f"{name}.json", report)
    rate = len(frames) / seconds
    headline = f"{len(frames)} frames of {camera.width}x{camera.height}, {rate:.1f} frames/s"
    print_summary(summary, headline=f"{headline} ({rasterizer.name}, {options.shade}) in {out}")
    return 0


def _settings(options: PlayOptions) -> dict[str, object]:
    """The options as JSON has them, without the folder: two runs into two folders give the same report."""
    values = {
        name: str(value) if isinstance(value, Path) else value for name, value in asdict(options).items()
    }
    return {name: value for name, value in values.items() if name not in ("out", "doctor")}


def _required(options: PlayOptions) -> tuple[Path, Path, Path]:
    """The three files without which there is nothing to play."""
    given = {"AVATAR.onnx": options.avatar, "--motion": options.motion, "--out": options.out}
    if missing := [name for name, value in given.items() if value is None]:
        raise InputError(
            f"missing {', '.join(missing)}", hint="rnd-play AVATAR.onnx --motion FILE --out FOLDER"
        )
    assert options.avatar and options.motion and options.out
    if is_folder(options.motion) and options.out.resolve() == options.motion.resolve():
        raise InputError("--out", expected="another folder than the motion's", got=options.out)
    return options.avatar, options.motion, output_folder(options.out)


def _inputs(options: PlayOptions) -> list[Path]:
    """Every file that the pictures are made from."""
    given = [options.avatar, options.hdr, options.joint_map]
    if options.motion:
        given += motion_inputs(options.motion)
    if options.camera not in OWN_CAMERAS:
        given.append(split_camera(options.camera)[0])
    return [path for path in given if path is not None]


def _light(options: PlayOptions, avatar: Avatar) -> Light:
    """The light named by ``--hdr``, or the one that was learnt with the avatar."""
    yaw = math.radians(options.hdr_yaw)
    if options.hdr is None:
        return Light(avatar.trained_light).scaled(2.0**options.exposure).turned(yaw)
    return load_light(options.hdr, up=options.hdr_up, yaw=yaw, exposure=options.exposure)


def _light_notes(light: Light) -> list[str]:
    notes = []
    if light.repaired:
        notes.append(
            f"{light.repaired} texels of the light were NaN, infinite or negative and were filled in"
        )
    if light.maximum < DIM:
        notes.append(f"the light is dark: its largest radiance is {light.maximum:.3g}; try --exposure")
    return notes


def _camera_path(
    options: PlayOptions, size: tuple[int, int | None] | None, framing: Framing, frames: range
) -> CameraPath:
    if options.camera not in OWN_CAMERAS:
        return file_path(options.camera, size, frames)
    width, height = size or (DEFAULT_SIZE, None)
    view = View(
        width, height or width, math.radians(options.fov), math.radians(options.elevation), options.distance
    )
    if options.camera == "orbit":
        return orbit_path(framing, view, options.orbit_seconds)
    return front_path(framing, view)


def _reach(framing: Framing, camera: Camera) -> tuple[float, float]:
    """Nearest and farthest depth in metres at which ``camera`` can see the body at any time."""
    depth = float((camera.world_to_camera @ [*framing.centre, 1.0])[2])
    return max(depth - framing.radius, 0.0), depth + framing.radius


def _out_of_view(framing: Framing, camera: Camera, number: int) -> InputError:
    centre = (camera.world_to_camera @ [*framing.centre, 1.0])[:3]
    return InputError(
        "nothing of the avatar is in view in the first frame",
        got=f"a motion about {np.round(centre, 2).tolist()} m right of, below and in front of the camera",
        frame=number,
        hint="check --camera, --distance and --motion-up",
    )
