"""Advice to players: the n·v below which Gaussians of the body's far side may be culled."""

from __future__ import annotations

import msgspec
import numpy as np
import onnx

from rnd_runtime.avatar.avatar import Avatar
from rnd_runtime.avatar.file import ADVICE_KEY, PlayerAdvice
from rnd_runtime.core.images import Floats, linear_to_srgb
from rnd_runtime.motion.motion import Motion
from rnd_runtime.playback.frame import FrameRenderer
from rnd_runtime.shading.light import Light

from .views import views_around

COSINES = (-0.3, -0.4, -0.5, -0.6, -0.7, -0.8)  # candidates; closer to 0 outlines fray
MAX_DIFFERENCE = 1 / 255  # root mean square over all pixels, of sRGB from 0 to 1
SIZE = 512


def find_cull(avatar: Avatar, motion: Motion) -> float | None:
    """The largest of ``COSINES`` that changes images of ``avatar`` by at most ``MAX_DIFFERENCE``, or None.

    The views are along ``motion`` and all around, ``SIZE`` pixels wide, under the learned light.
    """
    around = views_around(motion, (SIZE, SIZE), lambda time: avatar.pose(motion, time))
    views = [*around.search, *around.held_out]
    renderer = FrameRenderer(avatar, Light(avatar.trained_light), views[0].camera, cull=-1)

    def images() -> list[Floats]:
        rendered = []
        for view in views:
            renderer.camera = view.camera
            radiance = renderer.render(motion, view.time).radiance
            rendered.append(linear_to_srgb(np.clip(radiance, 0, 1)))
        return rendered

    full = images()
    for cosine in COSINES:
        renderer.cull = cosine
        squares = [np.mean((culled - reference) ** 2) for culled, reference in zip(images(), full)]
        if np.mean(squares) <= MAX_DIFFERENCE**2:
            return cosine
    return None


def add_advice(model: onnx.ModelProto, cull: float | None) -> None:
    """Write ``cull`` into ``model``, unless it is None or −1."""
    if cull is not None and cull > -1:
        advice = msgspec.json.encode(PlayerAdvice(cull=cull)).decode()
        model.metadata_props.add(key=ADVICE_KEY, value=advice)
