"""The embedded avatar, its walk and its sky, read once."""

from __future__ import annotations

import pytest

from rnd_runtime.avatar.avatar import Avatar
from rnd_runtime.motion.motion import load_motion
from rnd_runtime.shading.files.load import load_light
from support.paths import ASSETS


@pytest.fixture(scope="session")
def avatar():
    return Avatar.load(ASSETS / "avatar.onnx")


@pytest.fixture(scope="session")
def motion(avatar):
    return load_motion(ASSETS / "walk.npz", avatar.skeleton)


@pytest.fixture(scope="session")
def sky():
    return load_light(ASSETS / "sky.exr")
