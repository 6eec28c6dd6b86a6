"""How near the stages of a crowd's frame are to what the machine can do: its copying and its multiply-adds.

The least time of a stage is that of moving its arrays once, read and written, or of its arithmetic, whichever is longer
(Williams et al. 2009). Tables and images that stay in the caches count for nothing.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from time import perf_counter
from typing import Any

import numba
import numpy as np
import onnx

from rnd_runtime.avatar.avatar import Avatar, Encoded
from rnd_runtime.core.camera import Camera
from rnd_runtime.raster.blend import LOG2_ALPHA_MIN
from rnd_runtime.raster.in_view import visible_to
from rnd_runtime.raster.project import pinhole, project

COPIED = 1 << 26
"""float32 numbers that are copied: 256 MB, more than caches hold"""
CHAINS, ROUNDS = 8 * 16, 200_000
"""independent sums of a thread, in registers, and multiply-adds of each"""
REPEATS = 5
BLEND_FLOPS = 26.0
"""of a pixel of a splat: 9 for the exponent, 9 for exp2 and its bounds, 8 for transmittance and three channels"""
SORT_PASSES, SORT_BYTES = 3, 16.0
"""passes of the radix sort, and bytes that a key and its index are read and written as"""


def machine_limits() -> dict[str, float]:
    """Bytes/s of copying memory and float32 operations/s of multiply-adds, of all threads; the best of REPEATS."""
    source, target = np.ones(COPIED, np.float32), np.zeros(COPIED, np.float32)
    copying, adding = [], []
    _add(1, 1.0)
    for _ in range(REPEATS):
        started = perf_counter()
        _copy(source, target)
        copied = perf_counter()
        _add(ROUNDS, 0.999)
        copying.append(copied - started)
        adding.append(perf_counter() - copied)
    flops = 2.0 * CHAINS * ROUNDS * numba.get_num_threads()
    return {"bytes_per_s": 2 * source.nbytes / min(copying), "flops_per_s": flops / min(adding)}


@numba.njit(parallel=True, cache=True)
def _copy(source, target):
    for i in numba.prange(len(source)):
        target[i] = source[i]


@numba.njit(parallel=True, fastmath=True)
def _add(rounds, factor):
    threads = numba.get_num_threads()
    sums = np.ones((threads, CHAINS), np.float32)
    scale, shift = np.float32(factor), np.float32(1)
    for thread in numba.prange(threads):
        mine = np.ones(CHAINS, np.float32)
        for _ in range(rounds):
            for k in range(CHAINS):
                mine[k] = mine[k] * scale + shift
        sums[thread] = mine
    return sums


def roofline_rows(
    bodies: Sequence[Encoded], camera: Camera, stages: Mapping[str, float], limits: Mapping[str, float]
) -> list[dict[str, Any]]:
    """A row for each stage of a frame of ``bodies`` that took so many ms, "encoders" among them."""
    moved, flops = dict.fromkeys(stages, 0.0), dict.fromkeys(stages, 0.0)
    networks: dict[int, float] = {}
    for body in bodies:
        avatar = body.avatar
        if id(avatar) not in networks:
            networks[id(avatar)] = network_flops(avatar)
        flops["encoders"] += networks[id(avatar)]
        unposed, gaussians, view = avatar.unposed(body), avatar.posed(body), camera.in_frame(body.root)
        assert unposed is not None
        rest = [value for value in vars(unposed.rest).values() if isinstance(value, np.ndarray)]
        posed = gaussians.means, gaussians.covariances, gaussians.normals, gaussians.visibility
        moved["posing"] += sum(array.nbytes for array in (*rest, *posed))
        seen = visible_to(gaussians, view, avatar.advice.cull)
        lit = gaussians.means, gaussians.normals, gaussians.visibility, gaussians.albedo, gaussians.roughness
        radiance = gaussians.albedo  # as large as it
        moved["shading"] += float(seen.mean()) * sum(array.nbytes for array in (*lit, radiance))
        splatted = gaussians.means, gaussians.covariances, gaussians.opacities, radiance
        centers, shapes, boxes, _, depths, slots = project(*splatted, seen, pinhole(view), False)
        written = centers, shapes, boxes, depths
        moved["projection"] += float(seen.mean()) * sum(array.nbytes for array in (*splatted, *written))
        drawn = shapes[np.diff(slots) > 0].astype(np.float64)
        moved["sort"] += SORT_BYTES * (SORT_PASSES * len(drawn) + float(slots[-1]))
        areas = math.pi * (drawn[:, 3] - LOG2_ALPHA_MIN) / np.sqrt(drawn[:, 1] * drawn[:, 2])
        flops["raster"] += BLEND_FLOPS * float(areas.sum())
    rows = []
    for stage, taken in stages.items():
        least = 1e3 * max(moved[stage] / limits["bytes_per_s"], flops[stage] / limits["flops_per_s"])
        if least > 0:
            sizes = {"megabytes": moved[stage] / 1e6, "mflop": flops[stage] / 1e6}
            rows.append({"stage": stage, **sizes, "ms_least": least, "ms": taken})
    return rows


def network_flops(avatar: Avatar) -> float:
    """Operations of the matrix products that depend on the pose, of an avatar's networks."""
    networks, total = avatar._networks, 0.0
    for outputs in networks._parts:
        model = onnx.shape_inference.infer_shapes(
            onnx.load_from_string(networks._file.extract(outputs, networks._rows))
        )
        graph = model.graph
        sizes = {
            value.name: [d.dim_value for d in value.type.tensor_type.shape.dim]
            for value in (*graph.input, *graph.value_info, *graph.output)
        }
        sizes |= {constant.name: list(constant.dims) for constant in graph.initializer}
        of_pose = {value.name for value in graph.input}
        for node in graph.node:
            if of_pose.intersection(node.input):
                of_pose.update(node.output)
                if node.op_type in ("MatMul", "Gemm"):
                    total += 2.0 * math.prod(sizes[node.output[0]]) * sizes[node.input[0]][-1]
    return total
