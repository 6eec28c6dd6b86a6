"""Poses, relights and splats one frame at a time."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.avatar.avatar import Avatar, Encoded
from rnd_runtime.core.camera import Camera
from rnd_runtime.core.gaussians import Gaussians, Raster, Rasterizer
from rnd_runtime.motion.motion import Motion
from rnd_runtime.playback.frame import KeptRadiance, as_seen_from, chosen_cull, draw, draw_encoded, drawn_at_once
from rnd_runtime.raster.in_view import opacities_of, seen_of
from rnd_runtime.raster.outline import sharpened
from rnd_runtime.raster.tone import tone_map, tone_map_straight
from rnd_runtime.shading.light import Light
from rnd_runtime.shading.shader import Shader
from rnd_viewer.inputs.background import Background
from rnd_viewer.view.governor import FULL, LADDER, LADDER_AT_ONCE, Quality, enlarged

from .aov import CHANNELS, aov_values, splat_features
from .timing import StageTimes

Floats32 = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Frame:
    """One rendered frame: linear light, premultiplied, nothing behind it yet.

    Attributes:
        radiance: [H, W, 3] linear Rec.709, premultiplied by alpha.
        alpha: [H, W].
        behind: linear radiance of the background, [H, W, 3] or [3]; None leaves the picture transparent.
        aovs: what the EXR layers hold, [H, W, C] for each name (see ``play.aov``).
        on_black: [H, W, 3] 8-bit sRGB without the background, where a device has made it already.
    """

    radiance: Floats32
    alpha: Floats32
    behind: Floats32 | None
    aovs: dict[str, Floats32]
    on_black: NDArray[np.uint8] | None = None

    def linear(self) -> Floats32:
        """Linear R, G, B, A [H, W, 4], premultiplied; over a background alpha is 1."""
        if self.behind is None:
            return np.dstack([self.radiance, self.alpha])
        return np.dstack([self._over(self.behind), np.ones_like(self.alpha)])

    @cached_property
    def srgb(self) -> NDArray[np.uint8]:
        """The picture to look at: 8-bit sRGB [H, W, 3], on black when there is no background.

        Splats are blended in linear light and coded at the end, as in training.
        """
        if self.behind is None and self.on_black is not None:
            return self.on_black
        return tone_map(self.radiance, self.alpha, self.behind)

    @cached_property
    def srgb_alpha(self) -> NDArray[np.uint8]:
        """8-bit sRGB and alpha [H, W, 4] without the background, not premultiplied, as PNG has it."""
        return tone_map_straight(self.radiance, self.alpha)

    def _over(self, behind: Floats32) -> Floats32:
        return self.radiance + (1 - self.alpha)[..., None] * behind


@dataclass(eq=False)
class Player:
    """An avatar under a light, ready to be rendered at any time of any motion from any camera.

    Frames depend on nothing but the arguments of ``render`` and on ``turn``. ``times`` collects how long each
    stage took; ``cull`` is that of ``rnd_runtime.playback.frame.FrameRenderer``, by default the avatar's own.
    """

    avatar: Avatar
    light: Light
    shader: Shader
    rasterizer: Rasterizer
    background: Background = field(default_factory=Background)
    aovs: tuple[str, ...] = ()
    times: StageTimes = field(default_factory=StageTimes)
    cull: float | None = None
    _behind: tuple[Camera, Floats32] | None = field(default=None, init=False, repr=False)
    _kept: tuple[KeptRadiance, int] | None = field(default=None, init=False, repr=False)  # and its frames

    def __post_init__(self) -> None:
        self.cull = chosen_cull(self.avatar, self.cull)

    @property
    def ladder(self) -> tuple[Quality, ...]:
        """Qualities of ``draw``, from the best to the fastest."""
        return LADDER_AT_ONCE if drawn_at_once(self.shader, self.rasterizer) else LADDER

    def turn(self, yaw: float) -> None:
        """Turn the light to ``yaw`` radians (as ``Light``) from the next ``draw`` on; no table is built."""
        if yaw != self.light.yaw:
            self.light, self.shader, self._behind = self.light.turned(yaw), self.shader.turned(yaw), None

    def render(self, motion: Motion, time_s: float, camera: Camera) -> Frame:
        """The avatar at ``time_s`` seconds of ``motion``, seen by ``camera``."""
        return self.draw(self.encode(motion, time_s), camera)

    def encode(self, motion: Motion, time_s: float) -> Encoded:
        """The first half of ``render``; may run in another thread than the second."""
        with self.times.stage("encoders"):
            return self.avatar.encode(motion, time_s)

    def draw(self, encoded: Encoded, camera: Camera, quality: Quality = FULL) -> Frame:
        """The second half of ``render``; below full ``quality`` it uses what it kept of the frames before.

        AOVs are drawn at full quality.
        """
        if self.aovs:
            quality = FULL
        sides = (max(round(side * quality.scale), 1) for side in (camera.width, camera.height))
        resized = camera if quality.scale == 1 else camera.resized(*sides)
        if quality.shade_every == 1 and not self.aovs:
            raster = draw_encoded(
                self.avatar, encoded, self.shader, resized, self.rasterizer, cull=self.cull, coded=False
            )
            self._kept = None  # by the next frame of less shading it would be out of date
        else:
            with self.times.stage("posing"):
                gaussians = self.avatar.posed(encoded)
            brought = as_seen_from(encoded.root, self.shader, resized)
            if self.aovs:
                raster = self._raster_with_aovs(gaussians, *brought)
            else:
                raster = self._raster_of_kept(gaussians, *brought, quality.shade_every)
        if quality.scale != 1:
            raster = self._enlarged(raster, camera)
        for stage, seconds in raster.seconds.items():
            self.times.add(stage, seconds)
        with self.times.stage("background"):
            behind = self._radiance_behind(camera)
        aovs, start = {}, 3
        for name in self.aovs:
            if name == "depth":
                splatted = raster.depth[..., None]
            else:
                splatted = raster.image[..., start : start + len(CHANNELS[name])]
                start += len(CHANNELS[name])
            aovs[name] = aov_values(name, splatted, raster.alpha)
        return Frame(raster.image[..., :3], raster.alpha, behind, aovs, raster.srgb)

    def _raster_of_kept(self, gaussians: Gaussians, shader: Shader, camera: Camera, shade_every: int) -> Raster:
        """With radiance of up to ``shade_every`` − 1 frames ago."""
        count = len(gaussians.means)
        if self._kept is None or self._kept[1] >= shade_every or len(self._kept[0].known) != count:
            self._kept = KeptRadiance(count), 0
        kept, age = self._kept
        self._kept = kept, age + 1
        return draw(gaussians, shader, camera, self.rasterizer, cull=self.cull, kept=kept)

    def _enlarged(self, raster: Raster, camera: Camera) -> Raster:
        with self.times.stage("enlarging"):
            picture = np.dstack([raster.image, raster.alpha])
            picture = enlarged(picture, camera.height, camera.width)
        depth = np.zeros((camera.height, camera.width), np.float32)
        return Raster(picture[..., :3], picture[..., 3], depth, raster.seconds)

    def _raster_with_aovs(self, gaussians: Gaussians, shader: Shader, camera: Camera) -> Raster:
        """Radiance, then the AOVs' features, splatted; both are the CPU's."""
        with self.times.stage("shading"):
            seen = seen_of(gaussians, camera, self.cull)
            radiance = shader.shade(gaussians, camera.position, seen)
            features = np.concatenate([radiance, *splat_features(self.aovs, gaussians, camera)], axis=1)
        raster = self.rasterizer(
            gaussians.means,
            gaussians.covariances,
            opacities_of(gaussians, seen),
            features.astype(np.float32),
            camera,
            depth="depth" in self.aovs,
        )
        return sharpened(raster)

    def _radiance_behind(self, camera: Camera) -> Floats32 | None:
        """The background, kept for as long as camera and light stand still."""
        if self.background.kind == "none":
            return None
        if self._behind is None or self._behind[0] is not camera:
            self._behind = (camera, self.background.radiance(camera, self.light))
        return self._behind[1]
