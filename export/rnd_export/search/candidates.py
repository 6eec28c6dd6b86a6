"""Smaller files of one checkpoint, made and measured in one scene."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import onnx
from numpy.typing import NDArray

from rnd_export.bake import BakedAvatar, bake
from rnd_export.export import build, refuse_ablations
from rnd_export.order import order_gaussians
from rnd_export.parity import MAX_P99_M
from rnd_export.reduce.culling import add_advice
from rnd_export.reduce.merge import contributions, fitted_albedo, merge_gaussians
from rnd_export.reduce.variant import Variant, reduced, static_where
from rnd_export.reduce.views import SearchView, SearchViews, resized, views_around
from rnd_runtime.avatar.avatar import Avatar
from rnd_runtime.avatar.file import Precision
from rnd_runtime.core.camera import Camera
from rnd_runtime.core.gaussians import Gaussians
from rnd_runtime.core.images import linear_to_srgb
from rnd_runtime.core.signals import temporary_folder
from rnd_runtime.motion.motion import Motion
from rnd_runtime.playback.frame import FrameRenderer
from rnd_runtime.raster.cpu import rasterize
from rnd_runtime.shading.light import Light
from rnd_trainer.model.checkpoint import Checkpoint

from .timing import PairedTimer, milliseconds

Floats = NDArray[np.float64]

USUAL_FRAMES = 90
FIT_SIDE = 256  # px, longer side of the images for contributions and albedo


@dataclass(frozen=True)
class SearchScene:
    """Motion, light and views of the measurements; by default the views of ``views_around``, of ``size`` pixels."""

    motion: Motion
    light: Light
    size: tuple[int, int] = (512, 512)
    shade: str = "table+sun"
    views: SearchViews | None = None


@dataclass(frozen=True)
class Recipe:
    """Reductions of a file.

    Attributes:
        gaussians: N, None for all.
        dynamic_mm: nodes at which dynamic skinning moves Gaussians by less get the template's weights.
        cull: n·v below which players cull Gaussians, or None.
    """

    variant: Variant = field(default_factory=Variant)
    gaussians: int | None = None
    dynamic_mm: float = 0.0
    cull: float | None = None


class Measured(NamedTuple):
    """PSNR of the worst image against the full avatar's, dB; ms per frame; 1e6 bytes."""

    psnr: float
    ms: float
    mb: float


class Workbench:
    """Makes and measures files; ``search`` are the views to search in, ``held_out`` others.

    Args:
        clock: an avatar's ms per frame; by default a ``PairedTimer``.
    """

    def __init__(
        self, checkpoint: Checkpoint, scene: SearchScene, clock: Callable[[Avatar], float] | None = None
    ) -> None:
        refuse_ablations(checkpoint)
        self.config, self._checkpoint, self._scene = checkpoint.config.model, checkpoint, scene
        self._baked = order_gaussians(bake(checkpoint.model))
        self._full = _loaded(self.model(Recipe()))
        self.search, fitted, self.held_out = scene.views or views_around(
            scene.motion, scene.size, lambda time: self._full.pose(scene.motion, time)
        )
        renderer = self._renderer(self._full)
        self._reference = {view: self._image(renderer, view) for view in (*self.search, *self.held_out)}
        self._timer = None if clock else PairedTimer(self._frames(self._full))
        self._clock = clock or self._timed
        self._fit = [SearchView(view.time, resized(view.camera, FIT_SIDE)) for view in fitted]
        self._contributions = contributions(self._posed(self._full))
        self._moves = self._gaussian_moves()
        self._allowed: dict[Precision, bool] = {}

    def allows(self, precision: Precision) -> bool:
        """Whether constants of ``precision`` keep positions within ``MAX_P99_M``."""
        if precision not in self._allowed:
            coarser, motion = _loaded(self.model(Recipe(Variant(precision=precision)))), self._scene.motion
            both = [(self._full.pose(motion, view.time), coarser.pose(motion, view.time)) for view in self.search]
            errors = [np.linalg.norm(exact.means - rounded.means, axis=1) for exact, rounded in both]
            self._allowed[precision] = bool(np.percentile(errors, 99) <= MAX_P99_M[precision])
        return self._allowed[precision]

    def model(self, recipe: Recipe) -> onnx.ModelProto:
        baked = reduced(self._baked, self.config, recipe.variant)
        if recipe.dynamic_mm and baked.skinning is not None:
            baked = static_where(baked, self._node_moves(baked) < recipe.dynamic_mm)
        if recipe.gaussians is not None:
            baked = merge_gaussians(baked, recipe.gaussians, self._contributions)
            fewer = _loaded(build(self._checkpoint, baked, recipe.variant))
            wanted = [_albedo_image(*view) for view in self._posed(self._full)]
            baked = dataclasses.replace(baked, albedo=fitted_albedo(baked.albedo, self._posed(fewer), wanted))
        model = build(self._checkpoint, baked, recipe.variant)
        add_advice(model, recipe.cull)
        return model

    def measure(self, model: onnx.ModelProto, views: Sequence[SearchView]) -> Measured:
        """PSNR, time and size of ``model`` in ``views``."""
        avatar = _loaded(model)
        renderer = self._renderer(avatar)
        squares = [np.mean((self._image(renderer, view) - self._reference[view]) ** 2) for view in views]
        psnr = -10 * np.log10(max(float(max(squares)), 1e-12))
        return Measured(float(psnr), self._clock(avatar), model.ByteSize() / 1e6)

    def usual_times(self, model: onnx.ModelProto) -> Floats:
        """Times of ``USUAL_FRAMES`` frames of ``model`` at the machine's current load, ms."""
        return milliseconds(self._frames(_loaded(model)), USUAL_FRAMES)

    def recalibrated(self) -> bool:
        """See ``PairedTimer.recalibrated``."""
        return self._timer is not None and self._timer.recalibrated()

    def still_share(self, recipe: Recipe) -> float:
        """Share of the nodes with the template's weights."""
        baked = reduced(self._baked, self.config, recipe.variant)
        return float((self._node_moves(baked) < recipe.dynamic_mm).mean())

    def _renderer(self, avatar: Avatar) -> FrameRenderer:
        return FrameRenderer(avatar, self._scene.light, self.search[0].camera, shade=self._scene.shade)

    def _image(self, renderer: FrameRenderer, view: SearchView) -> Floats:
        """sRGB [H, W, 3], not rounded."""
        renderer.camera = view.camera
        radiance = renderer.render(self._scene.motion, view.time).radiance
        return np.asarray(linear_to_srgb(np.clip(radiance, 0, 1)), np.float64)

    def _frames(self, avatar: Avatar) -> Callable[[int], object]:
        """A function that renders ``avatar`` in the k-th held-out view."""
        renderer = self._renderer(avatar)

        def draw(k: int) -> object:
            view = self.held_out[k % len(self.held_out)]
            renderer.camera = view.camera
            return renderer.render(self._scene.motion, view.time)

        return draw

    def _posed(self, avatar: Avatar) -> list[tuple[Gaussians, Camera]]:
        return [(avatar.pose(self._scene.motion, view.time), view.camera) for view in self._fit]

    def _timed(self, avatar: Avatar) -> float:
        assert self._timer
        return self._timer.ms(self._frames(avatar))

    def _node_moves(self, baked: BakedAvatar) -> Floats:
        """Largest motion by dynamic skinning [M], mm, of the Gaussians that read each node."""
        moves: Floats = np.zeros(len(baked.codes))
        np.maximum.at(moves, baked.neighbours, self._moves[:, None])
        return moves

    def _gaussian_moves(self) -> Floats:
        """Largest motion of each Gaussian by dynamic skinning [N], mm, over the poses of the search."""
        largest: Floats = np.zeros(len(self._baked.points))
        if self._baked.skinning is None:
            return largest
        static, motion = _loaded(self.model(Recipe(Variant("static")))), self._scene.motion
        for view in self.search:
            offsets = self._full.pose(motion, view.time).means - static.pose(motion, view.time).means
            largest = np.maximum(largest, 1e3 * np.linalg.norm(offsets, axis=1))
        return largest


def _albedo_image(gaussians: Gaussians, camera: Camera) -> NDArray[np.float32]:
    arrays = (gaussians.means, gaussians.covariances, gaussians.opacities, gaussians.albedo)
    return rasterize(*arrays, camera, depth=False).image


def _loaded(model: onnx.ModelProto) -> Avatar:
    with temporary_folder() as folder:
        file = folder / "avatar.onnx"
        onnx.save_model(model, str(file))
        return Avatar.load(file)
