"""Posing and projection in GLSL against the float64 formulas and the CPU's kernel, on EGL and on OSMesa."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from rnd_runtime.core.camera import Camera
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.gaussians import Gaussians
from rnd_runtime.gl.posing import GlPosing
from rnd_runtime.gl.projection import GlProjection
from rnd_runtime.gl.raster import sorted_ellipses
from rnd_runtime.gl.surfaces import SurfaceUpload
from rnd_runtime.posing.reference import pose_reference
from rnd_runtime.posing.rest import Unposed
from rnd_runtime.raster.cpu import forward
from rnd_runtime.raster.project import pinhole
from rnd_runtime.shading.shader import shadow_radii
from support import gl_devices
from support.gl_devices import BACKENDS
from support.posing_scenes import BROKEN, broken_scene, posing_scene
from support.raster_scenes import off_centre_camera, random_scene

ROUNDING = 1e-5  # float32 against float64, relative to the largest entry: products of three 3×3 matrices, GPU's exp
PLACE = 2e-4  # px: float32 has 3e-5 at 500 px, and a point is turned before it is divided
SHAPE = 2e-3  # relative: Σxx − Σxy²/Σyy of needles cancels two digits or three
EDGE = 0.01  # share of Gaussians whose ellipse just reaches or just misses a pixel's centre


devices = gl_devices.devices(posing=GlPosing, upload=SurfaceUpload, projection=GlProjection)


@pytest.fixture(params=BACKENDS)
def device(request, devices):
    with devices[request.param].context as context:
        yield devices[request.param]
        assert context.error == "GL_NO_ERROR"


def _rows(texture, count, texels=1):
    return np.frombuffer(texture.read(), np.float32).reshape(-1, texels * texture.components)[:count]


def _drawn(projected):
    """The Gaussians of its ranks, back to front; a device that sorts leaves ranks over."""
    order = np.frombuffer(projected.order.read(), np.int32)[: projected.ranks]
    return order[order >= 0]


def _unposed(rest, inputs):
    count = len(rest.points)
    opacities = np.linspace(0.1, 1, count, dtype=np.float32)
    logits, offsets, visibility, bones = inputs
    albedo, roughness = np.full((count, 3), 0.5, np.float32), np.full(count, 0.4, np.float32)
    return Unposed(rest, logits, offsets, visibility, bones, opacities, albedo, roughness)


@pytest.mark.parametrize("template_only", [False, True])
@pytest.mark.parametrize(
    ("joints", "harmonics", "count"), [(24, 16, 3000), (2, 1, 1), (16, 9, 1025), (55, 16, 300), (33, 4, 257)]
)
def test_posing_is_the_float64_formula(device, joints, harmonics, count, template_only):
    rest, inputs = posing_scene(joints, harmonics=harmonics, count=count, nodes=500)
    if template_only:
        inputs = (None, *inputs[1:])
    unposed = _unposed(rest, inputs)
    surfaces = device.posing.pose(unposed)
    means, covariances, normals, visibility = pose_reference(rest, *inputs)
    points, outward = _rows(surfaces.points, count), _rows(surfaces.normals, count)
    covariance = np.hstack([_rows(surfaces.covariances, count), _rows(surfaces.covariances_z, count)])
    radii = shadow_radii(
        Gaussians(means, covariances, unposed.opacities, normals, *3 * (means,), unposed.root_rotation)
    )
    for ours, exact in (
        (points[:, :3], means),
        (points[:, 3], radii),
        (covariance, covariances),
        (outward[:, :3], normals),
        (outward[:, 3], unposed.opacities),
        (_rows(surfaces.visibility, count, 4), visibility),
        (_rows(surfaces.materials, count), np.tile(np.float32([0.5, 0.5, 0.5, 0.4]), (count, 1))),
    ):
        assert ours.shape == exact.shape
        assert np.abs(ours - exact).max() <= ROUNDING * np.abs(exact).max()
    assert count == 1 or 0.2 < (radii > 0).mean() < 0.8


@pytest.mark.parametrize(("field", "value"), BROKEN)
def test_what_is_no_number_is_not_drawn(device, field, value):
    rest, inputs = broken_scene(field, value)
    surfaces, count = device.posing.pose(_unposed(rest, inputs)), len(rest.points)
    with np.errstate(all="ignore"):
        means, covariances, *_ = pose_reference(rest, *inputs)
    ours = [_rows(texture, count) for texture in (surfaces.points, surfaces.covariances, surfaces.covariances_z)]
    exact = np.hstack([means, covariances])
    assert (np.isfinite(np.hstack([ours[0][:, :3], *ours[1:]])).all(1) == np.isfinite(exact).all(1)).all()


def test_another_avatar_takes_the_place_of_the_last(device):
    scenes = [posing_scene(joints, count=count) for joints, count in ((24, 300), (16, 2000), (24, 40))]
    for rest, inputs in (*scenes, *scenes[::-1]):
        surfaces = device.posing.pose(_unposed(rest, inputs))
        means = pose_reference(rest, *inputs)[0]
        assert np.abs(_rows(surfaces.points, len(means))[:, :3] - means).max() <= ROUNDING * np.abs(means).max()


def test_more_joints_than_a_texture_holds_are_refused():
    rest, inputs = posing_scene(55)
    small = SimpleNamespace(info={"GL_MAX_TEXTURE_SIZE": 4096})
    with pytest.raises(InputError, match="joints: expected at most 16 with this OpenGL, got 55"):
        GlPosing(small).pose(_unposed(rest, inputs))


def _gaussians(scene, normals=None):
    means, covariances, opacities, albedo = scene
    count = len(means)
    normals = np.tile(np.float32([0, 0, 1]), (count, 1)) if normals is None else normals
    harmonics = np.zeros((count, 16), np.float32)
    roughness = np.full(count, 0.5, np.float32)
    return Gaussians(means, covariances, opacities, normals, albedo, roughness, harmonics, np.eye(3, dtype=np.float32))


@pytest.mark.parametrize(("width", "height"), [(96, 64), (511, 37), (1, 1)])
@pytest.mark.parametrize("eye", [(0.4, 0.3, -2.5), (0.1, 0.0, 0.1)])
def test_projection_is_the_cpus(device, width, height, eye):
    scene, camera = random_scene(1, 2500), off_centre_camera(width, height, eye)
    expected = sorted_ellipses(*scene, pinhole(camera))
    projected = device.projection.project(device.upload.write(_gaussians(scene)), camera, None)
    order = _drawn(projected)
    both = np.intersect1d(order, expected.order)
    assert len(both) >= (1 - EDGE) * max(len(order), len(expected.order)) - 2
    places, shapes = _rows(projected.positions, 2500)[both], _rows(projected.shapes, 2500)[both]
    centres, (shear, fall_y, fall_x, peak) = expected.centers[both], expected.shapes[both].T
    size = np.maximum(np.abs(centres).max(1, initial=0), 512) / 512
    from_middle = centres - [width / 2, height / 2]
    assert (np.abs(places[:, :2] - from_middle).max(1, initial=0) <= PLACE * size).all()
    np.testing.assert_allclose(places[:, 3], peak, atol=1e-5)
    np.testing.assert_allclose(places[:, 2] ** 2, peak + np.log2(255), atol=1e-4)
    np.testing.assert_allclose(shapes[:, 0] ** 2, fall_x, rtol=SHAPE)
    np.testing.assert_allclose(shapes[:, 1] ** 2, fall_y, rtol=SHAPE)
    np.testing.assert_allclose(shapes[:, 2], shear, rtol=SHAPE, atol=SHAPE)
    depths = (scene[0] @ camera.world_to_camera[2, :3] + camera.world_to_camera[2, 3])[order]
    assert len(order) < 2 or np.diff(depths).max() < 1e-6  # back to front


def test_equal_depths_are_drawn_by_index(device):
    camera = Camera.look_at([0, 0, 3], [0, 0, 0], width=32, height=32, fov_y=0.5)
    scene = (
        np.zeros((9, 3), np.float32),
        np.tile(np.float32([0.01, 0, 0, 0.01, 0, 0.01]), (9, 1)),
        np.full(9, 0.5, np.float32),
        np.ones((9, 3), np.float32),
    )
    projected = device.projection.project(device.upload.write(_gaussians(scene)), camera, None)
    np.testing.assert_array_equal(_drawn(projected)[::-1], np.arange(9))


def test_what_is_broken_behind_or_facing_away_has_no_rank(device):
    means, covariances, opacities, albedo = (array.copy() for array in random_scene(2, 60, spread=0.1))
    opacities[:] = 0.8
    camera = off_centre_camera(64, 64)
    normals = np.tile(np.float32(camera.position / np.linalg.norm(camera.position)), (60, 1))
    seen = device.projection.project(
        device.upload.write(_gaussians((means, covariances, opacities, albedo), normals)), camera, 0.5
    )
    splats = forward(means, covariances, opacities, albedo, camera)[1].splats
    assert seen.ranks == 60 == (np.diff(splats.slot_starts) > 0).sum()
    means[0, 0], means[1, 2], covariances[2, 1], covariances[3, 5], covariances[4] = (np.nan, np.inf, np.nan, np.inf, 0)
    opacities[5], opacities[6], opacities[7], normals[8] = np.nan, 0.003, np.inf, np.nan
    means[9], means[10] = 2 * camera.position, camera.position
    normals[11] = -normals[11]
    normals[12] = np.float32([0.9, -0.3, 0.1])
    projected = device.projection.project(
        device.upload.write(_gaussians((means, covariances, opacities, albedo), normals)), camera, 0.5
    )
    np.testing.assert_array_equal(np.sort(_drawn(projected)), np.arange(13, 60))
