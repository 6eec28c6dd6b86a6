"""The same work done by others, side by side.

Our CPU kernel, our OpenGL, a plain-torch tile rasteriser; the depth order of Gaussians that lie on an OpenGL
device by its compute shaders, and by the CPU with the way there and back; the encoders in onnxruntime, in torch as the
trainer runs them, and through torch.compile where a compiler is found.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import moderngl
import numpy as np
import torch

from rnd_bench.scenes.scenes import bench_camera
from rnd_runtime.avatar.networks import Networks
from rnd_runtime.core.camera import Camera
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.gaussians import Gaussians
from rnd_runtime.gl.context import Backend, create_context, renderer
from rnd_runtime.gl.projection import GlProjection, Sorting
from rnd_runtime.gl.surfaces import SurfaceUpload
from rnd_runtime.playback.doctor import machine
from rnd_trainer.model.checkpoint import load_checkpoint
from rnd_trainer.model.model import AvatarModel

from .clock import REPEATS, by_turns, times
from .raster import Row, Scene, bench_raster, body_scene


def bench_peers(checkpoint: Path, avatar: Path, n: int, size: int, threads: int) -> list[Row]:
    """Rows with stage, peer, ms_median, ms_p95 (or ``failed``); encoders at the nodes of ``checkpoint``."""
    rows = []
    for row in bench_raster(n, size, repeats=REPEATS, threads=threads):
        if row["pass"] == "forward":
            rows.append({"stage": "raster", "peer": row["kernel"], **row})
    return rows + depth_order(n, size, threads) + encoders(checkpoint, avatar, threads)


def depth_order(n: int, size: int, threads: int) -> list[Row]:
    """Projecting and ordering the Gaussians of ``body_scene`` on every OpenGL backend of this machine."""
    gaussians, camera = _gaussians(body_scene(n)), bench_camera(size)
    rows: list[Row] = []
    backends: tuple[Backend, ...] = ("egl", "osmesa")
    for backend in backends:
        try:
            context = create_context(backend)
        except InputError as error:
            failed = {"stage": f"projection+sort, {backend}", "peer": "compute shaders", "failed": str(error)}
            rows.append({**failed, "machine": machine()})
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

        yield peer, times(order)
        projection.release()
    upload.release()


@torch.no_grad()
def encoders(checkpoint: Path, avatar: Path, threads: int) -> list[Row]:
    """The networks at the nodes, from a pose to logits, offsets and visibility, by turns."""
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

    networks = Networks.load(avatar, threads)
    inputs = (window.numpy(), velocity.numpy(), bones.numpy())
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    peers: dict[str, Callable[[], Any]] = {
        "onnxruntime": lambda: networks.at(inputs),
        "torch eager": eager,
        "torch.compile": torch.compile(eager),
    }
    rows: dict[str, Row] = {}
    try:
        for peer, run in peers.items():
            rows[peer] = {"stage": "encoders", "peer": peer, "nodes": len(encoded), "threads": threads}
            try:
                run()
            except Exception as error:  # a compiler that is missing or too old, in its own many words
                rows[peer]["failed"] = str(error).strip().splitlines()[0][:160]
        able = [peer for peer in peers if "failed" not in rows[peer]]
        for peer, measured in zip(able, by_turns([peers[peer] for peer in able])):
            rows[peer] |= measured
    finally:
        torch.set_num_threads(before)
    return [{**row, "machine": machine()} for row in rows.values()]


def _networks(model: AvatarModel, encoded: torch.Tensor, inputs: tuple[torch.Tensor, ...]) -> Any:
    window, velocity, normals = inputs
    flat = window[-1].flatten()
    logits = model.skinning(encoded, window, velocity)
    return logits, model.offsets(encoded, flat), model.visibility(encoded, flat, normals)


def _gaussians(scene: Scene) -> Gaussians:
    """With normals, a material and some visibility."""
    count = len(scene.means)
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(count, 3))
    visibility = 0.1 * rng.normal(size=(count, 16))
    visibility[:, 0] += 2 * np.sqrt(np.pi)
    values = (
        scene.means,
        scene.covariances,
        scene.opacities,
        normals / np.linalg.norm(normals, axis=1, keepdims=True),
        scene.features,
        np.full(count, 0.6),
        visibility,
        np.eye(3),
    )
    return Gaussians(*(np.ascontiguousarray(value, np.float32) for value in values))
