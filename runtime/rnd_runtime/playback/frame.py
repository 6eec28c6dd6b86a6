"""The one facade that renders a frame of an avatar: pose, shade, splat, tone map.

::

    renderer = FrameRenderer(Avatar.load("avatar.onnx"), load_light("sky.exr"), camera)
    frame = renderer.render(motion, 0.5)   # frame.srgb: 8-bit image; frame.stage_seconds: where the time went
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rnd_runtime.avatar.avatar import Avatar, Encoded
from rnd_runtime.core.arrays import Buffers, Floats32
from rnd_runtime.core.camera import Camera, Floats
from rnd_runtime.core.gaussians import Gaussians, Raster, Rasterizer
from rnd_runtime.core.images import Tone
from rnd_runtime.ground.bounce import light_over
from rnd_runtime.ground.shadow import GroundLight, Plane, footprint, remaining_light
from rnd_runtime.motion.motion import Motion
from rnd_runtime.raster import cpu as raster_cpu
from rnd_runtime.raster.enlarge import enlarged
from rnd_runtime.raster.in_view import visible_to
from rnd_runtime.raster.outline import sharpened
from rnd_runtime.raster.tone import tone_map, tone_map_straight
from rnd_runtime.shading.light import Light
from rnd_runtime.shading.shader import Shader, shadow_radii

from .aov import Lit, aov_layers, splat_features
from .far import fine_view
from .rasterizer import ChosenRasterizer, Kind, make_rasterizer

_MEAN = np.full(3, 1 / 3, np.float32)


@dataclass(frozen=True, eq=False)
class RenderedFrame:
    """One rendered frame.

    Attributes:
        radiance: [H, W, 3] linear Rec.709, premultiplied by alpha.
        alpha: [H, W].
        aovs: [H, W, C] by name, see ``playback.aov``.
        stage_seconds: duration of each stage, in order; they add up to the frame.
        background: linear radiance, [H, W, 3] or [3]; None for a transparent frame.
        ground: [H, W, 3] share of the background's light that the body's shadow on the ground leaves; None without one.
        srgb_on_black: [H, W, 3] 8-bit sRGB without the background, where already made.
        tone: curve of the 8-bit images; linear ones have none.
    """

    radiance: Floats32
    alpha: Floats32
    aovs: Mapping[str, Floats32] = field(default_factory=dict)
    stage_seconds: Mapping[str, float] = field(default_factory=dict)
    background: Floats32 | None = None
    ground: Floats32 | None = None
    srgb_on_black: NDArray[np.uint8] | None = None
    tone: Tone = "srgb"

    @cached_property
    def srgb(self) -> NDArray[np.uint8]:
        """8-bit sRGB [H, W, 3] over the background, or black."""
        if self.background is None and self.srgb_on_black is not None:
            return self.srgb_on_black
        share = None if self.background is None else self.ground
        return tone_map(self.radiance, self.alpha, self.background, share, tone=self.tone)

    @cached_property
    def srgb_alpha(self) -> NDArray[np.uint8]:
        """8-bit sRGB and alpha [H, W, 4] without the background, not premultiplied (as in PNG).

        A shadow on the ground is black of its mean opacity.
        """
        return tone_map_straight(self.radiance, self._covering, tone=self.tone)

    @property
    def shadowed_background(self) -> Floats32 | None:
        """The background with the shadow on it."""
        if self.background is None or self.ground is None:
            return self.background
        shadowed: Floats32 = self.background * self.ground
        return shadowed

    @property
    def _covering(self) -> Floats32:
        """Alpha [H, W] of the body and of its shadow, taken as black."""
        if self.ground is None:
            return self.alpha
        covering: Floats32 = self.alpha + (1 - self.alpha) * (1 - self.ground @ _MEAN)
        return covering

    def linear(self) -> Floats32:
        """Linear RGBA [H, W, 4], premultiplied; alpha is 1 over a background, and without one the body's alone."""
        behind = self.shadowed_background
        if behind is None:
            return np.dstack([self.radiance, self.alpha])
        over = self.radiance + (1 - self.alpha)[..., None] * behind
        return np.dstack([over, np.ones_like(self.alpha)])


class PosedAvatar(NamedTuple):
    """Gaussians and joints [J, 3] m in the root's frame, and root frame → world [4, 4] (rigid, m)."""

    gaussians: Gaussians
    root: Floats
    joints: Floats


class FrameRenderer:
    """Renders one avatar; frames depend on the arguments, ``camera``, ``shader`` and ``cull`` alone.

    Only Gaussians that reach the image are shaded. With OpenGL everything after the encoders is done on its device.

    Args:
        avatar: its threads are those chosen in ``Avatar.load``.
        light: the probe, or a ``Shader`` of it; ``turn`` and ``relight`` change it between frames.
        camera: the view, where the calls below name none; assign ``renderer.camera`` to move it.
        shade: one of ``shading.shader.SHADE_MODES``, where ``light`` is no shader.
        raster: "cpu", "gl", "gl-egl", "gl-osmesa" or "auto", see ``make_rasterizer``; or a rasteriser.
        cull: leaves out Gaussians whose n·v is below this cosine, such as −0.5; −1 draws all. By default as the
            avatar's file advises. See ``raster.in_view.in_view``.
        tone: of the 8-bit images: sRGB's curve alone, or ``core.images.neutral`` before it, on the CPU.

    Attributes:
        ground: the plane that the body casts its shadow on, in the world; None for none.
    """

    def __init__(
        self,
        avatar: Avatar,
        light: Light | Shader,
        camera: Camera | None = None,
        *,
        shade: str = "table+sun",
        raster: Kind | Rasterizer = "cpu",
        cull: float | None = None,
        tone: Tone = "srgb",
    ) -> None:
        self.avatar, self.camera, self.tone = avatar, camera, tone
        self.cull = avatar.advice.cull if cull is None else cull
        self.shader = Shader(light, shade) if isinstance(light, Light) else light
        self._probe: Light | None = None  # where the shader's has the ground's light in it
        self.rasterizer: Rasterizer = make_rasterizer(raster) if isinstance(raster, str) else raster
        self.ground: Plane | None = None
        self._ground_light: GroundLight | None = None
        self._images = Buffers()

    @property
    def light(self) -> Light:
        """The probe, without what the ground reflects."""
        return self.shader.light if self._probe is None else self._probe

    @property
    def draws_with(self) -> str:
        """The rasteriser's name: ``cpu``, or OpenGL's backend and device."""
        return str(getattr(self.rasterizer, "name", "custom"))

    def turn(self, yaw: float) -> None:
        """Turn the light to ``yaw`` radians (as ``shading.light.Light``); builds no table."""
        if yaw != self.light.yaw:
            self.shader = self.shader.with_yaw(yaw)
            self._probe = self._probe and self._probe.with_yaw(yaw)

    def relight(self, light: Light) -> None:
        """Use another light; builds its tables."""
        self.shader, self._probe = Shader(light, self.shader.mode), None

    def reflect(self, share: ArrayLike) -> None:
        """Light the body from below by ``share`` [3] of the ground's irradiance, until ``relight``; builds tables."""
        assert self.ground is not None
        self._probe = self.light
        self.shader = Shader(light_over(self._probe, self.ground.normal, share), self.shader.mode)

    def render(
        self, motion: Motion, time: float, camera: Camera | None = None, *, aovs: Sequence[str] = ()
    ) -> RenderedFrame:
        """Render the avatar at ``time`` seconds of ``motion`` (mapped to its skeleton)."""
        encoded = self.avatar.encode(motion, time)
        frame = self.draw(encoded, camera, aovs=aovs)
        return replace(frame, stage_seconds={**encoded.seconds, **frame.stage_seconds})

    def draw(
        self,
        body: Encoded | PosedAvatar,
        camera: Camera | None = None,
        *,
        aovs: Sequence[str] = (),
        lit: bool = True,
        srgb: bool = True,
        scale: float = 1.0,
        given: Mapping[str, Floats32] | None = None,
    ) -> RenderedFrame:
        """Render what is encoded or posed already.

        Args:
            aovs: names of ``playback.aov.CHANNELS``.
            lit: False leaves the radiance zero, for frames of AOVs alone.
            srgb: make the 8-bit image at once.
            scale: share of the camera's width and height that is rendered and then enlarged. AOVs are rendered in full.
            given: features [N, C] of the AOVs in ``playback.aov.GIVEN``.
        """
        camera = camera or self.camera
        assert camera is not None
        rendered = camera
        seconds: dict[str, float] = {}
        if self.ground is not None and not isinstance(body, PosedAvatar):  # its shadow needs the Gaussians
            started = perf_counter()
            body = PosedAvatar(self.avatar.posed(body), body.root, self.avatar.joints(body))
            seconds["posing"] = perf_counter() - started
        if scale != 1 and not aovs:
            rendered = camera.resized(*(max(round(side * scale), 1) for side in (camera.width, camera.height)))
        raster = self._raster(body, rendered, aovs, lit, given or {}, antialias=rendered is camera)
        seconds |= raster.seconds
        layers = aov_layers(aovs, raster, 3 if lit else 0, given or {})
        radiance = raster.image[..., :3] if lit else np.zeros((*raster.alpha.shape, 3), np.float32)
        alpha, image_srgb = raster.alpha, raster.srgb if self.tone == "srgb" else None
        started = perf_counter()
        if rendered is not camera:
            image = enlarged(np.dstack([radiance, alpha]), camera.height, camera.width)
            radiance, alpha, image_srgb = image[..., :3], image[..., 3], None
            seconds["enlarging"] = perf_counter() - started
            started = perf_counter()
        if srgb and image_srgb is None:
            image_srgb = tone_map(radiance, alpha, tone=self.tone)
            seconds["tone map"] = perf_counter() - started
        ground = None
        if self.ground is not None and isinstance(body, PosedAvatar):
            started = perf_counter()
            ground = ground_share(self.ground, self.ground_light(self.ground), body, camera, self._images)
            seconds["ground"] = perf_counter() - started
        return RenderedFrame(radiance, alpha, layers, seconds, ground=ground, srgb_on_black=image_srgb, tone=self.tone)

    def ground_light(self, ground: Plane) -> GroundLight:
        """The light's irradiance on the ground."""
        known, light = self._ground_light, self.light
        if known is None or known.light.radiance is not light.radiance:
            known = GroundLight(light, ground.normal)
        elif known.light is not light:
            known = known.with_yaw(light)
        self._ground_light = known
        return known

    def close(self) -> None:
        """Release the rasteriser."""
        if isinstance(self.rasterizer, ChosenRasterizer):
            self.rasterizer.close()

    def __enter__(self) -> FrameRenderer:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _raster(
        self,
        body: Encoded | PosedAvatar,
        camera: Camera,
        aovs: Sequence[str],
        lit: bool,
        given: Mapping[str, Floats32],
        *,
        antialias: bool,
    ) -> Raster:
        """In the root's frame; with ``antialias`` a body of few pixels is rendered on a finer grid and averaged."""
        shader, camera = in_root_frame(body.root, self.shader, camera)
        joints = body.joints if isinstance(body, PosedAvatar) else self.avatar.joints(body)
        fine = fine_view(camera, joints) if antialias else None
        if fine is None:
            return self._splat(body, shader, camera, aovs, lit, given)
        return fine.averaged(self._splat(body, shader, fine.camera, aovs, lit, given))

    def _splat(
        self,
        body: Encoded | PosedAvatar,
        shader: Shader,
        camera: Camera,
        aovs: Sequence[str],
        lit: bool,
        given: Mapping[str, Floats32],
    ) -> Raster:
        """On OpenGL's device where that can be, else stage by stage."""
        cull = None if self.cull is None or self.cull <= -1 else self.cull
        how: dict[str, Any] = {"cull": cull, "aovs": aovs, "lit": lit, "given": given}
        if isinstance(body, PosedAvatar):
            return draw_gaussians(body.gaussians, shader, camera, self.rasterizer, **how)
        if lit and not aovs and isinstance(self.rasterizer, ChosenRasterizer):
            unposed, device = self.avatar.unposed(body), self.rasterizer.renderer
            if unposed is not None and device is not None:
                return device.draw(unposed, shader, camera, cull=cull)
        started = perf_counter()
        gaussians = self.avatar.posed(body)
        posing = perf_counter() - started
        raster = draw_gaussians(gaussians, shader, camera, self.rasterizer, **how)
        return replace(raster, seconds={"posing": posing, **raster.seconds})


def ground_share(
    ground: Plane, light: GroundLight, body: PosedAvatar, camera: Camera, images: Buffers | None = None
) -> Floats32:
    """Share [H, W, 3] of the ground's light that a body leaves where ``camera`` sees it; in one of ``images``."""
    plane, camera = ground.in_frame(body.root), camera.in_frame(body.root)
    pixel = footprint(camera, plane, plane.axes[:2] @ body.joints[0])
    shadow = light.shadow(body.gaussians, shadow_radii(body.gaussians), plane, body.root[:3, :3], pixel=pixel)
    return remaining_light(shadow, camera, (images or Buffers()).empty((camera.height, camera.width, 3)))


def in_root_frame(root: Floats, shader: Shader, camera: Camera) -> tuple[Shader, Camera]:
    """Light and camera in the root's frame; ``root`` [4, 4] takes it to the world (rigid, m)."""
    return shader.in_frame(root[:3, :3]), camera.in_frame(root)


def draw_gaussians(
    gaussians: Gaussians,
    shader: Shader,
    camera: Camera,
    rasterizer: Rasterizer,
    *,
    cull: float | None = None,
    aovs: Sequence[str] = (),
    lit: bool = True,
    given: Mapping[str, Floats32] | None = None,
) -> Raster:
    """Shade Gaussians in view, splat them and sharpen outlines.

    Args:
        cull: as of ``raster.in_view.in_view``; None draws all.
        aovs: whose features follow the radiance in the image, see ``aov_layers``.
        lit: False leaves the radiance out.
        given: features of AOVs, as of ``FrameRenderer.draw``.

    Returns:
        Linear radiance [H, W, 3] and AOVs; ``seconds`` have "shading" beside the rasteriser's stages.
    """
    if lit and not aovs and isinstance(rasterizer, ChosenRasterizer) and rasterizer.renderer is not None:
        return rasterizer.renderer.draw(gaussians, shader, camera, cull=cull)
    started = perf_counter()
    visible = visible_to(gaussians, camera, cull)
    features = features_of(gaussians, shader, camera, visible, aovs=aovs, lit=lit, given=given or {})
    shading = perf_counter() - started
    geometry = gaussians.means, gaussians.covariances, gaussians.opacities
    raster = splat(geometry, features, camera, rasterizer, visible, depth="depth" in aovs)
    return replace(raster, seconds={"shading": shading, **raster.seconds})


def features_of(
    gaussians: Gaussians,
    shader: Shader,
    camera: Camera,
    visible: NDArray[np.bool_],
    *,
    aovs: Sequence[str],
    lit: bool,
    given: Mapping[str, Floats32],
    sunlit: Floats32 | None = None,
) -> Floats32:
    """Features [N, C] to splat: radiance if ``lit``, then those of the AOVs. ``sunlit``: as of ``Shader.shade``."""
    again = {"diffuse", "specular", "shadow"} & {*aovs}
    if again and sunlit is None:
        sunlit = shader.sunlit(gaussians, visible)
    radiance = np.empty((len(visible), 0), np.float32)
    if lit or again:
        radiance = shader.shade(gaussians, camera.position, visible, sunlit=sunlit)
    features = [radiance] if lit else []
    features += splat_features(aovs, gaussians, camera, Lit(shader, camera.position, visible, radiance, sunlit), given)
    return features[0] if len(features) == 1 else np.concatenate(features, axis=1)


def splat(
    geometry: tuple[Floats32, Floats32, Floats32],
    features: Floats32,
    camera: Camera,
    rasterizer: Rasterizer,
    visible: NDArray[np.bool_],
    *,
    depth: bool,
) -> Raster:
    """Splat ``visible`` Gaussians (means, covariances, opacities) with their features, and sharpen outlines."""
    means, covariances, opacities = geometry
    if getattr(rasterizer, "name", "") == "cpu":  # which sharpens as it blends
        return raster_cpu.rasterize(*geometry, features, camera, depth=depth, outlines=True, visible=visible)
    opacities = np.where(visible, opacities, np.float32(0))
    return sharpened(rasterizer(means, covariances, opacities, features.astype(np.float32), camera, depth=depth))
