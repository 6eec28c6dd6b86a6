import numba
import numpy as np
import pytest

from rnd_runtime.core.errors import InputError
from rnd_runtime.shading.shadow import directional_visibility
from support.shading_scenes import fibonacci_sphere

SPACING = 0.015  # m between sampled points
HAIR = 0.5e-6  # m; a float32 of half a metre is known to 0.03e-6


DIRECTIONS = fibonacci_sphere(8)

# A person with the arms down, metres: (start, end, radius). The limbs come within a radius of the torso.
CAPSULES = [
    ((0, 0.95, 0), (0, 1.35, 0), 0.15),
    ((0, 1.58, 0), (0, 1.68, 0.02), 0.10),
    ((0.10, 0.90, 0), (0.12, 0.05, 0), 0.075),
    ((-0.10, 0.90, 0), (-0.14, 0.05, 0.05), 0.075),
    ((0.19, 1.38, 0), (0.27, 1.10, 0.03), 0.05),
    ((0.27, 1.10, 0.03), (0.22, 0.90, 0.20), 0.04),
    ((-0.19, 1.38, 0), (-0.30, 1.12, 0.10), 0.05),
    ((-0.30, 1.12, 0.10), (-0.05, 1.15, 0.30), 0.04),
]


def capsule_surface(start, end, radius):
    """Points and normals on one capsule at about SPACING."""
    start, end = np.array(start, float), np.array(end, float)
    axis = end - start
    length = np.linalg.norm(axis)
    axis /= length
    side = np.cross(axis, [0.0, 0, 1] if abs(axis[2]) < 0.9 else [1.0, 0, 0])
    side /= np.linalg.norm(side)
    other = np.cross(axis, side)
    cap = fibonacci_sphere(int(4 * np.pi * radius**2 / SPACING**2))
    cap = cap[:, :1] * side + cap[:, 1:2] * other + cap[:, 2:] * axis
    rings, around = int(length / SPACING) + 1, int(2 * np.pi * radius / SPACING)
    angle, height = (g.ravel() for g in np.meshgrid(np.arange(around) * 2 * np.pi / around, np.arange(rings) / rings))
    tube = np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * other
    points = [np.where(cap @ axis > 0, 1, 0)[:, None] * (end - start) + start + radius * cap]
    points.append(start + height[:, None] * (end - start) + radius * tube)
    return np.concatenate(points), np.concatenate([cap, tube])


def distance_to_capsule(points, start, end, radius):
    start, end = np.array(start, float), np.array(end, float)
    axis = end - start
    along = np.clip((points - start) @ axis / (axis @ axis), 0, 1)
    return np.linalg.norm(points - start - along[:, None] * axis, axis=-1) - radius


def capsule_person():
    points, normals = (np.concatenate(a) for a in zip(*[capsule_surface(*capsule) for capsule in CAPSULES]))
    outside = np.min([distance_to_capsule(points, *capsule) for capsule in CAPSULES], axis=0) > -1e-6
    return points[outside], normals[outside]


def traced_visibility(points, normals, direction):
    """Exact by sphere tracing the union's distance, which a step of that distance never crosses."""
    visible = normals @ direction > 0
    index = np.flatnonzero(visible)
    position, travelled = points[index] + 1e-4 * normals[index], np.zeros(len(index))
    while len(index):
        distance = np.min([distance_to_capsule(position, *capsule) for capsule in CAPSULES], axis=0)
        visible[index[distance <= 1e-5]] = False
        go_on = (distance > 1e-5) & (travelled < 2)
        index, travelled = index[go_on], (travelled + distance)[go_on]
        position = (position + distance[:, None] * direction)[go_on]
    return visible


def test_a_sphere_lights_its_own_side_alone():
    points = fibonacci_sphere(8000)
    visibility = directional_visibility(points, points, DIRECTIONS, radii=np.sqrt(4 * np.pi / 8000))
    cosine = points @ DIRECTIONS.T
    assert visibility.shape == (8000, 8)
    assert visibility.dtype == np.float32
    assert visibility[cosine > 0.2].mean() > 0.99
    assert (visibility[cosine < 0] == 0).all()


@pytest.mark.parametrize("tilt", [0.0, 0.6])
def test_a_ball_shadows_its_cross_section_on_a_plane(tilt):
    grid = np.arange(-1, 1, SPACING)
    x, z = (g.ravel() for g in np.meshgrid(grid, grid))
    plane = np.stack([x, 0 * x, z], -1)
    radius = 0.25
    ball = fibonacci_sphere(int(4 * np.pi * radius**2 / SPACING**2))
    points = np.concatenate([plane, [0, 0.4, 0] + radius * ball])
    normals = np.concatenate([np.tile([0.0, 1, 0], (len(plane), 1)), ball])
    sun = np.array([[np.sin(tilt), np.cos(tilt), 0]])
    visibility = directional_visibility(points, normals, sun, radii=SPACING, resolution=512)[: len(plane), 0]
    shadow_area = np.sum(1 - visibility) * SPACING**2
    np.testing.assert_allclose(shadow_area, np.pi * radius**2 / np.cos(tilt), rtol=0.03)
    centre = -0.4 * np.tan(tilt)
    distance = np.hypot((x - centre) * np.cos(tilt), z)
    assert (visibility[distance < 0.9 * radius] == 0).all()
    assert (visibility[distance > 1.1 * radius] == 1).all()


def test_no_hairs_breadth_of_motion_switches_a_texel():
    grid = np.arange(-0.4, 0.4, SPACING)
    x, z = (g.ravel() for g in np.meshgrid(grid, grid))
    plane = np.stack([x, 0 * x, z], -1)
    ball = fibonacci_sphere(int(4 * np.pi * 0.25**2 / SPACING**2))
    normals = np.concatenate([np.tile([0.0, 1, 0], (len(plane), 1)), ball])
    seen = []
    for step in range(800):
        moved = [step * HAIR, 0.4, 0.5 * step * HAIR] + 0.25 * ball
        points = np.concatenate([plane, moved])
        seen.append(directional_visibility(points, normals, [[0.1, 1, 0]], radii=SPACING)[: len(plane), 0])
    assert np.abs(seen[-1] - seen[0]).max() > 0.2  # some texels left the shadow, or came into it ...
    assert np.abs(np.diff(seen, axis=0)).max() < 0.1  # ... by and by


def test_a_person_of_capsules_agrees_with_exact_tracing():
    points, normals = capsule_person()
    visibility = directional_visibility(points, normals, DIRECTIONS, radii=SPACING)
    exact = np.stack([traced_visibility(points, normals, direction) for direction in DIRECTIONS], -1)
    facing = normals @ DIRECTIONS.T > 0
    assert 0.6 < exact[facing].mean() < 0.95  # the scene does shadow itself
    agreement = ((visibility > 0.5) == exact)[facing]
    assert agreement.mean() > 0.985  # 0.995 with points every 12 mm; what is left are the shadows' edges


def test_points_of_no_radius_cast_nothing():
    points, normals = capsule_person()
    visibility = directional_visibility(points, normals, DIRECTIONS, radii=0.0)
    np.testing.assert_array_equal(visibility, normals @ DIRECTIONS.T > 0)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_what_is_not_finite_stays_dark_and_harms_nobody(bad):
    points = fibonacci_sphere(2000)
    radii = np.sqrt(4 * np.pi / 2000)
    clean = directional_visibility(points[1:], points[1:], DIRECTIONS, radii=radii)
    broken = points.copy()
    broken[0] = bad
    visibility = directional_visibility(broken, points, DIRECTIONS, radii=radii)
    assert (visibility[0] == 0).all()
    np.testing.assert_array_equal(visibility[1:], clean)


def test_wrong_shapes_are_refused():
    with pytest.raises(InputError, match="points and normals"):
        directional_visibility(np.zeros((4, 3)), np.zeros((5, 3)), [[0, 1, 0]], radii=0.1)
    with pytest.raises(InputError, match="directions"):
        directional_visibility(np.zeros((4, 3)), np.zeros((4, 3)), [0, 1, 0], radii=0.1)
    with pytest.raises(InputError, match="resolution"):
        directional_visibility(np.zeros((4, 3)), np.zeros((4, 3)), [[0, 1, 0]], radii=0.1, resolution=4)


SUN = np.array([0.3, 0.9, 0.0]) / np.hypot(0.3, 0.9)


@pytest.mark.parametrize("height", [1.3, 6.0])
def test_another_body_shadows_what_a_ray_to_the_light_meets(height):
    """A screen above a ball, against rays; in one map, as bodies of a scene share one."""
    ball = fibonacci_sphere(4 * 3000)
    x, z = (g.ravel() for g in np.meshgrid(*2 * [np.arange(-0.4, 0.4, SPACING)]))
    screen = np.stack([x + height * SUN[0] / SUN[1], np.full_like(x, height), z], -1).astype(np.float32)
    up = np.tile(np.float32([0, 1, 0]), (len(screen), 1))
    points, normals = np.concatenate([ball, screen]), np.concatenate([ball, up])
    radii = np.repeat(np.float32([np.sqrt(4 * np.pi / len(ball)), SPACING]), [len(ball), len(screen)])
    alone = directional_visibility(ball, ball, [SUN], radii=radii[: len(ball)])[:, 0]
    shaded = directional_visibility(points, normals, [SUN], radii=radii)[: len(ball), 0]
    hit = ball + ((height - ball[:, 1]) / SUN[1])[:, None] * SUN - screen.mean(axis=0)  # on the screen's plane
    inside = np.abs(hit[:, [0, 2]]).max(axis=1)
    assert ((inside < 0.37) & (alone > 0)).sum() > 100
    assert (shaded[inside < 0.37] == 0).all()
    np.testing.assert_array_equal(shaded[inside > 0.43], alone[inside > 0.43])


def test_others_than_receivers_cast_and_stay_dark():
    points, normals = capsule_person()
    every = directional_visibility(points, normals, DIRECTIONS, radii=SPACING)
    receivers = np.arange(len(points)) % 3 == 0
    some = directional_visibility(points, normals, DIRECTIONS, radii=SPACING, receivers=receivers)
    np.testing.assert_array_equal(some, np.where(receivers[:, None], every, 0))
    with pytest.raises(InputError, match="chosen Gaussians: expected shape"):
        directional_visibility(points, normals, DIRECTIONS, radii=SPACING, receivers=receivers[:-1])


def test_threads_change_no_bit():
    points, normals = capsule_person()
    before = numba.get_num_threads()
    try:
        numba.set_num_threads(1)
        alone = directional_visibility(points, normals, DIRECTIONS, radii=SPACING)
    finally:
        numba.set_num_threads(before)
    np.testing.assert_array_equal(directional_visibility(points, normals, DIRECTIONS, radii=SPACING), alone)
