"""Rows G1–G10: needles, broken covariances, cameras inside the body, image sizes, colours, rasterisers."""

from __future__ import annotations

from dataclasses import replace
from time import perf_counter

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from rnd_bench.scenes.poses import EXTREMES
from rnd_bench.scenes.psnr import Floats, decibels, srgb
from rnd_bench.scenes.subject import Subject
from rnd_bench.stability.figures import Result, above, at_most, below, holds, refusal, result
from rnd_runtime.core.camera import Camera
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.gaussians import Gaussians, Rasterizer
from rnd_runtime.core.images import linear_to_srgb, to_bytes
from rnd_runtime.core.rotations import quaternion_to_matrix
from rnd_runtime.gl.context import Backend, create_context
from rnd_runtime.gl.raster import GlRasterizer
from rnd_runtime.raster import oracle
from rnd_runtime.raster.cpu import rasterize
from rnd_trainer.model.posing import pose_gaussians
from rnd_trainer.model.twist import TwistFrames
from rnd_trainer.render.raster_reference import rasterize as rasterize_by_torch

from .poses import BYTE

Floats32 = NDArray[np.float32]
Splats = tuple[Floats32, Floats32, Floats32, Floats32]  # means, covariances, opacities, features

NEEDLE = 10
SCREEN_FILLING = 50  # %; largest share of the image that one Gaussian of α > 0.5 may cover
SLOWEST = 3  # times the median; limit of the slowest frame of a flight
UPPER = [0, 1, 2, 4, 5, 8]  # the upper triangle of a flattened 3×3 matrix
GL_BACKENDS: tuple[Backend, ...] = ("egl", "osmesa")


def needles(subject: Subject) -> Result:
    """G1: axis ratios of the Gaussians in extreme poses, and projected from top, bottom and back."""
    shares, seen = [], []
    for pose in EXTREMES.values():
        posed = subject.avatar.pose(subject.motion(pose), 0.0)
        axes = np.sqrt(np.linalg.eigvalsh(oracle.symmetric(posed.covariances)))
        shares.append(float((axes[:, 2] > NEEDLE * axes[:, 1]).mean()))
        for azimuth, elevation in ((0.0, 1.5), (0.0, -1.5), (np.pi, 0.0)):
            camera = subject.camera(azimuth, elevation, 512)
            front = np.sum((camera.position - posed.means) * posed.normals, 1) > 0
            flat = oracle.image_covariances(posed.means[front], posed.covariances[front], camera)
            axes = np.sqrt(np.linalg.eigvalsh(flat))
            seen.append(float((axes[:, 1] > NEEDLE * axes[:, 0]).mean()))
    return result(
        below("longest over middle axis above 10", 100 * max(shares), 1, "%"),
        below("aspect on the screen above 10, unseen views", 100 * max(seen), 1, "%"),
    )


def _splats(seed: int, count: int = 200) -> Splats:
    """Random Gaussians around the origin."""
    rng = np.random.default_rng(seed)
    axes = rng.normal(size=(count, 3, 3)) * rng.uniform(0.1, 1, (count, 3, 1)) * 0.06
    means, opacities, features = (
        0.5 * rng.normal(size=(count, 3)),
        rng.uniform(0, 1, count),
        rng.uniform(0, 1, (count, 3)),
    )
    return means.astype(np.float32), _upper(axes), opacities.astype(np.float32), features.astype(np.float32)


def _camera(width: int = 96, height: int = 96, eye: tuple[float, float, float] = (0.2, 0.3, -2.5)) -> Camera:
    return Camera.look_at(list(eye), [0.05, 0.0, 0.1], width=width, height=height, fov_y=0.7)


def broken_quaternions(subject: Subject) -> Result:
    """G2: zero, NaN, denormal and infinite rotations, scales and covariances; q and −q, and the paper's r + Δr.

    Rotations and scales pass through the model's posing, as vectors 2 xyz/w of a quaternion.
    """
    means, covariances, opacities, features = _splats(1)
    camera = _camera()
    rng = np.random.default_rng(2)
    q = rng.normal(size=(len(means), 4))
    delta = 0.3 * rng.normal(size=q.shape)
    scales = rng.uniform(0.01, 0.05, (len(means), 3))
    given: dict[str, ArrayLike] = {"rotation": 2 * q[:, 1:] / q[:, :1], "turn": delta[:, 1:], "scales": scales}

    def image(upper: Floats32) -> Floats32:
        raster = rasterize(means, upper, opacities, features, camera)
        return np.dstack([raster.image, raster.alpha])

    wrong = []
    for what in ("covariances", *given):
        for name, value in (("zero", 0.0), ("NaN", np.nan), ("denormal", 1e-45), ("infinite", np.inf)):
            broken = np.array(covariances if what == "covariances" else given[what], np.float32)
            broken[::7] = value
            upper = broken if what == "covariances" else _posed(**{**given, what: broken})
            if not np.isfinite(image(upper)).all():
                wrong.append(f"{name} {what}")
    negative = {**given, "rotation": 2 * -q[:, 1:] / -q[:, :1]}
    ours = float(np.abs(image(_posed(**given)) - image(_posed(**negative))).max())
    unit = q / np.linalg.norm(q, axis=1, keepdims=True)
    added = [image(_upper(quaternion_to_matrix(sign * unit + delta) * scales[:, None])) for sign in (1, -1)]
    baseline = "r + Δr", float(np.abs(added[0] - added[1]).max())
    return result(
        holds("injected values that come through", wrong),
        at_most("image of q against −q with Δr, largest difference", ours, 1e-6, baseline=baseline),
    )


def _posed(rotation: ArrayLike, turn: ArrayLike, scales: ArrayLike) -> Floats32:
    """Covariances [N, 6] m² by the model's posing at rest, of vectors [N, 3] and scales [N, 3] m."""
    vectors, turns, sizes = (torch.tensor(np.array(x, np.float32)) for x in (rotation, turn, scales))
    count = len(sizes)
    up = torch.tensor([0.0, 1.0, 0.0]).expand(count, 3)
    nothing, frames = torch.zeros(count, 3), torch.eye(3).expand(count, 3, 3)
    limbs = TwistFrames(up, nothing, torch.zeros(count))
    weights, bones = torch.ones(count, 1), torch.eye(3, 4)[None]
    return pose_gaussians(weights, bones, nothing, turns, frames, vectors, sizes, up, limbs)[1].numpy()


def _upper(factors: Floats) -> Floats32:
    """Covariances F Fᵀ [N, 6] m² of factors [N, 3, 3] m."""
    return (factors @ factors.transpose(0, 2, 1)).reshape(-1, 9)[:, UPPER].astype(np.float32)


def fly_through(subject: Subject) -> Result:
    """G3: a flight through the body from front to back; cameras at and in Gaussians."""
    posed = subject.avatar.pose(subject.walk(0.5), 0.4)
    chest = np.median(posed.means, axis=0).astype(np.float64)
    eyes = [chest + np.array([0.02, 0.05, z]) for z in np.linspace(2.5, -2.5, subject.few(21, 101))]
    eyes += [posed.means[k].astype(np.float64) - [0, 0, step] for k in (0, 11) for step in (0.0, 0.011, 0.03)]
    finite, filling, seconds = True, -1.0, []
    worst = np.zeros((0, 0, 4), np.float32)
    for eye in eyes:
        camera = Camera.look_at(eye, eye - [0, 0, 1.0], width=subject.size, height=subject.size, fov_y=0.6)
        times = []
        for _ in range(3):
            started = perf_counter()
            image = subject.radiance(posed, camera)
            times.append(perf_counter() - started)
        seconds.append(min(times))
        finite &= bool(np.isfinite(image).all())
        share = _largest_share(posed, camera)
        if share >= filling:
            filling, worst = share, image
    slowest = max(seconds) / float(np.median(seconds))
    return result(
        below("frames that are not finite", float(not finite), 1),
        below("share of the image that one Gaussian covers with α > 0.5", 100 * filling, SCREEN_FILLING, "%"),
        replace(below("slowest frame over the median", slowest, SLOWEST, "×"), timing=True),
        images=(to_bytes(srgb(worst[..., :3])), to_bytes(subject.image(posed))),
    )


def _largest_share(posed: Gaussians, camera: Camera) -> float:
    """Largest share of the image in which a single Gaussian's α exceeds one half."""
    points = oracle.camera_points(posed.means, camera)
    near = (points[:, 2] >= oracle.NEAR) & (points[:, 2] < 0.5) & (posed.opacities > 0.5)
    if not near.any():
        return 0.0
    pixels = oracle.image_points(points[near], camera)
    flat = oracle.image_covariances(posed.means[near], posed.covariances[near], camera)
    reach = np.sqrt(2 * np.log(posed.opacities[near] / 0.5))[:, None] * np.sqrt(flat[:, [0, 1], [0, 1]])
    size = np.array([camera.width, camera.height])
    box = np.clip(pixels + reach, 0, size) - np.clip(pixels - reach, 0, size)
    return float((np.pi / 4 * np.prod(np.maximum(box, 0), axis=1)).max() / np.prod(size))


def nothing_in_view(subject: Subject) -> Result:
    """G5: no Gaussian, one Gaussian, and a camera that looks away."""
    camera, wrong = _camera(64, 48), []
    background = np.array([0.2, 0.5, 0.7], np.float32)
    rest, away = subject.rest, Camera.look_at([0, 1, 5], [0, 1, 9], width=64, height=48, fov_y=0.6)
    means, covariances, opacities, features = _splats(3)
    cases: dict[str, tuple[Splats, Camera]] = {
        "N = 0": ((means[:0], covariances[:0], opacities[:0], features[:0]), camera),
        "looking away": ((rest.means, rest.covariances, rest.opacities, rest.albedo), away),
    }
    for name, (arrays, view) in cases.items():
        raster = rasterize(*arrays, view)
        if not (raster.image + (1 - raster.alpha[..., None]) * background == background).all():
            wrong.append(name)
    one = rasterize(means[:1], covariances[:1], opacities[:1], features[:1], camera)
    if not (np.isfinite(one.image).all() and one.image.shape == (48, 64, 3)):
        wrong.append("N = 1")
    return result(holds("cases in which the background does not come back", wrong))


def equal_depths(subject: Subject) -> Result:
    """G6: five colours of Gaussians at the same positions, the camera rotated by 0.1° steps."""
    means, covariances, opacities = (np.repeat(a, 5, axis=0) for a in _splats(4, 40)[:3])
    features = np.random.default_rng(5).uniform(0, 1, (len(means), 3)).astype(np.float32)
    worst = 0.0
    for step in range(subject.few(5, 20)):
        angle = np.radians(0.1) * step
        camera = _camera(48, 48, (2.5 * np.sin(angle), 0.3, -2.5 * np.cos(angle)))
        ours, truth = (draw(means, covariances, opacities, features, camera) for draw in (rasterize, oracle.rasterize))
        worst = max(worst, float(np.abs(ours.image - truth.image).max()))
    return result(below("against (depth, index) in the oracle, largest difference", worst / BYTE, 1, "/255"))


def image_sizes(subject: Subject) -> Result:
    """G7: 1×1, 1×4096, odd sizes, and above OpenGL's limit."""
    splats, wrong = _splats(6), []
    with _Rasters() as rasters:
        for name, raster in rasters.all.items():
            for width, height in ((1, 1), (1, 4096), (4096, 1), (97, 33), (17, 31)):
                image = raster(*splats, _camera(width, height)).image
                if image.shape != (height, width, 3) or not np.isfinite(image).all():
                    wrong.append(f"{name} {width}×{height}")
            if name != "cpu":
                wrong += refusal(f"{name} 40000×2", raster, *splats, _camera(40_000, 2))
    return result(holds("sizes that come out wrong", wrong + rasters.missing))


class _Rasters:
    """The CPU kernel and OpenGL on both backends."""

    def __enter__(self) -> _Rasters:
        self.all: dict[str, Rasterizer] = {"cpu": rasterize}
        self.missing: list[str] = []
        self._open = []
        for backend in GL_BACKENDS:
            try:
                raster = GlRasterizer(context=create_context(backend))
            except InputError as error:
                self.missing.append(f"no {backend}: {error}")
                continue
            self.all[f"gl-{backend}"] = raster
            self._open.append(raster)
        return self

    def __exit__(self, *_: object) -> None:
        for raster in self._open:
            raster.close()


def grey_card(subject: Subject) -> Result:
    """G9: 18 % grey is 118; grey Gaussians of any opacity over grey remain grey."""
    card = int(to_bytes(linear_to_srgb(0.18)))
    means, covariances, opacities, _ = _splats(7)
    raster = rasterize(means, covariances, opacities, np.full((len(means), 3), 0.18, np.float32), _camera())
    over = raster.image + (1 - raster.alpha[..., None]) * np.float32(0.18)
    covered = raster.alpha > 0.02
    straight = raster.image[covered] / raster.alpha[covered][:, None]
    ramp, divided = (int(np.abs(to_bytes(linear_to_srgb(x)).astype(int) - card).max()) for x in (over, straight))
    return result(
        at_most("0.18 → 118, off by", abs(card - 118), 0, "/255"),
        at_most("alpha ramp of grey over grey, off by", ramp, 1, "/255"),
        at_most("grey with its alpha divided out, off by", divided, 1, "/255"),
    )


def rasters_agree(subject: Subject) -> Result:
    """G10: CPU kernel, OpenGL on EGL and on OSMesa, and torch against the oracle, on the avatar."""
    posed = subject.avatar.pose(subject.walk(0.3), 0.2)
    camera = subject.camera(0.4, 0.2, subject.few(64, 160))
    splats = posed.means, posed.covariances, posed.opacities, subject.shader.shade(posed, camera.position)
    truth = srgb(oracle.rasterize(*splats, camera).image)
    images: dict[str, Floats] = {}
    with _Rasters() as rasters, torch.no_grad():
        images |= {name: srgb(raster(*splats, camera).image) for name, raster in rasters.all.items()}
        means, covariances, opacities, features = (torch.from_numpy(array) for array in splats)
        by_torch = rasterize_by_torch(means, covariances, opacities, features, camera)[0]
        images["torch"] = srgb(by_torch.numpy())
    worst = min(images, key=lambda name: np.nan_to_num(decibels(images[name], truth), nan=-np.inf))
    largest = max(float(np.abs(image - truth).max()) for image in images.values())
    enlarged = [to_bytes(np.repeat(np.repeat(image, 2, axis=0), 2, axis=1)) for image in (images[worst], truth)]
    return result(
        holds("backends missing", rasters.missing),
        at_most("largest difference to the oracle", largest / BYTE, 2, "/255"),
        above(f"PSNR to the oracle, worst ({worst})", decibels(images[worst], truth), 50, "dB"),
        images=(enlarged[0], enlarged[1]),
    )
