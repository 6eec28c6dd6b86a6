"""Shadows on the ground against rays through spheres in float64, and a body's against Mitsuba."""

from __future__ import annotations

import math

import numpy as np
import pytest

from rnd_bench.ground.judge import (
    GROUND,
    TURNS,
    Traced,
    body_surface,
    edge_pixels,
    lights,
    played,
    posed_body,
    shadow_db,
    surface,
    traced,
    view,
)
from rnd_runtime.core.camera import Camera
from rnd_runtime.ground import sky
from rnd_runtime.ground.lookup import sky_light
from rnd_runtime.ground.several import remaining_of_several
from rnd_runtime.ground.shadow import GroundLight, Map, Shadow, _cast, remaining_light
from rnd_runtime.ground.stand_in import BANDS, StandIn
from rnd_runtime.shading.light import Light
from support.shading_scenes import probe, rotation
from support.tiny import body

MITSUBA_DB = 30.0
EDGE_PIXELS = 1.0
SUN_EDGE = 0.07  # share of a shadow's area that its one-cell edge may cover differently
SKY_ERROR = 0.12  # mean over the ground, of the mean share
RADIUS = 0.045


def spheres(count, low, high) -> StandIn:
    """In the plane's axes, from low to high."""
    places = np.random.default_rng(3).uniform(low, high, (count, 3))
    places = places[np.argsort(places[:, 2])]
    starts = np.concatenate([[0], np.searchsorted(places[:, 2], BANDS), [count]])
    return StandIn(np.float32(np.column_stack([places, np.full(count, RADIUS)])), starts)


def blocked(points, discs, towards) -> np.ndarray:
    """Whether a sphere is met from ``points`` [..., 2] of the plane ``towards`` [3]."""
    offset = (
        discs[:, :3].astype(np.float64) - np.concatenate([points, np.zeros((*points.shape[:-1], 1))], -1)[..., None, :]
    )
    nearest = offset - (offset @ towards)[..., None] * towards
    return (np.linalg.norm(nearest, axis=-1) < discs[:, 3]).any(-1)


def centres(map_: Map) -> np.ndarray:
    """[I, J, 2] m in the plane's axes."""
    rows, columns = np.meshgrid(*(np.arange(n) for n in map_.values.shape[:2]), indexing="ij")
    return (np.stack([rows, columns], -1) - map_.to_cells[:, 2]) @ np.linalg.inv(map_.to_cells[:, :2]).T


@pytest.mark.parametrize("elevation", [20, 50, 90])
@pytest.mark.parametrize("azimuth", [0.4, 2.5])
def test_projected_spheres_block_the_suns_rays_that_hit_them(elevation, azimuth):
    discs = spheres(12, [-0.3, -0.3, 0.1], [0.3, 0.3, 1.6])
    sine, cosine = math.sin(math.radians(elevation)), math.cos(math.radians(elevation))
    towards = np.array([cosine * math.cos(azimuth), cosine * math.sin(azimuth), sine])
    cast = _cast(discs, towards, 0.0, 0.004)
    hit = blocked(centres(cast), discs.discs, towards)
    assert hit.any() and not hit[[0, -1]].any() and not hit[:, [0, -1]].any()  # the map holds all of it
    assert np.abs(cast.values - hit).mean() < SUN_EDGE * hit.mean()


def test_a_wide_sun_blurs_and_conserves_its_shadow():
    discs = spheres(6, [-0.3, -0.3, 1.1], [0.3, 0.3, 1.4])
    sharp, soft = (_cast(discs, np.array([0.3, 0.4, 0.866]), spread, 0.01) for spread in (0.0, 0.04))
    area = [np.abs(np.linalg.det(np.linalg.inv(m.to_cells[:, :2]))) * m.values.sum() for m in (sharp, soft)]
    np.testing.assert_allclose(area[1], area[0], rtol=0.02)
    assert soft.values.max() < 0.8 < sharp.values.max()


def test_the_sky_is_blocked_where_its_rays_hit_spheres():
    heights = np.arange(0, 1.6, 0.02)
    legs = [np.column_stack([0 * heights + i, j + 0.1 * heights, heights]) for i in (-0.05, 0.0) for j in (-0.2, 0.15)]
    discs = np.float32(np.pad(np.concatenate(legs), ((0, 0), (0, 1)), constant_values=RADIUS))
    count = np.arange(64) + 0.5
    radius, azimuth = 0.94 * np.sqrt(count / 64), count * 2.4  # lower, discs of spheres are too short
    directions = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), np.sqrt(1 - radius**2)], 1)
    shares = np.float32(np.random.default_rng(1).uniform(0, 2 / 64, (64, 3)))
    centre = np.float32([0.1, -0.2])
    values = sky.sky_map(discs, centre, np.float32(directions), shares)
    cells = (np.arange(sky.CELLS) + 0.5) * sky.CELL - sky.REACH
    points = np.stack(np.meshgrid(cells + centre[0], cells + centre[1], indexing="ij"), -1)[28:68, 28:68]
    hit = np.stack([blocked(points, discs, direction) for direction in directions], -1).astype(float)
    expected = hit @ shares.astype(np.float64)
    error = (values[28:68, 28:68, :3] - expected).reshape(10, 4, 10, 4, 3).mean((1, 3))  # a cell is a mean, no sample
    assert expected.max() > 0.3 and (values[..., 3] == 0).all()
    assert np.abs(error).mean() < SKY_ERROR * expected.mean() and abs(error.mean()) < 0.09 * expected.mean()


@pytest.mark.parametrize("step", [1, 5])
@pytest.mark.parametrize("eye", [[0.5, 1.8, 2.5], [0.0, 0.4, -3.0], [0.2, 4.0, 0.1]])
def test_pixels_read_the_map_where_they_see_the_ground(eye, step):
    camera = Camera.look_at(eye, [0.1, 0.2, 0.0], width=57, height=43, fov_y=1.0)
    rows, columns = np.meshgrid(np.arange(8.0), np.arange(6.0), indexing="ij")
    values = np.float32(np.stack([0.05 * rows, 0.03 * columns, 0.01 * (rows + columns), 0 * rows], -1))
    to_cells = np.array([[2.1, 0.4, 3.5], [-0.3, 1.9, 2.5]])
    image = Shadow(GROUND, Map(values, to_cells), (), 1e-6 if step > 1 else 1.0).remaining(
        camera, np.empty((43, 57, 3), np.float32)
    )
    u, v = np.meshgrid(np.arange(57) + 0.5, np.arange(43) + 0.5)
    rays = np.stack([u, v, np.ones_like(u)], -1) @ camera.rays
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = -camera.position[1] / rays[..., 1]
        point = (camera.position + depth[..., None] * rays) @ GROUND.axes[:2].T
        i, j = np.moveaxis(point @ to_cells[:, :2].T + to_cells[:, 2], -1, 0)
    inside = (depth > 0) & (i >= 0) & (i <= 7) & (j >= 0) & (j <= 5)
    expected = 1 - np.where(inside[..., None], np.stack([0.05 * i, 0.03 * j, 0.01 * (i + j)], -1), 0)
    assert 0.1 < inside.mean() < 1
    np.testing.assert_allclose(image, expected, atol=1e-5 if step == 1 else 0.02)


def test_rows_that_see_nothing_of_a_map_stay_their_own():
    to_map = np.array([[-6.8e-3, 0.18, -60.0], [0.025, 0.11, -39.0], [6e-21, 1.4e-3, -0.36]])  # almost level
    values = np.full((120, 120, 4), 0.5, np.float32)
    image = np.full((512, 512, 3), np.nan, np.float32)
    sky_light(to_map, values, 5, image)
    assert (image[:250] == 1).all() and np.isin(np.round(image, 6), [0.5, 1]).all()


def test_a_shadow_turns_and_moves_with_its_frame():
    gaussians, radii = body_surface(*posed_body(body(), 0.0))
    root = np.eye(4)
    root[:3, :3], root[:3, 3] = rotation(5), [0.3, -0.2, 0.5]
    local = (gaussians.means - root[:3, 3]) @ root[:3, :3], gaussians.normals @ root[:3, :3]
    turned = surface(*local, radii)[0]
    light = GroundLight(probe(sun=400.0))
    camera = Camera.look_at([1.5, 1.8, 2.5], [0, 0.3, 0], width=64, height=48, fov_y=0.9)
    here = remaining_light(light.shadow(gaussians, radii, GROUND, np.eye(3)), camera)
    there = light.shadow(turned, radii, GROUND.in_frame(root), root[:3, :3])
    there = remaining_light(there, camera.in_frame(root))
    assert here.min() < 0.5 and here.max() == 1
    assert np.abs(here - there).mean() < 0.01  # the sky's cells lie elsewhere


@pytest.mark.parametrize("eye", [[0.5, 1.6, 6.0], [0.2, 0.6, 0.8]])
def test_one_of_several_shadows_is_the_body_s_own_in_a_part_of_the_image(eye):
    """From afar its region is a part of the image; from among the body's own shadow it is all."""
    light = GroundLight(probe(sun=400.0))
    shadow = light.shadow(*body_surface(*posed_body(body(), 0.0)), GROUND, np.eye(3))
    camera = Camera.look_at(eye, [0, 0, 0], width=200, height=120, fov_y=0.9)
    alone = remaining_light(shadow, camera)
    np.testing.assert_allclose(remaining_of_several([shadow], light, camera), alone, atol=1e-5)
    rows, columns = shadow.region(camera)
    outside = np.ones(alone.shape[:2], bool)
    outside[rows, columns] = False
    assert (alone[outside] == 1).all() and (alone < 0.9).any()
    assert outside.any() == (eye[2] > 3)


def test_a_turned_light_is_split_once():
    light = probe(sun=400.0)
    turned, again = GroundLight(light).with_yaw(light.with_yaw(1.1)), GroundLight(light.with_yaw(1.1))
    np.testing.assert_array_equal(turned.sky, again.sky)
    assert len(turned.suns) == len(again.suns) == 1
    for one, other in zip(turned.suns[0], again.suns[0]):
        np.testing.assert_allclose(one, other, rtol=1e-12)


def test_without_light_or_body_nothing_is_shadowed():
    gaussians, radii = body_surface(*posed_body(body(), 0.0))
    camera = Camera.look_at([1.5, 1.8, 2.5], [0, 0.3, 0], width=16, height=16, fov_y=0.9)
    dark = GroundLight(Light(np.zeros((16, 32, 3), np.float32)))
    assert dark.shadow(gaussians, radii, GROUND, np.eye(3)) is None
    shadow = GroundLight(probe(sun=400.0)).shadow(gaussians, 0 * radii, GROUND, np.eye(3))
    assert (remaining_light(shadow, camera) == 1).all()


def test_edges_are_told_apart_by_pixels():
    visible = np.ones((40, 40), bool)
    shades = [np.ones((40, 40, 3), np.float32) for _ in range(3)]
    for shade, edge in zip(shades, (20, 20, 23)):
        shade[10:30, 10:edge] = 0
    assert edge_pixels(shades[0], Traced(shades[1], visible)) == (0, 0)
    mean, largest = edge_pixels(shades[2], Traced(shades[1], visible))
    assert largest == 2.5 and 0 < mean < largest


@pytest.mark.slow
@pytest.mark.parametrize("pose", TURNS)
@pytest.mark.parametrize("kind", ["sky", "window", "sun and sky", "sun"])
def test_a_bodys_shadow_agrees_with_mitsuba(kind, pose):
    pytest.importorskip("mitsuba")
    light, bare = lights()[kind], posed_body(body(), TURNS[pose])
    theirs = traced(light, *bare, view(96), 128)
    ours = played(light, *bare, view(96))
    assert theirs.remaining[theirs.visible].min() < 0.8
    assert shadow_db(ours, theirs) > MITSUBA_DB
    assert edge_pixels(ours, theirs)[0] < EDGE_PIXELS
