"""The same work done by others, side by side, and how time grows with what there is of it.

**Peers**: our CPU kernel, our OpenGL, a plain-torch tile rasteriser; the depth order of Gaussians that lie on an OpenGL
device by its compute shaders, and by the CPU with the way there and back; the encoders in onnxruntime, in torch as the
trainer runs them, and through torch.compile where a compiler is found.

**Growth**: the exponent p of time ~ amount^p, by least squares over logarithms, and the floor at the largest amount:
the bytes that must be moved over the bandwidth measured here, or the operations over the rate measured here,
whichever is longer. A stage far above its floor spends its time on something else.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import moderngl
import numba
import numpy as np
import torch

from rnd_runtime import raster_cpu
from rnd_runtime.avatar import Avatar
from rnd_runtime.avatar_file import NODE_LOGITS, NODE_OUTPUTS
from rnd_runtime.camera import Camera
from rnd_runtime.doctor import machine
from rnd_runtime.errors import InputError
from rnd_runtime.gaussians import Gaussians
from rnd_runtime.gl_context import Backend, create_context, renderer
from rnd_runtime.light import Light
from rnd_runtime.posing import RestPose
from rnd_runtime.projection_gl import GlProjection, Sorting
from rnd_runtime.shading import Shader
from rnd_runtime.surfaces_gl import SurfaceUpload

from .bench_raster import Row, Scene, bench_raster, body_camera, body_scene
from .checkpoint import load_checkpoint
from .model import AvatarModel

REPEATS = 15
WARMUP = 2
COPIED = 64 << 20  # bytes: past every cache
MULTIPLIED = 1024  # side of the matrices that the rate is measured with


@dataclass(frozen=True)
class Amounts:
    """What is varied; the usual amounts, or fewer for a quick look."""

    gaussians: tuple[int, ...] = (4_000, 8_000, 15_000, 30_000, 60_000)
    sides: tuple[int, ...] = (256, 512, 1024)
    joints: tuple[int, ...] = (12, 24, 48)
    lights: tuple[int, ...] = (8, 32, 128)


def bench_peers(checkpoint: Path, avatar: Path, n: int, size: int, threads: int) -> list[Row]:
    """Rows with stage, peer, ms_median, ms_p95 (or ``failed``); encoders at the nodes of ``checkpoint``."""
    rows = []
    for row in bench_raster(n, size, repeats=REPEATS, threads=threads):
        if row["pass"] == "forward":
            rows.append({"stage": "raster", "peer": row["kernel"], **row})
    return rows + depth_order(n, size, threads) + encoders(checkpoint, avatar, threads)


def depth_order(n: int, size: int, threads: int) -> list[Row]:
    """Projecting and ordering the Gaussians of :func:`body_scene` on every OpenGL backend of this machine."""
    gaussians, camera, rows = _gaussians(body_scene(n)), body_camera(size), []
    backends: tuple[Backend, ...] = ("egl", "osmesa")
    for backend in backends:
        try:
            context = create_context(backend)
        except InputError:
            continue
        with context:
            known = {"n": n, "threads": threads, "renderer": renderer(context), "machine": machine()}
            for peer, measured in _orders(context, gaussians, camera):
                rows.append({"stage": f"projection+sort, {backend}", "peer": peer, **measured, **known})
        context.release()
    return rows


def _orders(context: moderngl.Context, gaussians: Gaussians, camera: Camera) -> Iterator[tuple[str, Row]]:
    """By the CPU, and by compute shaders where there are any."""
    upload = SurfaceUpload(context)
    surfaces = upload.write(gaussians)
    sorters: tuple[tuple[str, Sorting], ...] = (("the CPU", "cpu"), ("compute shaders", "device"))
    for peer, sorting in sorters:
        try:
            projection = GlProjection(context, sorting)
        except InputError as error:
            yield peer, {"failed": str(error)}
            continue

        def order(projection: GlProjection = projection) -> None:
            projection.project(surfaces, camera, None)
            context.finish()

        yield peer, _times(order)
        projection.release()
    upload.release()


@torch.no_grad()
def encoders(checkpoint: Path, avatar: Path, threads: int) -> list[Row]:
    """The networks at the nodes, from a pose to logits, offsets and visibility."""
    model = load_checkpoint(checkpoint).model
    joints, poses = model.log_weights.shape[1], model.config.window_poses
    generator = torch.Generator().manual_seed(0)
    window = torch.randn(poses, joints - 1, 6, generator=generator)
    velocity = torch.randn(joints - 1, 3, generator=generator)
    bones = torch.eye(3, 4).expand(joints, 3, 4).contiguous()
    encoded = model.encoded_nodes()
    normals = model.rest_normals[: len(encoded)]

    def eager() -> Any:
        return _networks(model, encoded, (window, velocity, normals))

    loaded = Avatar.load(avatar, threads=threads)
    inputs = (window.numpy(), velocity.numpy(), bones.numpy())
    names = (*NODE_OUTPUTS, NODE_LOGITS)
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    peers: list[tuple[str, Callable[[], Any]]] = [
        ("onnxruntime", lambda: loaded.run(inputs, names)),
        ("torch eager", eager),
        ("torch.compile", torch.compile(eager)),
    ]
    rows = []
    try:
        for peer, run in peers:
            row: Row = {"stage": "encoders", "peer": peer, "nodes": len(encoded), "threads": threads}
            try:
                row |= _times(run)
            except Exception as error:  # a compiler that is missing or too old, in its own many words
                row["failed"] = str(error).strip().splitlines()[0][:160]
            rows.append({**row, "machine": machine()})
    finally:
        torch.set_num_threads(before)
    return rows


def _networks(model: AvatarModel, encoded: torch.Tensor, inputs: tuple[torch.Tensor, ...]) -> Any:
    window, velocity, normals = inputs
    flat = window[-1].flatten()
    logits = model.skinning(encoded, window, velocity)
    return logits, model.offsets(encoded, flat), model.visibility(encoded, flat, normals)


def growth(amounts: Amounts, size: int, threads: int) -> list[Row]:
    """A row for each stage and amount: ``exponent``, ``ms`` at each of ``amounts``, ``floor_ms`` at the last."""
    before = numba.get_num_threads()
    numba.set_num_threads(threads)
    try:
        bandwidth, rate = measured_bandwidth(), measured_rate()
        n, camera = amounts.gaussians[-2], body_camera(size)
        scenes = {count: body_scene(count) for count in {*amounts.gaussians, n}}
        lit = {count: _gaussians(scene) for count, scene in scenes.items()}
        light = Light(np.random.default_rng(0).uniform(0.1, 1, (32, 64, 3)).astype(np.float32))
        table, suns = Shader(light, "table"), {k: Shader(light, f"lights:{k}") for k in amounts.lights}
        rests = {j: _rest(n, j) for j in amounts.joints}

        def draw(scene: Scene, side: int) -> Callable[[], Any]:
            view = camera.resized(side, side)
            return lambda: raster_cpu.rasterize(*scene, view, depth=False)

        cases: list[tuple[str, str, Sequence[int], Callable[[int], Callable[[], Any]], Callable[[int], float]]] = [
            ("raster", "Gaussians", amounts.gaussians, lambda a: draw(scenes[a], size),
             lambda a: (52 * a + 16 * size**2) / bandwidth),
            ("raster", "picture side", amounts.sides, lambda a: draw(scenes[n], a),
             lambda a: (52 * n + 16 * a**2) / bandwidth),
            ("shading, table", "Gaussians", amounts.gaussians,
             lambda a: lambda: table.shade(lit[a], camera.position), lambda a: 116 * a / bandwidth),
            ("shading, lights", "lights", amounts.lights,
             lambda a: lambda: suns[a].shade(lit[n], camera.position),
             lambda a: max(116 * n / bandwidth, 90 * n * a / rate)),
            ("posing", "joints", amounts.joints,
             lambda a: lambda: rests[a][0].pose(*rests[a][1:]),
             lambda a: max((4 * n * (a + 58) + 4 * (n // 4) * (a + 22)) / bandwidth, n * (34 * a + 600) / rate)),
        ]  # fmt: skip
        rows = []
        for stage, what, values, make, floor in cases:
            milliseconds = [_times(make(value))["ms_median"] for value in values]
            exponent = float(np.polyfit(np.log(values), np.log(milliseconds), 1)[0])
            rows.append({
                "stage": stage, "of": what, "amounts": list(values), "ms": milliseconds, "exponent": exponent,
                "floor_ms": 1e3 * floor(values[-1]), "bandwidth_gb_s": bandwidth / 1e9, "rate_gflop_s": rate / 1e9,
                "threads": threads, "machine": machine(),
            })  # fmt: skip
        return rows
    finally:
        numba.set_num_threads(before)


def measured_bandwidth() -> float:
    """Bytes read and written per second by a copy that no cache holds, on all threads."""
    source, target = torch.ones(COPIED // 4), torch.empty(COPIED // 4)
    return 2e3 * COPIED / _times(lambda: target.copy_(source))["ms_min"]


def measured_rate() -> float:
    """float32 operations per second of a large matrix product, on all threads."""
    a = torch.ones(MULTIPLIED, MULTIPLIED)
    return 2e3 * MULTIPLIED**3 / _times(lambda: a @ a)["ms_min"]


def _times(run: Callable[[], Any]) -> Row:
    taken = []
    for _ in range(WARMUP + REPEATS):
        start = perf_counter()
        run()
        taken.append(1e3 * (perf_counter() - start))
    timed = taken[WARMUP:]
    return {
        "ms_median": float(np.median(timed)), "ms_p95": float(np.percentile(timed, 95)), "ms_min": float(np.min(timed)),
    }  # fmt: skip


def _gaussians(scene: Scene) -> Gaussians:
    """With normals, a material and some visibility."""
    count = len(scene.means)
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(count, 3))
    visibility = 0.1 * rng.normal(size=(count, 16))
    visibility[:, 0] += 2 * np.sqrt(np.pi)
    values = (
        scene.means, scene.covariances, scene.opacities, normals / np.linalg.norm(normals, axis=1, keepdims=True),
        scene.features, np.full(count, 0.6), visibility, np.eye(3),
    )  # fmt: skip
    return Gaussians(*(np.ascontiguousarray(value, np.float32) for value in values))


def _rest(count: int, joints: int) -> tuple[Any, ...]:
    """A rest pose of any number of joints, with node fields and bones, as :meth:`RestPose.pose` takes them."""
    rng = np.random.default_rng(0)
    nodes = count // 4

    def normal(*shape: int) -> Any:
        return rng.normal(size=shape).astype(np.float32)

    neighbours = rng.integers(0, nodes, (count, 4)).astype(np.int32)
    rest = RestPose(
        neighbours, np.full((count, 4), 0.25, np.float32), normal(count, joints), normal(count, 3),
        0.01 * normal(count, 9), normal(count, 3), normal(count, 7), 0.06, 1e-8, 1e-3,
    )  # fmt: skip
    bones = np.tile(np.eye(3, 4, dtype=np.float32), (joints, 1, 1))
    return rest, normal(nodes, joints), normal(nodes, 6), normal(nodes, 16), bones
