"""One picture of an avatar from a motion, a light and a camera: all of playback behind one call.

::

    renderer = FrameRenderer(Avatar.load("avatar.onnx"), load_light("sky.exr"), camera)
    frame = renderer.render(motion, 0.5)   # frame.image: 8-bit sRGB; frame.stage_seconds: where the time went
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.avatar.avatar import Avatar, Encoded
from rnd_runtime.core.camera import Camera, Floats
from rnd_runtime.core.gaussians import Floats32, Gaussians, Raster, Rasterizer
from rnd_runtime.motion.motion import Motion
from rnd_runtime.raster import cpu as raster_cpu
from rnd_runtime.raster.in_view import opacities_of, seen_of
from rnd_runtime.raster.outline import sharpened
from rnd_runtime.raster.tone import tone_map
from rnd_runtime.shading.light import Light
from rnd_runtime.shading.shader import Shader

from . import frame_cpu
from .rasterizer import ChosenRasterizer, Kind, make_rasterizer


@dataclass(frozen=True, eq=False)
class Frame:
    """One rendered picture.

    Attributes:
        image: [H, W, 3] 8-bit sRGB, over black.
        radiance: [H, W, 3] linear Rec.709, premultiplied by alpha.
        alpha: [H, W].
        stage_seconds: how long each stage took, in the order in which they ran; they add up to the frame.
    """

    image: NDArray[np.uint8]
    radiance: Floats32
    alpha: Floats32
    stage_seconds: Mapping[str, float]


class FrameRenderer:
    """Renders one avatar; frames depend on the arguments and on ``camera`` and the light alone.

    Only Gaussians that reach the picture are shaded. With OpenGL everything after the encoders is done on its device:
    see ``gl.frame``.

    Args:
        avatar: as ``avatar.avatar.Avatar.load`` gives it, with the threads chosen there.
        light: the probe; ``turn`` and ``relight`` change it between frames.
        camera: the view; assign ``renderer.camera`` to move it between frames.
        shade: one of ``shading.shader.SHADE_MODES``.
        raster: "cpu", "gl", "gl-egl", "gl-osmesa" or "auto", see ``playback.rasterizer.make_rasterizer``.
        cull: leave out the back of the body: Gaussians whose n·v is below this cosine, such as −0.5; −1 draws all. What
            that costs stands in ``raster.in_view.in_view``. By default as the avatar's file advises.
    """

    def __init__(
        self,
        avatar: Avatar,
        light: Light,
        camera: Camera,
        *,
        shade: str = "table+sun",
        raster: Kind = "cpu",
        cull: float | None = None,
    ) -> None:
        self.avatar, self.camera, self.cull = avatar, camera, chosen_cull(avatar, cull)
        self._shader = Shader(light, shade)
        self._rasterizer = make_rasterizer(raster)

    @property
    def draws_with(self) -> str:
        """The rasteriser's name: ``cpu``, or one with OpenGL's backend and device."""
        return self._rasterizer.name

    def turn(self, yaw: float) -> None:
        """Turn the light to ``yaw`` radians (as ``shading.light.Light``); costs nothing."""
        self._shader = self._shader.turned(yaw)

    def relight(self, light: Light) -> None:
        """Another light from now on; its tables are built here."""
        self._shader = Shader(light, self._shader.mode)

    def render(self, motion: Motion, time: float) -> Frame:
        """The avatar at ``time`` seconds of ``motion`` (mapped to its skeleton)."""
        encoded = self.avatar.encode(motion, time)
        raster = draw_encoded(self.avatar, encoded, self._shader, self.camera, self._rasterizer, cull=self.cull)
        started = perf_counter()
        image = tone_map(raster.image, raster.alpha) if raster.srgb is None else raster.srgb
        seconds = {**encoded.seconds, **raster.seconds}
        seconds.setdefault("tone map", perf_counter() - started)  # unless that was done where the rest was
        return Frame(image, raster.image, raster.alpha, seconds)

    def close(self) -> None:
        """Release the rasteriser."""
        self._rasterizer.close()


def chosen_cull(avatar: Avatar, cull: float | None) -> float | None:
    """For ``draw``, of what a player was asked for: None is what ``avatar``'s file advises, −1 to draw all."""
    chosen = avatar.advice.cull if cull is None else cull
    return None if chosen is None or chosen <= -1 else chosen


def draw_encoded(
    avatar: Avatar,
    encoded: Encoded,
    shader: Shader,
    camera: Camera,
    rasterizer: Rasterizer,
    *,
    cull: float | None = None,
    coded: bool = True,
) -> Raster:
    """Pose and ``draw``: where the avatar's file allows it all on OpenGL's device, or in one call of the CPU's.

    That call is for shading by tables. With ``coded`` it makes ``srgb`` too, as a device always does. The raster's
    ``seconds`` have "posing" and what else was done.
    """
    shader, camera = as_seen_from(encoded.root, shader, camera)
    unposed = avatar.unposed(encoded)
    if unposed is not None and isinstance(rasterizer, ChosenRasterizer):
        if rasterizer.renderer is not None:
            return rasterizer.renderer.draw(unposed, shader, camera, cull=cull)
        if frame_cpu.draws(shader):
            return frame_cpu.draw(unposed, shader, camera, cull=cull, coded=coded)
    started = perf_counter()
    gaussians = avatar.posed(encoded)
    posing = perf_counter() - started
    raster = draw(gaussians, shader, camera, rasterizer, cull=cull)
    return replace(raster, seconds={"posing": posing, **raster.seconds})


def drawn_at_once(shader: Shader, rasterizer: Rasterizer) -> bool:
    """Whether ``draw_encoded`` poses, shades and splats an avatar of ours in one go: on a device, or by tables."""
    return isinstance(rasterizer, ChosenRasterizer) and (rasterizer.renderer is not None or frame_cpu.draws(shader))


def as_seen_from(frame_to_world: Floats, shader: Shader, camera: Camera) -> tuple[Shader, Camera]:
    """Light and camera for what is posed in the frame that ``frame_to_world`` [4, 4] (rigid, m) takes to the world."""
    return shader.in_frame(frame_to_world[:3, :3]), camera.in_frame(frame_to_world)


def draw(
    gaussians: Gaussians,
    shader: Shader,
    camera: Camera,
    rasterizer: Rasterizer,
    *,
    cull: float | None = None,
    kept: KeptRadiance | None = None,
) -> Raster:
    """Shade what can be seen, splat it and sharpen outlines: linear radiance [H, W, 3], without depth.

    ``cull`` as of ``in_view``. With ``kept``, only Gaussians are shaded that were not seen since it was made. The
    raster's ``seconds`` have "shading" beside its own stages. OpenGL shades on its device, but for ``kept`` radiance,
    which is the CPU's.
    """
    if isinstance(rasterizer, ChosenRasterizer) and rasterizer.renderer is not None and kept is None:
        return rasterizer.renderer.draw(gaussians, shader, camera, cull=cull)
    started = perf_counter()
    seen = seen_of(gaussians, camera, cull)
    radiance = _shade(gaussians, shader, camera, seen, kept)
    seconds = {"shading": perf_counter() - started}
    if getattr(rasterizer, "name", "") == "cpu":  # which sharpens as it blends
        arrays = gaussians.means, gaussians.covariances, gaussians.opacities, radiance
        raster = raster_cpu.rasterize(*arrays, camera, depth=False, outlines=True, seen=seen)
    else:
        arrays = gaussians.means, gaussians.covariances, opacities_of(gaussians, seen), radiance
        raster = sharpened(rasterizer(*arrays, camera, depth=False))
    return replace(raster, seconds={**seconds, **raster.seconds})


class KeptRadiance:
    """Radiance of some frames ago, of the Gaussians that were seen since."""

    def __init__(self, count: int) -> None:
        self.radiance = np.zeros((count, 3), np.float32)
        self.known = np.zeros(count, np.bool_)


def _shade(
    gaussians: Gaussians, shader: Shader, camera: Camera, seen: NDArray[np.bool_], kept: KeptRadiance | None
) -> Floats32:
    if kept is None:
        return shader.shade(gaussians, camera.position, seen)
    fresh = seen & ~kept.known
    if fresh.any():
        kept.radiance[fresh] = shader.shade(gaussians, camera.position, fresh)[fresh]
        kept.known |= fresh
    return kept.radiance
