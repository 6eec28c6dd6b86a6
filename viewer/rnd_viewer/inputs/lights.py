"""The light that a command's options name."""

from __future__ import annotations

import math
from pathlib import Path

from rnd_runtime.avatar.avatar import Avatar
from rnd_runtime.shading.files.load import load_light
from rnd_runtime.shading.light import Light, Up


def chosen_light(avatar: Avatar, probe: Path | None, *, up: Up, yaw: float, exposure: float) -> Light:
    """The light of ``probe``, or the learned light of ``avatar``.

    Args:
        up: which axis points up in the probe's file; the learnt light is Y up.
        yaw: degrees, from +X towards +Z.
        exposure: stops by which it is made brighter.
    """
    turn = math.radians(yaw)
    if probe is None:
        return Light(avatar.trained_light).scaled(2.0**exposure).with_yaw(turn)
    return load_light(probe, up=up, yaw=turn, exposure=exposure)
