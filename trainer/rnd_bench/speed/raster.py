"""Time and error of the rasterisers, of the same calls; kernels alternate, so that other load is the same for all.

*forward* renders 3 channels and alpha without autograd, *forward+backward* also the gradients of means, covariances,
opacities and features.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any, NamedTuple

import numba
import numpy as np
import torch
from torch import Tensor

from rnd_bench.scenes.body_splats import Splats, body_splats
from rnd_bench.scenes.psnr import decibels
from rnd_bench.scenes.scenes import bench_camera
from rnd_runtime.core.camera import Camera
from rnd_runtime.core.errors import InputError
from rnd_runtime.gl.raster import GlRasterizer
from rnd_runtime.playback.doctor import machine
from rnd_runtime.raster import cpu as raster_cpu
from rnd_runtime.raster import oracle as raster_oracle
from rnd_trainer.render import raster, raster_reference

from .frame import summary

Row = dict[str, Any]
WARMUP = 3


class Rendering(NamedTuple):
    image: Tensor
    alpha: Tensor
    grads: tuple[Tensor, ...] = ()


class _Case(NamedTuple):
    kernel: str
    rasterize: Callable[..., Any]
    warmup: int
    repeats: int
    incoming: tuple[Tensor, Tensor] | None = None


def bench_raster(n: int = 30_000, size: int = 512, repeats: int = 40, threads: int | None = None) -> list[Row]:
    """One row for each rasteriser and pass; the plain-torch kernel is run a tenth as often.

    psnr_db is of image and alpha against the float64 oracle, grad_rel_l2 the worst of the four gradients against the
    float64 reference.
    """
    splats, camera = body_splats(n), bench_camera(size)
    threads = threads or numba.get_num_threads()
    with _threads(threads):
        incoming = _incoming(camera, splats.features.shape[1])
        truth = raster_oracle.rasterize(*splats, camera)
        gradients = _run(raster_reference.rasterize, splats, camera, incoming, torch.float64).grads
        few = max(3, repeats // 10)
        cases = [
            case
            for wanted in (None, incoming)
            for case in (
                _Case("numba", raster.rasterize, WARMUP, repeats, wanted),
                _Case("torch tiles", raster_reference.rasterize, 1, few, wanted),
            )
        ]
        played = partial(_as_arrays, partial(raster_cpu.rasterize, depth=False))
        alone: dict[str, Callable[..., Any]] = {"numba, as played": played, **dict(_gl_rasterizers())}
        cases += [_Case(name, rasterize, WARMUP, repeats) for name, rasterize in alone.items()]
        taken: list[list[float]] = [[] for _ in cases]
        results = [Rendering(torch.empty(0), torch.empty(0))] * len(cases)
        for number in range(max(case.warmup + case.repeats for case in cases)):
            for k, case in enumerate(cases):
                if number < case.warmup + case.repeats:
                    start = time.perf_counter()
                    results[k] = _run(case.rasterize, splats, camera, case.incoming)
                    taken[k].append(1e3 * (time.perf_counter() - start))
    exact = np.dstack([truth.image, truth.alpha])
    return [
        {
            "kernel": case.kernel,
            "pass": "forward" if case.incoming is None else "forward+backward",
            "n": len(splats.means),
            "size": camera.width,
            **summary(times[case.warmup :]),
            "psnr_db": decibels(np.dstack([result.image.numpy(), result.alpha.numpy()]), exact),
            "grad_rel_l2": None if case.incoming is None else _worst(result.grads, gradients),
            "threads": threads,
            "machine": machine(),
            "warmup": case.warmup,
            "repeats": case.repeats,
        }
        for case, times, result in zip(cases, taken, results)
    ]


@contextmanager
def _threads(count: int) -> Iterator[None]:
    before = numba.get_num_threads(), torch.get_num_threads()
    numba.set_num_threads(count)
    torch.set_num_threads(count)
    try:
        yield
    finally:
        numba.set_num_threads(before[0])
        torch.set_num_threads(before[1])


def _gl_rasterizers() -> Iterator[tuple[str, Callable[..., Any]]]:
    """OpenGL on every available backend; forward only."""
    for backend in ("egl", "osmesa"):
        try:
            rasterizer = GlRasterizer(backend)
        except InputError:
            continue
        yield f"gl-{backend}", partial(_as_arrays, partial(rasterizer, depth=False))


def _as_arrays(rasterize: Callable[..., Any], *arguments: Any) -> tuple[Tensor, Tensor, None]:
    """A rasteriser of the runtime with the trainer's signature."""
    means, covariances, opacities, features = (tensor.numpy() for tensor in arguments[:4])
    found = rasterize(means, covariances, opacities, features, arguments[4])
    image, alpha = np.ascontiguousarray(found.image), np.ascontiguousarray(found.alpha)
    return torch.from_numpy(image), torch.from_numpy(alpha), None


def _incoming(camera: Camera, channels: int) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(1)
    size = camera.height, camera.width
    return torch.randn(*size, channels, generator=generator), torch.randn(size, generator=generator)


def _run(
    rasterize: Callable[..., Any],
    splats: Splats,
    camera: Camera,
    incoming: tuple[Tensor, Tensor] | None,
    dtype: torch.dtype = torch.float32,
) -> Rendering:
    arrays = [torch.from_numpy(array).to(dtype).requires_grad_(incoming is not None) for array in splats]
    with torch.set_grad_enabled(incoming is not None):
        image, alpha, _ = rasterize(*arrays, camera)
    if incoming is None:
        return Rendering(image, alpha)
    grads = torch.autograd.grad((image, alpha), arrays, tuple(grad.to(dtype) for grad in incoming))
    return Rendering(image.detach(), alpha.detach(), grads)


def _worst(grads: tuple[Tensor, ...], truth: tuple[Tensor, ...]) -> float:
    norm = torch.linalg.vector_norm
    return max(float(norm(ours.double() - theirs) / norm(theirs)) for ours, theirs in zip(grads, truth))
