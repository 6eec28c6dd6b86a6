"""Films of people: bodies in motion, drawn under HDR light, and what the landmark network sees of them."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.images import read_image
from rnd_trainer.estimating.observing.landmarks import SIDE
from rnd_trainer.estimating.observing.regions import BODY_SCALE
from rnd_trainer.estimating.observing.sides import merge_views

from .blazepose import LandmarkGraph, Looks
from .motions import FPS, Clips, Floats32, sampled
from .people import Points
from .views import sampled_cameras

Window = dict[str, Floats32]
"""``rays`` [F, 33, 2], ``confidence`` [F, 33], ``hint_m`` [F, 33, 3] seen; ``rotations`` [F, 22, 3, 3] and ``joints``
[F, 22, 3] m true, all in camera axes; ``step`` frames of 30 a second from one to the next"""

FRAMES = 40
"""of a window"""
STEPS, CHANCES = (1, 2), (0.4, 0.6)
CANVAS, POINTS_DRAWN = 448, 100_000
AROUND = 1.5
"""side of the canvas in regions of the person"""
_WIDER, _GROWN = 1.12, 0.02  # of the region without a background; of the person's size: as ``observing.observe``
_FAR = 1 << 62
_SEEN = 0.5  # score of a frame with a person
_CELLS = 96  # of the coarse mask, across
_HANDS = [20, 21]


@dataclass(frozen=True, eq=False)
class Places:
    """Surroundings: pictures [L, 3, H, W] in sRGB and irradiance [L, 3, h, w] of latitude and longitude, +Y up."""

    pictures: Tensor
    irradiance: Tensor

    @classmethod
    def load(cls, folder: Path, device: torch.device) -> Places:
        files = sorted([*folder.glob("*.hdr"), *folder.glob("*.npz")])
        if not files:
            raise InputError("lights", expected="a folder with .hdr files", got="none", file=folder)
        pairs = [_surroundings(file) for file in files]
        pictures, irradiance = (torch.from_numpy(np.stack(x)).to(device).permute(0, 3, 1, 2) for x in zip(*pairs))
        return cls(pictures, irradiance)


def _surroundings(file: Path) -> tuple[Floats32, Floats32]:
    if file.suffix == ".npz":  # made here before
        with np.load(file, allow_pickle=False) as archive:
            return archive["picture"].astype(np.float32) / 255, archive["irradiance"].astype(np.float32)
    radiance = cv2.resize(read_image(file)[..., :3].astype(np.float32), (512, 256), interpolation=cv2.INTER_AREA)
    small = cv2.resize(radiance, (64, 32), interpolation=cv2.INTER_AREA)
    ways, areas = _directions(32, 64)
    normals, _ = _directions(16, 32)
    cosine = np.maximum(normals.reshape(-1, 3) @ ways.reshape(-1, 3).T, 0) * areas.ravel()
    irradiance = (cosine @ small.reshape(-1, 3) / np.pi).reshape(16, 32, 3)
    exposure = 0.5 / irradiance.mean()
    return _srgb(np.clip(radiance * exposure, 0, 1)), (irradiance * exposure).astype(np.float32)


def _directions(height: int, width: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    u, v = np.meshgrid((np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height)
    azimuth, polar = 2 * np.pi * (u - 0.5), np.pi * v
    ways = np.stack([np.sin(polar) * np.cos(azimuth), np.cos(polar), np.sin(polar) * np.sin(azimuth)], -1)
    return ways, np.sin(polar) * 2 * np.pi**2 / (height * width)


def _srgb(linear: Any) -> Any:
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-6) ** (1 / 2.4) - 0.055).astype(
        np.float32
    )


def _looked_up(maps: Tensor, ways: Tensor, yaw: Tensor) -> Tensor:
    """Values [B, 3, ...] of maps [B, 3, h, w] in the directions [B, ..., 3] of the world."""
    flat = ways.flatten(1, -2)
    azimuth = torch.atan2(flat[..., 2], flat[..., 0]) - yaw[:, None]
    x = torch.remainder(azimuth / torch.pi + 1, 2) - 1
    y = 2 / torch.pi * torch.acos(F.normalize(flat, dim=-1)[..., 1].clamp(-1, 1)) - 1
    found = F.grid_sample(maps, torch.stack([x, y], -1)[:, None], padding_mode="border", align_corners=False)
    return found.reshape(len(maps), 3, *ways.shape[1:-1])


class Studio:
    """Films windows of ``clips`` with people and light, as the landmark network ``graph`` sees them."""

    def __init__(self, people: list[Path], lights: Path, network: Path, device: torch.device) -> None:
        half = device.type == "cuda"
        self.device, self.graph = device, LandmarkGraph(network, device, torch.float16 if half else torch.float32)
        self.files, self.places = people, Places.load(lights, device)
        self._people: dict[Path, Points] = {}

    def film(self, clips: Clips, count: int, rng: np.random.Generator, augment: bool, frames: int = FRAMES) -> Films:
        """``count`` windows of one random person."""
        file = self.files[rng.integers(len(self.files))]
        if file not in self._people:
            self._people[file] = Points.load(file, POINTS_DRAWN, self.device)
        person = self._people[file]
        steps = rng.choice(STEPS, count, p=CHANCES)
        longest = frames * max(STEPS)
        rotations, roots = sampled(clips, count, longest, rng, augment)
        chosen = np.arange(frames) * steps[:, None]
        rotations = np.take_along_axis(rotations, chosen[..., None, None, None], 1)
        roots = np.take_along_axis(roots, chosen[..., None], 1)
        turned = self.tensor(np.concatenate([rotations, rotations[:, :, _HANDS]], 2))
        varied = self.tensor(rng.normal(size=(count, len(person.neutral))) * 0.9)
        shape = person.neutral + varied * (1 - 0.7 * person.neutral.abs())
        joints = person.joints(shape, turned, self.tensor(roots))
        cameras = sampled_cameras(joints[:, :, :22].cpu().numpy(), rng)
        scene = Scene(self, person, shape, self.tensor(cameras.rotations), self.tensor(cameras.translations), rng)
        seen = [scene.seen(turned[:, t], joints[:, t]) for t in range(frames)]
        points, metres, confidence, outside, sizes, scores = (
            torch.stack([one[k] for one in seen], 1).float().cpu().numpy() for k in range(6)
        )
        true = cameras.rotations[:, None, None] @ rotations
        where = cameras.seen(joints[:, :, :22].cpu().numpy())
        return Films(points, metres, confidence, outside, sizes, scores, true, where, steps)

    def tensor(self, values: NDArray[Any]) -> Tensor:
        """``values`` in single precision on the studio's device."""
        return torch.from_numpy(np.ascontiguousarray(values, np.float32)).to(self.device)


class Scene:
    """Windows in progress: one person of B shapes, B static cameras, and the regions in which they are followed."""

    def __init__(
        self, studio: Studio, person: Points, shape: Tensor, turn: Tensor, shift: Tensor, rng: np.random.Generator
    ) -> None:
        self.studio, self.person, self.shape, self.turn, self.shift = studio, person, shape, turn, shift
        count, tensor = len(shape), studio.tensor
        light = torch.from_numpy(rng.integers(len(studio.places.pictures), size=count)).to(studio.device)
        self.picture, self.irradiance = studio.places.pictures[light], studio.places.irradiance[light]
        self.yaw = tensor(rng.uniform(0, 2 * np.pi, count))
        tint = np.exp(rng.normal(0, 0.2, (count, 1 + int(person.piece.max()), 3)))
        tint *= np.exp(rng.normal(0, 0.35, (*tint.shape[:2], 1)))
        self.tint = tensor(tint)
        self.gain = tensor(np.exp(rng.normal(0, 0.3, count)))
        self.noise = tensor(rng.uniform(0.002, 0.03, count))
        self.behind = tensor(np.exp(rng.normal(0, 0.4, count)))
        self.random = torch.Generator(studio.device).manual_seed(int(rng.integers(1 << 62)))
        self.region: Tensor | None = None  # [B, 4] centre and side in x/z and y/z, rotation

    def seen(self, rotations: Tensor, joints: Tensor) -> tuple[Tensor, ...]:
        """Views of the next frame: points [B, 4, 33, 2] x/z and y/z, metres, confidence, outside, sizes, scores."""
        places, normals = self.person.posed(self.shape, rotations, joints)
        ahead = places @ self.turn.mT + self.shift[:, None]
        region = _first_region(joints @ self.turn.mT + self.shift[:, None]) if self.region is None else self.region
        half = 0.5 * AROUND * region[:, 2]
        image, mask = self._drawn(ahead, normals, region[:, :2], half)
        wider = torch.cat([region[:, :2], _WIDER * region[:, 2:3], region[:, 3:]], 1)
        looks, origin = [], region[:, :2]
        for canvas, at in ((image, region), (self._alone(image, mask, region), wider)):
            crops = _cropped(canvas, origin, half, at)
            both = self.studio.graph(torch.cat([crops, crops.flip(-1)]))
            for k, mirrored in enumerate((False, True)):
                own = slice(k * len(at), (k + 1) * len(at))
                looks.append((Looks([output[own] for output in both], mirrored), at))
        points = torch.stack([_to_rays(look.points, at) for look, at in looks], 1)
        metres = torch.stack([_turned(look.metres, at[:, 3]) for look, at in looks], 1)
        confidence = torch.stack([look.confidence for look, _ in looks], 1)
        first = looks[0][0]
        lost = first.score < _SEEN
        across = _to_rays(first.circle, region)
        after = _region_of(across[:, 0], across[:, 1])
        self.region = torch.where(lost[:, None], region, after)
        return points, metres, confidence, _outside(mask, points, origin, half), region[:, 2], first.score

    def _drawn(self, ahead: Tensor, normals: Tensor, centre: Tensor, half: Tensor) -> tuple[Tensor, Tensor]:
        """The canvas [B, 3, S, S] in sRGB and the person's mask [B, 1, S, S]."""
        count, drawn = ahead.shape[:2]
        side = CANVAS
        depth = ahead[..., 2].clamp(min=0.05)
        pixel = ((ahead[..., :2] / depth[..., None] - centre[:, None]) / half[:, None, None] + 1) * (0.5 * side) - 0.5
        key = (depth * 4096).long() * (1 << 20) + torch.arange(drawn, device=ahead.device)
        nearest = torch.full((count, side * side + 1), _FAR, device=ahead.device)
        low = pixel.floor().long()
        for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
            x, y = low[..., 0] + dx, low[..., 1] + dy
            inside = (x >= 0) & (x < side) & (y >= 0) & (y < side)
            nearest.scatter_reduce_(1, torch.where(inside, y * side + x, side * side), key, "amin")
        nearest = nearest[:, :-1]
        mask = nearest < _FAR
        index = torch.where(mask, nearest % (1 << 20), 0)
        light = _looked_up(self.irradiance, F.normalize(normals, dim=-1), self.yaw).mT * self.gain[:, None, None]
        colour = (self.person.colour * self.tint[:, self.person.piece] * light).clamp(0, 1)
        colour = 1.055 * (colour + 1e-4) ** (1 / 2.4) - 0.055
        person = colour.gather(1, index[..., None].expand(-1, -1, 3)).mT.unflatten(-1, (side, side))
        line = (torch.arange(side, device=ahead.device) + 0.5) * (2 / side) - 1
        x = (centre[:, :1] + half[:, None] * line)[:, None, :].expand(-1, side, -1)
        y = (centre[:, 1:] + half[:, None] * line)[:, :, None].expand(-1, -1, side)
        ways = torch.stack([x, y, torch.ones_like(x)], -1).flatten(1, 2) @ self.turn
        back = _looked_up(self.picture, ways, self.yaw).unflatten(-1, (side, side)) * self.behind[:, None, None, None]
        mask = mask.unflatten(-1, (side, side))[:, None].float()
        image = torch.where(mask > 0, person, back.clamp(0, 1))
        image = (
            image
            + torch.randn(image.shape, generator=self.random, device=ahead.device) * self.noise[:, None, None, None]
        )
        return image.clamp(0, 1), mask

    def _alone(self, image: Tensor, mask: Tensor, region: Tensor) -> Tensor:
        reach = 2 * round(_GROWN * CANVAS / AROUND) + 1
        grown = F.max_pool2d(mask, reach, 1, reach // 2)
        share = F.avg_pool2d(grown, reach, 1, reach // 2)
        return image * share + image.mean((2, 3), keepdim=True) * (1 - share)


def _first_region(joints: Tensor) -> Tensor:
    """Regions [B, 4] of joints [B, 24, 3] in camera axes."""
    flat = joints[..., :2] / joints[..., 2:].clamp(min=0.1)
    hips = flat[:, 1:3].mean(1)
    up = flat[:, 16:18].mean(1) - hips
    reach = 1.12 * (flat - hips[:, None]).norm(dim=-1).amax(1)
    return _region_of(hips, hips + F.normalize(up, dim=-1) * reach[:, None])


def _region_of(centre: Tensor, top: Tensor) -> Tensor:
    """As ``Region.of_body``."""
    across = top - centre
    size = 2 * BODY_SCALE * across.norm(dim=-1)
    return torch.cat([centre, size[:, None], torch.atan2(across[:, 0], -across[:, 1])[:, None]], 1)


def _turned(metres: Tensor, angle: Tensor) -> Tensor:
    cosine, sine = angle.cos()[:, None], angle.sin()[:, None]
    x, y = metres[..., 0], metres[..., 1]
    return torch.stack([cosine * x - sine * y, sine * x + cosine * y, metres[..., 2]], -1)


def _to_rays(points: Tensor, region: Tensor) -> Tensor:
    """Positions [B, N, 2] in crops of ``region``, pixels, as x/z and y/z."""
    local = (points / SIDE - 0.5) * region[:, None, 2:3]
    return _turned(torch.cat([local, local[..., :1]], -1), region[:, 3])[..., :2] + region[:, None, :2]


def _cropped(canvas: Tensor, origin: Tensor, half: Tensor, region: Tensor) -> Tensor:
    """Crops [B, 3, 256, 256] of ``region`` from the canvas around ``origin``."""
    line = torch.arange(SIDE, device=canvas.device) + 0.5
    grid = torch.stack(torch.meshgrid(line, line, indexing="xy"), -1).reshape(1, -1, 2).expand(len(canvas), -1, -1)
    place = (_to_rays(grid, region) - origin[:, None]) / half[:, None, None]
    return F.grid_sample(canvas, place.unflatten(1, (SIDE, SIDE)), align_corners=False)


def _outside(mask: Tensor, points: Tensor, origin: Tensor, half: Tensor) -> Tensor:
    """Distances [B, V, 33] of ``points`` from the person, in x/z."""
    coarse = F.adaptive_max_pool2d(mask, _CELLS).flatten(1)
    line = (torch.arange(_CELLS, device=mask.device) + 0.5) * (2 / _CELLS) - 1
    cells = torch.stack(torch.meshgrid(line, line, indexing="xy"), -1).reshape(-1, 2)
    place = (points - origin[:, None, None]) / half[:, None, None, None]
    apart = torch.cdist(place.flatten(1, 2), cells.expand(len(place), -1, -1)) + 9 * (coarse[:, None] == 0)
    near = (apart.amin(-1) - 1 / _CELLS).clamp(0, 2) * half[:, None]
    return near.reshape(points.shape[:-1])


@dataclass(frozen=True, eq=False)
class Films:
    """What was seen of B windows in V views, and the truth; see ``merge_views`` and ``Window``."""

    points: Floats32
    metres: Floats32
    confidence: Floats32
    outside: Floats32
    sizes: Floats32
    scores: Floats32
    rotations: Floats32
    joints: Floats32
    steps: NDArray[np.int64]

    def windows(self) -> list[Window]:
        """The windows in which the person is never lost."""
        found = []
        for b in np.flatnonzero((self.scores >= _SEEN).all(1)):
            points, metres, confidence, outside, sizes = (
                a[b].astype(np.float64) for a in (self.points, self.metres, self.confidence, self.outside, self.sizes)
            )
            seconds = np.arange(len(sizes)) * self.steps[b] / FPS
            merged = merge_views(points, metres, confidence, outside, sizes, seconds)
            window = {
                "rays": merged.points,
                "confidence": merged.confidence,
                "hint_m": merged.metres,
                "rotations": self.rotations[b],
                "joints": self.joints[b],
                "step": self.steps[b],
            }
            found.append({name: np.asarray(array, np.float32) for name, array in window.items()})
        return found


def filmed(
    studio: Studio,
    clips: Clips,
    count: int,
    seed: int,
    pool: Executor,
    *,
    augment: bool = True,
    batch: int = 96,
    frames: int = FRAMES,
    seconds: float = np.inf,
    on_batch: Callable[[int], None] = lambda done: None,
) -> list[Window]:
    """At most ``count`` windows, fewer where ``seconds`` have passed before; views are merged in ``pool``."""
    start, done = time.monotonic(), 0
    parts: list[Future[list[Window]]] = []
    while done < count and time.monotonic() - start < seconds:
        size = min(batch, count - done)
        films = studio.film(clips, size, np.random.default_rng([seed, done]), augment, frames)
        parts.extend(pool.submit(Films.windows, part) for part in _split(films, 8))
        done += size
        on_batch(done)
    return [window for part in parts for window in part.result()]


def _split(films: Films, size: int) -> Iterator[Films]:
    for start in range(0, len(films.steps), size):
        yield Films(*(getattr(films, name)[start : start + size] for name in films.__dataclass_fields__))


def save_films(file: Path, windows: list[Window]) -> None:
    """Write ``windows`` of one length as one .npz, in half precision."""
    arrays: dict[str, Any] = {k: np.stack([w[k] for w in windows]).astype(np.float16) for k in windows[0]}
    np.savez_compressed(file, **arrays)


def load_films(file: Path) -> list[Window]:
    """Read what ``save_films`` wrote."""
    with np.load(file, allow_pickle=False) as archive:
        arrays = {name: archive[name].astype(np.float32) for name in archive.files}
    return [{name: array[k] for name, array in arrays.items()} for k in range(len(arrays["step"]))]
