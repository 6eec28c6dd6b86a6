"""One small production, rendered once for all tests of the light stage."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from support.paths import ASSETS

SMALL = {"subject": 0, "frames": 5, "cameras": 2, "size": 64, "samples": 9}  # seconds, not minutes


@pytest.fixture(scope="session")
def recipe():
    """A coarse person, two cameras, one coloured light."""
    mitsuba = pytest.importorskip("mitsuba")
    pytest.importorskip("skimage")
    mitsuba.set_variant("scalar_rgb")
    from rnd_stage.film.plan import Recipe

    return Recipe(**SMALL, lights=("red",), relight_cameras=1, step=0.018)


@pytest.fixture(scope="session")
def production(recipe, tmp_path_factory):
    """Twenty frames of the dance, five of which are rendered."""
    from rnd_runtime.capture.body import Body
    from rnd_runtime.motion.motion import save_motion
    from rnd_stage.film.dances import dance
    from rnd_stage.film.film import prepare

    folder, body = tmp_path_factory.mktemp("recipe"), Body.load(ASSETS / "body.npz")
    motion = dance(body.skeleton)
    part = replace(motion, rotations=motion.rotations[60:80], translations=motion.translations[60:80])
    save_motion(folder / "part.npz", part)
    return prepare(replace(recipe, motion=str(folder / "part.npz")), folder, body)


@pytest.fixture(scope="session")
def filmed(production, tmp_path_factory) -> Path:
    """The folder of its capture."""
    from rnd_stage.film.film import film
    from rnd_stage.film.manifest import write_manifest

    folder = tmp_path_factory.mktemp("filmed")
    film(production, folder, on_image=lambda name: None)
    assert write_manifest(production, folder, "scalar_rgb", None)
    return folder
