"""Making and measuring smaller files of one checkpoint, in one scene."""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
import onnx
from numpy.typing import NDArray

from rnd_export.bake import BakedAvatar, bake
from rnd_export.export import MAX_P99_M, refuse_ablations, written
from rnd_export.order import gaussians_by_place
from rnd_export.reduce.culling import advise
from rnd_export.reduce.merge import contributions, fitted_albedo, merged
from rnd_export.reduce.shots import Shot, Shots, resized, shots_around
from rnd_export.reduce.variant import Variant, reduced, static_where
from rnd_runtime.avatar.avatar import Avatar
from rnd_runtime.avatar.file import Precision
from rnd_runtime.core.camera import Camera
from rnd_runtime.core.gaussians import Gaussians
from rnd_runtime.core.images import linear_to_srgb
from rnd_runtime.motion.motion import Motion
from rnd_runtime.playback.frame import FrameRenderer
from rnd_runtime.raster.cpu import rasterize
from rnd_runtime.shading.light import Light
from rnd_trainer.model.checkpoint import Checkpoint
from rnd_trainer.model.template import node_interpolation

from .stopwatch import Stopwatch, milliseconds

Floats = NDArray[np.float64]

USUAL_FRAMES = 90
FIT_SIDE = 256
"""of the pictures that say what Gaussians contribute, and that colours are fitted to"""


@dataclass(frozen=True)
class Scene:
    """What an avatar is judged in; without ``shots`` those of ``shots_around``, of ``size`` pixels."""

    motion: Motion
    light: Light
    size: int = 512
    shade: str = "table+sun"
    shots: Shots | None = None


@dataclass(frozen=True)
class Recipe:
    """What a file leaves out, beyond its ``Variant``.

    ``gaussians``: N, or None for all. ``dynamic_mm``: nodes whose dynamic skinning moves nothing by as much are given
    the template's. ``cull``: n·v below which players leave Gaussians out, or None.
    """

    variant: Variant = field(default_factory=Variant)
    gaussians: int | None = None
    dynamic_mm: float = 0.0
    cull: float | None = None


class Measured(NamedTuple):
    """``psnr``: of the worst picture against the whole avatar's, dB; ``ms`` a frame; ``mb`` (1e6 bytes)."""

    psnr: float
    ms: float
    mb: float


class Workbench:
    """``seen`` are the shots to search on, ``held_out`` others; ``clock`` gives an avatar's ms per frame."""

    def __init__(self, checkpoint: Checkpoint, scene: Scene, clock: Callable[[Avatar], float] | None = None) -> None:
        refuse_ablations(checkpoint)
        self.config, self._checkpoint, self._scene = checkpoint.config.model, checkpoint, scene
        self._baked = gaussians_by_place(bake(checkpoint.model))
        self._whole = _loaded(self.model(Recipe()))
        self.seen, fitted, self.held_out = scene.shots or shots_around(
            scene.motion, scene.size, lambda time: self._whole.pose(scene.motion, time)
        )
        renderer = self._renderer(self._whole)
        self._truth = {shot: self._picture(renderer, shot) for shot in (*self.seen, *self.held_out)}
        self._stopwatch = None if clock else Stopwatch(self._frames(self._whole))
        self._clock = clock or self._timed
        self._fit = [Shot(shot.time, resized(shot.camera, FIT_SIDE)) for shot in fitted]
        self._shares = contributions(self._posed(self._whole))
        self._moves = self._gaussian_moves()
        self._allowed: dict[Precision, bool] = {}

    def allows(self, precision: Precision) -> bool:
        """Whether constants of ``precision`` move places no farther than ``rnd-export`` allows by itself."""
        if precision not in self._allowed:
            coarser, motion = _loaded(self.model(Recipe(Variant(precision=precision)))), self._scene.motion
            both = [(self._whole.pose(motion, shot.time), coarser.pose(motion, shot.time)) for shot in self.seen]
            apart = [np.linalg.norm(exact.means - rounded.means, axis=1) for exact, rounded in both]
            self._allowed[precision] = bool(np.percentile(apart, 99) <= MAX_P99_M[precision])
        return self._allowed[precision]

    def model(self, recipe: Recipe) -> onnx.ModelProto:
        """The file of ``recipe``."""
        baked = reduced(self._baked, self.config, recipe.variant)
        if recipe.dynamic_mm and baked.skinning is not None:
            baked = static_where(baked, self._site_moves(baked) < recipe.dynamic_mm)
        if recipe.gaussians is not None:
            baked = merged(baked, recipe.gaussians, self._shares)
            fewer = _loaded(self._written(baked, recipe.variant))
            wanted = [_albedo_picture(*view) for view in self._posed(self._whole)]
            baked = dataclasses.replace(baked, albedo=fitted_albedo(baked.albedo, self._posed(fewer), wanted))
        model = self._written(baked, recipe.variant)
        advise(model, recipe.cull)
        return model

    def measure(self, model: onnx.ModelProto, shots: Sequence[Shot]) -> Measured:
        """``model`` in ``shots``."""
        avatar = _loaded(model)
        renderer = self._renderer(avatar)
        squares = [np.mean((self._picture(renderer, shot) - self._truth[shot]) ** 2) for shot in shots]
        psnr = -10 * np.log10(max(float(max(squares)), 1e-12))
        return Measured(float(psnr), self._clock(avatar), model.ByteSize() / 1e6)

    def usual_times(self, model: onnx.ModelProto) -> Floats:
        """Milliseconds of ``USUAL_FRAMES`` frames of ``model`` as this machine draws them now, busy moments and all."""
        draw = self._frames(_loaded(model))
        return milliseconds(draw, USUAL_FRAMES)

    def recalibrated(self) -> bool:
        """Whether times that were measured so far were of a busy machine, see ``Stopwatch.recalibrated``."""
        return self._stopwatch is not None and self._stopwatch.recalibrated()

    def still_share(self, recipe: Recipe) -> float:
        """Share of the skinning network's nodes that ``recipe`` gives the template's weights."""
        baked = reduced(self._baked, self.config, recipe.variant)
        return float((self._site_moves(baked)[: baked.rates.skinning] < recipe.dynamic_mm).mean())

    def _written(self, baked: BakedAvatar, variant: Variant) -> onnx.ModelProto:
        return written(self._checkpoint, baked, variant)

    def _renderer(self, avatar: Avatar) -> FrameRenderer:
        return FrameRenderer(avatar, self._scene.light, self.seen[0].camera, shade=self._scene.shade)

    def _picture(self, renderer: FrameRenderer, shot: Shot) -> Floats:
        """sRGB [H, W, 3], not rounded."""
        renderer.camera = shot.camera
        radiance = renderer.render(self._scene.motion, shot.time).radiance
        return np.asarray(linear_to_srgb(np.clip(radiance, 0, 1)), np.float64)

    def _frames(self, avatar: Avatar) -> Callable[[int], object]:
        """Draws ``avatar`` in the k-th of the shots that are held out."""
        renderer = self._renderer(avatar)

        def draw(k: int) -> object:
            shot = self.held_out[k % len(self.held_out)]
            renderer.camera = shot.camera
            return renderer.render(self._scene.motion, shot.time)

        return draw

    def _posed(self, avatar: Avatar) -> list[tuple[Gaussians, Camera]]:
        return [(avatar.pose(self._scene.motion, shot.time), shot.camera) for shot in self._fit]

    def _timed(self, avatar: Avatar) -> float:
        assert self._stopwatch
        return self._stopwatch.ms(self._frames(avatar))

    def _site_moves(self, baked: BakedAvatar) -> Floats:
        """By how many mm dynamic skinning moves what reads each of ``baked``'s nodes [M], through other nodes too where
        the network is evaluated at fewer; 0 at those where it is not."""
        moves: Floats = np.zeros(len(baked.codes))
        np.maximum.at(moves, baked.neighbours, self._moves[:, None])
        if baked.rates.skinning == len(moves):
            return moves
        sites = baked.codes[: baked.rates.skinning]
        most: Floats = np.zeros(len(moves))
        np.maximum.at(most, node_interpolation(baked.codes, sites, baked.area)[0], moves[:, None])
        return most

    def _gaussian_moves(self) -> Floats:
        """By how many mm dynamic skinning moves each Gaussian [N], at most over the poses of the search."""
        most: Floats = np.zeros(len(self._baked.points))
        if self._baked.skinning is None:
            return most
        static, motion = _loaded(self.model(Recipe(Variant("static")))), self._scene.motion
        for shot in self.seen:
            apart = self._whole.pose(motion, shot.time).means - static.pose(motion, shot.time).means
            most = np.maximum(most, 1e3 * np.linalg.norm(apart, axis=1))
        return most


def _albedo_picture(gaussians: Gaussians, camera: Camera) -> NDArray[np.float32]:
    arrays = (gaussians.means, gaussians.covariances, gaussians.opacities, gaussians.albedo)
    return rasterize(*arrays, camera, depth=False).image


def _loaded(model: onnx.ModelProto) -> Avatar:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "avatar.onnx"
        onnx.save_model(model, str(file))
        return Avatar.load(file)
