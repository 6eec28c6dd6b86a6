"""Time and error of the rasterisers, of the same calls, in one run.

**The scene** (``body_scene``): N Gaussians spread evenly over a person 1.75 m tall in an A pose, a union of
capsules seen from the front, 20° to the side, filling 70 % of the picture's height. They are discs: their standard
deviation is the spacing of the points in the surface's plane (8 mm for 30 000) and a tenth of it along the normal;
opacities lie in 0.7–0.95, features are random colours.

**What is timed**: 3 channels and alpha through torch tensors; *forward* without autograd, *forward+backward* to the
gradients of means, covariances, opacities and features. Kernels take turns, so that a busy machine is busy for all.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numba
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rnd_bench.scenes.scenes import bench_camera
from rnd_runtime.core.camera import Camera
from rnd_runtime.core.errors import InputError
from rnd_runtime.gl.raster import GlRasterizer
from rnd_runtime.playback.doctor import machine
from rnd_runtime.raster import oracle as raster_oracle
from rnd_trainer.render import raster, raster_reference

from .clock import summary
from .hidden import as_played, showing

Array = NDArray[np.float64]
Row = dict[str, Any]

# ends [m] and radius [m]; x is mirrored for arms and legs
SPINE = (
    ((0, 1.60, 0.02), (0, 1.64, 0.02), 0.11),
    ((0, 1.42, 0), (0, 1.56, 0.01), 0.055),
    ((-0.09, 1.33, 0), (0.09, 1.33, 0), 0.12),
    ((0, 1.00, 0), (0, 1.35, 0), 0.13),
    ((-0.06, 0.94, 0), (0.06, 0.94, 0), 0.13),
)
LIMBS = (
    ((0.19, 1.39, 0), (0.40, 1.15, 0), 0.05),
    ((0.40, 1.15, 0), (0.57, 0.94, 0.02), 0.04),
    ((0.57, 0.94, 0.02), (0.64, 0.85, 0.03), 0.04),
    ((0.10, 0.90, 0), (0.14, 0.50, 0.01), 0.08),
    ((0.14, 0.50, 0.01), (0.17, 0.10, -0.01), 0.055),
    ((0.17, 0.05, -0.02), (0.19, 0.05, 0.14), 0.05),
)


class Scene(NamedTuple):
    """What a rasteriser takes, float32."""

    means: NDArray[np.float32]
    covariances: NDArray[np.float32]
    opacities: NDArray[np.float32]
    features: NDArray[np.float32]


def body_scene(n: int, *, seed: int = 0) -> Scene:
    """N disc-like Gaussians on the person described above, standing on y = 0."""
    rng = np.random.default_rng(seed)
    mirror = np.array([-1.0, 1.0, 1.0])
    capsules = [(np.array(a, float), np.array(b, float), radius) for a, b, radius in SPINE + LIMBS]
    capsules += [(np.array(a) * mirror, np.array(b) * mirror, radius) for a, b, radius in LIMBS]
    areas = np.array([2 * np.pi * r * np.linalg.norm(b - a) + 4 * np.pi * r * r for a, b, r in capsules])
    points, normals, tried, kept = [], [], 0, 0
    while kept < n:
        which = rng.choice(len(capsules), size=n, p=areas / areas.sum())
        direction = rng.normal(size=(n, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        batch, outward = np.empty((n, 3)), np.empty((n, 3))
        for k, (a, b, radius) in enumerate(capsules):
            chosen, length = which == k, float(np.linalg.norm(b - a))
            batch[chosen], outward[chosen] = _on_capsule(a, b, radius, length, direction[chosen], rng)
        outside = np.ones(n, bool)
        for k, (a, b, radius) in enumerate(capsules):
            outside &= (which == k) | (_distance_to_segment(batch, a, b) > radius)
        points.append(batch[outside])
        normals.append(outward[outside])
        tried, kept = tried + n, kept + int(outside.sum())
    means, normals_all = np.concatenate(points)[:n], np.concatenate(normals)[:n]
    spacing = np.sqrt(areas.sum() * kept / tried / n)
    variance, thin = spacing**2, (0.1 * spacing) ** 2
    full = variance * np.eye(3) + (thin - variance) * normals_all[:, :, None] * normals_all[:, None, :]
    upper = full[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    opacities, features = rng.uniform(0.7, 0.95, n), rng.uniform(0, 1, (n, 3))
    return Scene(*(np.ascontiguousarray(a, np.float32) for a in (means, upper, opacities, features)))


def _on_capsule(
    a: Array, b: Array, radius: float, length: float, direction: Array, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Uniform points on a capsule's surface and their normals, from uniform directions."""
    axis = (b - a) / length
    along = direction @ axis
    on_tube = rng.uniform(size=len(direction)) < length / (length + 2 * radius)
    across = direction - along[:, None] * axis
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    normal = np.where(on_tube[:, None], across, direction)
    place = np.where(on_tube, rng.uniform(size=len(direction)) * length, np.where(along > 0, length, 0.0))
    return a + place[:, None] * axis + radius * normal, normal


def _distance_to_segment(points: Array, a: Array, b: Array) -> Array:
    along = np.clip((points - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
    return np.linalg.norm(points - a - along[:, None] * (b - a), axis=1)


class Result(NamedTuple):
    """Pictures of one call and, after a backward pass, its four gradients."""

    image: Tensor
    alpha: Tensor
    grads: tuple[Tensor, ...] = ()


def bench_raster(
    n: int = 30_000, size: int = 512, repeats: int = 40, threads: int | None = None, *, warmup: int = 3
) -> list[Row]:
    """Measure every rasteriser on the scene above; one row for each kernel and pass.

    Keys: kernel, pass (forward | forward+backward), n, size, ms_median, ms_p95, ms_min, psnr_db (image and alpha
    against the float64 oracle), grad_rel_l2 (the worst of the four gradients against the float64 reference; None
    for forward), threads, machine, warmup, repeats.
    """
    return measure(body_scene(n), bench_camera(size), repeats=repeats, threads=threads, warmup=warmup)


def measure(scene: Scene, camera: Camera, *, repeats: int, threads: int | None = None, warmup: int = 3) -> list[Row]:
    """``bench_raster`` for any scene; the plain-torch kernel is run a tenth as often."""
    before = numba.get_num_threads(), torch.get_num_threads()
    threads = threads or before[0]
    numba.set_num_threads(threads)
    torch.set_num_threads(threads)
    try:
        incoming = _incoming(camera, scene.features.shape[1])
        truth = raster_oracle.rasterize(*scene, camera)
        gradients = _run(raster_reference.rasterize, scene, camera, incoming, torch.float64).grads
        kernels: list[tuple[str, Callable[..., Any], int, int]] = [
            ("numba", raster.rasterize, warmup, repeats),
            ("torch tiles", raster_reference.rasterize, 1, max(3, repeats // 10)),
        ]
        cases = [(*kernel, wanted) for wanted in (None, incoming) for kernel in kernels]
        kept = showing(*scene, camera)
        shown = [torch.from_numpy(array[kept]) for array in scene]
        alone = [
            ("numba, as played", as_played),
            ("numba, as played, none hidden", lambda *_: as_played(*shown, camera)),
            *_gl_rasterizers(),
        ]
        cases += [(name, draws, warmup, repeats, None) for name, draws in alone]
        times: list[list[float]] = [[] for _ in cases]
        results: list[Result] = [Result(torch.empty(0), torch.empty(0))] * len(cases)
        for turn in range(max(case[2] + case[3] for case in cases)):
            for k, (_, rasterize, warm, wanted_times, wanted) in enumerate(cases):
                if turn < warm + wanted_times:
                    start = time.perf_counter()
                    results[k] = _run(rasterize, scene, camera, wanted)
                    times[k].append(1e3 * (time.perf_counter() - start))
        rows = []
        for (kernel, _, warm, wanted_times, wanted), taken, result in zip(cases, times, results):
            row = {
                "kernel": kernel,
                "pass": "forward" if wanted is None else "forward+backward",
                "n": len(scene.means),
                "size": camera.width,
                **summary(taken[warm:]),
                "psnr_db": _psnr(result, truth.image, truth.alpha),
                "grad_rel_l2": None if wanted is None else _worst(result.grads, gradients),
                "threads": threads,
                "machine": machine(),
                "warmup": warm,
                "repeats": wanted_times,
            }
            rows.append(row)
        return rows
    finally:
        numba.set_num_threads(before[0])
        torch.set_num_threads(before[1])


def _gl_rasterizers() -> list[tuple[str, Callable[..., Any]]]:
    """OpenGL on every backend that this machine has; it has no backward pass."""
    found: list[tuple[str, Callable[..., Any]]] = []
    for backend in ("egl", "osmesa"):
        try:
            rasterizer = GlRasterizer(backend)
        except InputError:
            continue
        found.append((f"gl-{backend}", partial(_through_gl, rasterizer)))
    return found


def _through_gl(rasterizer: GlRasterizer, *arguments: Any) -> tuple[Tensor, Tensor, None]:
    means, covariances, opacities, features = (tensor.numpy() for tensor in arguments[:4])
    raster = rasterizer(means, covariances, opacities, features, arguments[4], depth=False)
    # a copy where GL hands out views of one strided array: the time of a picture one can use
    image, alpha = np.ascontiguousarray(raster.image), np.ascontiguousarray(raster.alpha)
    return torch.from_numpy(image), torch.from_numpy(alpha), None


def _incoming(camera: Camera, channels: int) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(1)
    size = camera.height, camera.width
    return torch.randn(*size, channels, generator=generator), torch.randn(size, generator=generator)


def _run(
    rasterize: Callable[..., Any],
    scene: Scene,
    camera: Camera,
    incoming: tuple[Tensor, Tensor] | None,
    dtype: torch.dtype = torch.float32,
) -> Result:
    arrays = [torch.from_numpy(array).to(dtype).requires_grad_(incoming is not None) for array in scene]
    with torch.set_grad_enabled(incoming is not None):
        image, alpha, _ = rasterize(*arrays, camera)
    if incoming is None:
        return Result(image, alpha)
    grads = torch.autograd.grad((image, alpha), arrays, tuple(grad.to(dtype) for grad in incoming))
    return Result(image.detach(), alpha.detach(), grads)


def _psnr(result: Result, image: NDArray[np.float32], alpha: NDArray[np.float32]) -> float:
    """Over image and alpha together, peak 1."""
    ours = np.concatenate([result.image.numpy(), result.alpha.numpy()[..., None]], axis=2)
    theirs = np.concatenate([image, alpha[..., None]], axis=2)
    return float(-10 * np.log10(np.mean((ours - theirs) ** 2)))


def _worst(grads: tuple[Tensor, ...], truth: tuple[Tensor, ...]) -> float:
    norm = torch.linalg.vector_norm
    return max(float(norm(ours.double() - theirs) / norm(theirs)) for ours, theirs in zip(grads, truth))
