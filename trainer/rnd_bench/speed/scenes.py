"""Scenes: what a coarser level of detail costs and saves by height in pixels, and the time of a crowd by its number."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from time import perf_counter, process_time
from typing import Any

import numpy as np

from rnd_bench.speed.frame import STEP_S, STEP_YAW, WARMUP, summary
from rnd_bench.speed.roofline import machine_limits, roofline_rows
from rnd_runtime.avatar.avatar import Avatar
from rnd_runtime.core.camera import Camera
from rnd_runtime.motion.motion import Motion, load_motion
from rnd_runtime.playback.frame import FrameRenderer, RenderedFrame
from rnd_runtime.playback.framing import CameraOptions, front_path
from rnd_runtime.playback.scene import Person, SceneRenderer, chosen_levels, frame_people, greatest_sizes, place_at
from rnd_runtime.shading.files.load import load_light
from rnd_runtime.shading.light import Light

HEIGHT = 1.75  # m, of a person
FOCAL = 4000.0  # px
BOX = 1.3  # heights, side of an image around a person
HEIGHTS = (384, 192, 96, 64, 48, 32, 24, 16, 12)  # px
VIEWS = ((0.3, 0.3), (1.1, 2.1), (2.0, 4.0))  # time of the motion, s, and azimuth, rad
SIZE = (1280, 720)
CROWDS = {1: None, 10: None, 50: 100.0}
"""numbers of people, and the height in pixels of those in the middle; None for a camera as near as shows all"""
APART = 1.2  # m between neighbours of a crowd


def bench_scenes(
    avatar_file: Path, motion_file: Path, light_file: Path, repeats: int, on_row: Callable[[str, dict[str, Any]], None]
) -> None:
    """Call ``on_row`` with the kind and the row of each switch of neighbouring levels, each height, the machine's
    limits, and each crowd and its stages against these limits."""
    avatar = Avatar.load(avatar_file)
    motion, light = load_motion(motion_file, avatar.skeleton), load_light(light_file)
    scene = SceneRenderer([Person(avatar, motion)], FrameRenderer(avatar, light))
    for number, size in enumerate(greatest_sizes(avatar)[1:].tolist(), 1):
        on_row("switches", _switch_row(scene, number, size * HEIGHT))
    for pixels in HEIGHTS:
        on_row("heights", _height_row(scene, pixels, repeats))
    limits = machine_limits()
    on_row("limits", limits)
    for count, height in CROWDS.items():
        crowd, *stages = _crowd_rows(avatar, count, height, motion, light, repeats, limits)
        on_row("crowds", crowd)
        for row in stages:
            on_row("roofline", row)


def camera_of(pixels: float, azimuth: float) -> Camera:
    """Sees a standing person ``pixels`` high, from a little above."""
    side, distance = round(BOX * pixels) + 2, FOCAL * HEIGHT / pixels
    eye = [distance * np.sin(azimuth), 0.9 + 0.1 * distance, distance * np.cos(azimuth)]
    around = Camera.look_at(eye, [0, 0.9, 0], width=side, height=side, fov_y=0.5)
    K = np.array([[FOCAL, 0, side / 2], [0, FOCAL, side / 2], [0, 0, 1]])
    return Camera(side, side, K, around.world_to_camera)


def _at(avatar: Avatar, number: int) -> Avatar:
    level = avatar.level(number)
    assert level is not None
    return level


def _frames(scene: SceneRenderer, level: int, pixels: float) -> list[RenderedFrame]:
    """Of a lone person in every one of ``VIEWS``."""
    return [scene.draw(scene.encode(time, [level]), camera_of(pixels, azimuth)) for time, azimuth in VIEWS]


def _difference(ours: Sequence[RenderedFrame], others: Sequence[RenderedFrame]) -> float:
    """Root mean square, of sRGB from 0 to 255, over whole images."""
    squares = [np.mean((a.srgb.astype(float) - b.srgb) ** 2) for a, b in zip(ours, others)]
    return float(np.sqrt(np.mean(squares)))


def _switch_row(scene: SceneRenderer, number: int, pixels: float) -> dict[str, Any]:
    """A level at the greatest height where it is taken, against the finer one and the whole."""
    avatar = scene.people[0].avatar
    level = _at(avatar, number)
    ours, others, whole = (_frames(scene, each, pixels) for each in (number, number - 1, 0))
    coverage = sum(float(frame.alpha.sum()) for frame in ours) / sum(float(frame.alpha.sum()) for frame in whole)
    return {
        "gaussians": level.gaussians,
        "nodes": level.nodes,
        "cull": level.advice.cull,
        "of": avatar.gaussians,
        "pixels": pixels,
        "rms_to_finer": _difference(ours, others),
        "rms_to_whole": _difference(ours, whole),
        "coverage": coverage,
    }


def _height_row(scene: SceneRenderer, pixels: int, repeats: int) -> dict[str, Any]:
    """The level that a person of ``pixels`` height gets, and the whole avatar."""
    avatar = scene.people[0].avatar
    number = int(chosen_levels(np.array([pixels / HEIGHT]), greatest_sizes(avatar))[0])
    ours, whole = (_frames(scene, each, pixels) for each in (number, 0))
    row = {"pixels": pixels, "gaussians": _at(avatar, number).gaussians, "rms_to_whole": _difference(ours, whole)}
    camera = camera_of(pixels, VIEWS[0][1])
    for name, level in {"": number, "whole_": 0}.items():

        def draw(frame: int, level: int = level) -> None:
            scene.renderer.turn(STEP_YAW * frame)
            scene.draw(scene.encode(STEP_S * frame, [level]), camera)

        row |= {name + key: value for key, value in _timed(draw, repeats).items()}
    return row


def _crowd_rows(
    avatar: Avatar,
    count: int,
    pixels: float | None,
    motion: Motion,
    light: Light,
    repeats: int,
    limits: Mapping[str, float],
) -> list[dict[str, Any]]:
    """``count`` people on a grid, all in view; motion and light change from frame to frame. Then its ``roofline``."""
    columns = int(np.ceil(np.sqrt(2 * count)))
    spots = [(APART * (k % columns), -APART * (k // columns)) for k in range(count)]
    people = [Person(avatar, motion, -0.17 * k, place_at(*spot, 0.7 * k)) for k, spot in enumerate(spots)]
    view = CameraOptions(*SIZE)
    if pixels is not None:
        view = replace(view, distance=SIZE[1] / 2 / np.tan(view.fov_y / 2) * HEIGHT / pixels)
    path = front_path(frame_people(people), view)
    renderer = FrameRenderer(avatar, light)
    scene = SceneRenderer(people, renderer)
    levels = scene.levels(WARMUP + repeats, 1 / STEP_S, path)
    stages: dict[str, list[float]] = {}

    def draw(number: int) -> None:
        started = perf_counter()
        bodies = scene.encode(STEP_S * number, levels[number].tolist())
        renderer.turn(STEP_YAW * number)
        spent = {"encoders": perf_counter() - started}
        frame = scene.draw(bodies, path(number, STEP_S * number))
        for stage, seconds in (spent | dict(frame.stage_seconds)).items():
            stages.setdefault(stage, []).append(1e3 * seconds)

    taken = _timed(draw, repeats)
    camera = path(0, 0.0)
    depths = np.array([(camera.world_to_camera @ [*person.positions(np.zeros(1))[0], 1])[2] for person in people])
    medians = {name: float(np.median(values[WARMUP:])) for name, values in stages.items()}
    crowd = {
        "people": count,
        "size": list(SIZE),
        "pixels": float(np.median(camera.K[0, 0] * HEIGHT / depths)),
        "gaussians": int(sum(_at(avatar, level).gaussians for level in levels[-1].tolist())),
        **taken,
        "stages": medians,
    }
    bodies = scene.encode(0.0, levels[0].tolist())
    roofline = roofline_rows(bodies, camera, medians, limits)
    return [crowd, *({"people": count, **row} for row in roofline)]


def _timed(draw: Callable[[int], None], repeats: int) -> dict[str, float]:
    """Milliseconds of ``repeats`` consecutive frames, after some to warm up: elapsed, and of all threads' CPU."""
    taken, spent = [], []
    for number in range(WARMUP + repeats):
        started, busy = perf_counter(), process_time()
        draw(number)
        taken.append(1e3 * (perf_counter() - started))
        spent.append(1e3 * (process_time() - busy))
    return summary(taken[WARMUP:]) | {"cpu_ms_median": float(np.median(spent[WARMUP:])), "load": os.getloadavg()[0]}
