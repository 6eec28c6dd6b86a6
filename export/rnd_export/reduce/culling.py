"""How much of a body's back its file may tell players to leave out."""

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

from .shots import shots_around

COSINES = (-0.3, -0.4, -0.5, -0.6, -0.7, -0.8)
"""n·v below which Gaussians may be left out; nearer to 0 outlines begin to fray"""
MOST_DIFFERENT = 1 / 255
"""root mean square over all pixels, of sRGB from 0 to 1"""
SIZE = 512


def advised_cull(avatar: Avatar, motion: Motion) -> float | None:
    """The greatest of ``COSINES`` that changes pictures of ``avatar`` by no more than ``MOST_DIFFERENT``.

    They are taken all along ``motion`` and from all around, of ``SIZE`` pixels that the body fills, under the light
    that was learned. None where no cosine does: a body with holes, or one that is seen through.
    """
    around = shots_around(motion, SIZE, lambda time: avatar.pose(motion, time))
    shots = [*around.seen, *around.held_out]
    renderer = FrameRenderer(avatar, Light(avatar.trained_light), shots[0].camera, cull=-1)

    def pictures() -> list[Floats]:
        drawn = []
        for shot in shots:
            renderer.camera = shot.camera
            radiance = renderer.render(motion, shot.time).radiance
            drawn.append(linear_to_srgb(np.clip(radiance, 0, 1)))
        return drawn

    whole = pictures()
    for cosine in COSINES:
        renderer.cull = cosine
        squares = [np.mean((culled - all_) ** 2) for culled, all_ in zip(pictures(), whole)]
        if np.mean(squares) <= MOST_DIFFERENT**2:
            return cosine
    return None


def advise(model: onnx.ModelProto, cull: float | None) -> None:
    """Write ``cull`` into ``model`` for players; nothing is written for None or −1, which leave nothing out."""
    if cull is not None and cull > -1:
        advice = msgspec.json.encode(PlayerAdvice(cull=cull)).decode()
        model.metadata_props.add(key=ADVICE_KEY, value=advice)
