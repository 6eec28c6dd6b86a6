"""People made by code, and their clothes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from support.paths import ASSETS

mi = pytest.importorskip("mitsuba")
pytest.importorskip("skimage")
mi.set_variant("scalar_rgb")

from rnd_runtime.capture.body import Body  # noqa: E402
from rnd_runtime.core.errors import InputError  # noqa: E402
from rnd_runtime.motion.skeleton import bone_transforms  # noqa: E402
from rnd_stage.cloth import SKIN_GAP, Capsules, Cloth, Drape  # noqa: E402
from rnd_stage.people import subjects  # noqa: E402
from rnd_stage.people.dressing import Wearer  # noqa: E402

pytestmark = pytest.mark.slow


def test_people_differ() -> None:
    people = [subjects.subject(seed) for seed in range(6)]
    assert len({person.title for person in people}) == 6
    assert len({person.palette.top.kind for person in people[:4]}) == 4
    points = Body.load(ASSETS / "body.npz").vertices
    shapes = np.array([person.shape.warp(points) for person in people])
    assert np.ptp(shapes[:4, :, 1].max(axis=1)) > 0.05  # heights
    assert subjects.subject(17) == subjects.subject(17) != subjects.subject(18)
    with pytest.raises(InputError, match="--subject"):
        subjects.subject(-1)


def sheet() -> tuple[np.ndarray, np.ndarray, np.ndarray, Drape]:
    """A square of cloth, 20 cm wide, lying 2 cm above the plane that carries it."""
    x, z = np.meshgrid(np.arange(-0.1, 0.1, 0.008), np.arange(-0.1, 0.1, 0.008))
    points = np.stack([x.ravel(), np.full(x.size, 0.02), z.ravel()], axis=1)
    count = len(points)
    drape = Drape(
        np.full(count, 0.05),
        np.full(count, 0.02),
        np.full(count, 0.04),
        np.ones(count, np.int64),
        np.zeros(count, bool),
    )
    return points, np.tile([0.0, 1, 0], (count, 1)), np.ones((count, 1)), drape


def moving(positions: np.ndarray) -> np.ndarray:
    bones = np.zeros((len(positions), 1, 3, 4), np.float32)
    bones[:, :, :, :3] = np.eye(3)
    bones[:, 0, :, 3] = positions
    return bones


def test_cloth_remembers_and_stays_out_of_the_body() -> None:
    points, normals, weights, drape = sheet()
    none = Capsules(np.zeros(0, np.int64), np.zeros((0, 2, 3)), np.zeros(0))
    cloth = Cloth(points, normals, weights, drape, none)
    still, swung = np.zeros((30, 3)), np.zeros((30, 3))
    swung[:, 0] = 0.3 * np.sin(np.arange(30) / 29 * 2 * np.pi)  # ends where the other stands
    a = cloth.simulate(moving(still), 30.0, [29])[29]
    b = cloth.simulate(moving(swung), 30.0, [29])[29]
    assert np.linalg.norm(a - b, axis=1).max() > 0.003  # the same pose, another history
    for moved in (a, b):
        assert (moved[:, 1] > -(0.02 - SKIN_GAP) - 1e-6).all()
        assert (np.linalg.norm(moved, axis=1) < 0.05 + 1e-9).all()
    np.testing.assert_array_equal(b, cloth.simulate(moving(swung), 30.0, [29])[29])
    assert a[:, 1].mean() < -0.005  # it sags onto what is below


def test_a_leg_that_comes_through_a_skirt_lifts_it_and_does_not_tear_it() -> None:
    """A leg rises faster than cloth falls aside: its axis is above the sheet, which still ends up over the leg."""
    points, normals, weights, drape = sheet()
    weights = np.concatenate([weights, 0 * weights], axis=1)
    drape = replace(drape, radius=np.full(len(points), 0.2), hangs=np.ones(len(points), bool))
    leg = Capsules(np.array([1]), np.array([[[0.003, -0.2, -0.3], [0.003, -0.2, 0.3]]]), np.array([0.05]))
    bones = np.concatenate([moving(np.zeros((20, 3)))] * 2, axis=1)
    bones[:, 1, 1, 3] = np.clip(np.arange(20) / 4, 0, 1) * 0.23  # to 1 cm above the sheet
    cloth = Cloth(points, normals, weights, drape, leg)
    moved = cloth.rest + cloth.simulate(bones, 30.0, [19])[19]
    over = np.abs(cloth.rest[:, 0]) < 0.03
    assert (moved[over, 1] > 0.05).all()
    pairs, lengths, _ = cloth.springs
    near = lengths < 0.019
    stretch = np.linalg.norm(moved[pairs[:, 0]] - moved[pairs[:, 1]], axis=1)[near] / lengths[near]
    assert stretch.max() < 2.5


def test_clothes_fold_with_the_pose(production) -> None:
    """The filmed shirt is off its skinned place, differently in different frames, and never far."""
    wearer = Wearer(production.dressed, production.motion, production.frames[:3])
    moves = [wearer._moves[frame] for frame in production.frames[:3]]
    for move in moves:
        assert 0.001 < np.linalg.norm(move, axis=1).mean() < 0.03
    assert np.linalg.norm(moves[0] - moves[2], axis=1).mean() > 0.001


def test_the_template_is_the_unclothed_body(production) -> None:
    """The capture's template, posed, lies inside the filmed surface: its clothes stand off, they do not sink in."""
    body, frame = production.dressed.body, production.frames[0]
    bones = bone_transforms(body.skeleton, production.motion.rotations[frame], production.motion.translations[frame])
    blend = np.tensordot(body.skinning_weights, bones, axes=1)
    posed = np.einsum("vij,vj->vi", blend[:, :, :3], body.vertices) + blend[:, :, 3]
    wearer = Wearer(production.dressed, production.motion, [frame])
    surface = wearer.surface(frame)
    _, nearest = cKDTree(surface.vertices).query(posed)
    outside = np.sum((posed - surface.vertices[nearest]) * surface.normals[nearest], axis=1)
    assert np.quantile(outside, 0.95) < 0.006  # m; an 18 mm mesh cuts off fingers, nose and toes
