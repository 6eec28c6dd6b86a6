"""Shadows on the ground against rays through spheres in float64, and a body's against Mitsuba."""

from __future__ import annotations

import math

import numpy as np
import pytest

from rnd_runtime.capture.body import skin
from rnd_runtime.core.camera import Camera
from rnd_runtime.core.gaussians import Gaussians
from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_runtime.ground.kernels import project
from rnd_runtime.ground.shadow import GroundLight, Plane, Spheres, _frame, _grid_towards, remaining_light
from rnd_runtime.motion.skeleton import bone_transforms
from rnd_runtime.shading.light import Light
from support.shading_scenes import probe, rotation
from support.tiny import body

UP = Plane(np.array([0.0, 1.0, 0.0]), 0.0)
MITSUBA_DB = 30.0
SUN_EDGE = 0.05  # share of a shadow's area that its one-cell edge may cover differently


def surface(points, normals, radii) -> tuple[Gaussians, np.ndarray]:
    """Opaque Gaussians with discs of ``radii`` around them."""
    count = len(points)
    covariances = np.zeros((count, 6))
    covariances[:, [0, 3, 5]] = (0.6 * radii[:, None]) ** 2
    visibility, rest = np.zeros((count, 16)), np.full((count, 3), 0.5)
    arrays = points, covariances, np.ones(count), normals, rest, np.full(count, 0.9), visibility, np.eye(3)
    return Gaussians(*(np.asarray(a, np.float32) for a in arrays)), np.asarray(radii, np.float32)


def posed_body(turn: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [V, 3] and faces of the embedded body, an arm raised, its feet on the ground."""
    template = body()
    angles = np.zeros((len(template.skeleton), 3))
    angles[0, 1] = turn
    angles[template.skeleton.names.index("left_shoulder"), 2] = 0.9
    bones = bone_transforms(template.skeleton, axis_angle_to_matrix(angles), np.zeros(3)).astype(np.float64)
    vertices = skin(template.vertices, template.skinning_weights, bones)
    return vertices - [0, vertices[:, 1].min(), 0], template.faces


def body_surface(vertices, faces) -> tuple[Gaussians, np.ndarray]:
    corners = vertices[faces]
    crosses = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(crosses, axis=1) / 2
    normals = crosses / np.maximum(2 * areas, 1e-12)[:, None]
    return surface(corners.mean(1), normals, 0.8 * np.sqrt(areas))


@pytest.mark.parametrize("elevation", [20, 50, 90])
@pytest.mark.parametrize("azimuth", [0.4, 2.5])
def test_projected_spheres_block_the_rays_that_hit_them(elevation, azimuth):
    rng = np.random.default_rng(3)
    spheres = Spheres(np.float32(rng.uniform([-0.3, 0.1, -0.3], [0.3, 1.2, 0.3], (12, 3))), np.float32([0.11] * 12))
    sine, cosine = math.sin(math.radians(elevation)), math.cos(math.radians(elevation))
    towards = np.array([cosine * math.cos(azimuth), sine, cosine * math.sin(azimuth)])
    grid = _grid_towards(spheres, UP, towards)
    share = np.array([[0.2, 0.5, 1.0]], np.float32)
    kept = np.float32(towards[None]), share, np.float32(0), np.array([0, 12])
    project(*spheres, *_frame(grid, UP), *kept, grid.values)

    cells = np.stack(np.meshgrid(*(np.arange(n) + 0.5 for n in grid.values.shape[:2]), indexing="ij"), -1)
    ground = grid.origin + cells @ np.stack([grid.along, grid.across])
    offset = spheres.centres[:, None, None].astype(np.float64) - ground
    nearest = offset - (offset @ towards)[..., None] * towards
    blocked = (np.linalg.norm(nearest, axis=-1) < 0.11).any(0)
    assert blocked.any() and not blocked[[0, -1]].any() and not blocked[:, [0, -1]].any()  # the grid holds all of it
    assert np.abs(grid.values[..., 2] - blocked).mean() < SUN_EDGE * blocked.mean()
    np.testing.assert_allclose(grid.values[..., 0], 0.2 * grid.values[..., 2], atol=1e-6)


def test_a_shadow_turns_and_moves_with_its_frame():
    gaussians, radii = body_surface(*posed_body())
    root = np.eye(4)
    root[:3, :3], root[:3, 3] = rotation(5), [0.3, -0.2, 0.5]
    local = (gaussians.means - root[:3, 3]) @ root[:3, :3], gaussians.normals @ root[:3, :3]
    turned = surface(*local, radii)[0]
    light = GroundLight(probe(sun=400.0))
    camera = Camera.look_at([1.5, 1.8, 2.5], [0, 0.3, 0], width=64, height=48, fov_y=0.9)
    here = remaining_light(light.shadow(gaussians, radii, UP, np.eye(3)), UP, camera)
    plane = UP.in_frame(root)
    there = remaining_light(light.shadow(turned, radii, plane, root[:3, :3]), plane, camera.in_frame(root))
    assert here.min() < 0.5 and here.max() == 1
    assert np.abs(here - there).mean() < 0.01  # the sky's cells lie elsewhere


def test_a_turned_light_is_split_once():
    light = probe(sun=400.0)
    turned, again = GroundLight(light).with_yaw(light.with_yaw(1.1)), GroundLight(light.with_yaw(1.1))
    np.testing.assert_array_equal(turned.sky, again.sky)
    assert len(turned.suns) == len(again.suns) == 1
    for one, other in zip(turned.suns[0], again.suns[0]):
        np.testing.assert_allclose(one, other, rtol=1e-12)


def test_without_light_or_body_nothing_is_shadowed():
    gaussians, radii = body_surface(*posed_body())
    camera = Camera.look_at([1.5, 1.8, 2.5], [0, 0.3, 0], width=16, height=16, fov_y=0.9)
    assert GroundLight(Light(np.zeros((16, 32, 3), np.float32))).shadow(gaussians, radii, UP, np.eye(3)) == []
    grids = GroundLight(probe(sun=400.0)).shadow(gaussians, 0 * radii, UP, np.eye(3))
    assert (remaining_light(grids, UP, camera) == 1).all()


@pytest.mark.slow
@pytest.mark.parametrize("turn", [0.0, 1.2])
@pytest.mark.parametrize("kind", ["sky", "window", "sun"])
def test_a_bodys_shadow_agrees_with_mitsuba(kind, turn):
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_rgb")
    light = {"sky": probe(), "window": Light(probe().radiance ** 2), "sun": probe(height=256, sun=8e4)}[kind]
    vertices, faces = posed_body(turn)
    eye, target, size, fov = [1.6, 2.2, 2.6], [0, 0.4, 0], 96, 50.0
    camera = Camera.look_at(eye, target, width=size, height=size, fov_y=math.radians(fov))
    gaussians, radii = body_surface(vertices, faces)
    ours = remaining_light(GroundLight(light).shadow(gaussians, radii, UP, np.eye(3)), UP, camera)

    mesh = mi.Mesh("body", len(vertices), len(faces))
    params = mi.traverse(mesh)
    params["vertex_positions"], params["faces"] = np.float32(vertices).ravel(), np.uint32(faces).ravel()
    params.update()
    scene = {
        "type": "scene",
        "integrator": {"type": "direct", "hide_emitters": True},
        "light": {
            "type": "envmap",
            "bitmap": mi.Bitmap(nodes_of(light)),
            "to_world": mi.ScalarTransform4f().rotate([0, 1, 0], 90),
        },
        "sensor": {
            "type": "perspective",
            "fov": fov,
            "to_world": mi.ScalarTransform4f().look_at(eye, target, [0, 1, 0]),
            "film": {
                "type": "hdrfilm",
                "width": size,
                "height": size,
                "rfilter": {"type": "box"},
                "pixel_format": "rgba",
            },
            "sampler": {"type": "independent", "sample_count": 256},
        },
    }
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], -90).scale([50, 50, 1])}
    objects = {"both": {"floor": floor, "body": mesh}, "floor": {"floor": floor}, "body": {"body": mesh}}
    image = {name: np.array(mi.render(mi.load_dict({**scene, **parts}))) for name, parts in objects.items()}
    ground = (image["body"][..., 3] == 0) & (image["floor"][..., :3].min(-1) > 0)
    theirs = image["both"][..., :3] / np.maximum(image["floor"][..., :3], 1e-9)
    error = (np.clip(theirs, 0, 1) - ours)[ground]
    assert theirs[ground].min() < 0.8
    assert -10 * math.log10(float(np.mean(error**2))) > MITSUBA_DB


def nodes_of(light: Light) -> np.ndarray:
    """The map as Mitsuba samples it: a node on either pole, columns from its −Z towards +X."""
    height, width = 1024, 2048
    azimuth = np.arange(width) / width * 2 * np.pi - np.pi
    polar = np.linspace(0, np.pi, height)[:, None]
    ring = np.sin(polar)
    directions = [ring * np.cos(azimuth), np.broadcast_to(np.cos(polar), (height, width)), ring * np.sin(azimuth)]
    return light.sample(np.stack(directions, -1))
