"""Several people in one image, against all of their Gaussians taken to the world and splatted at once."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rnd_runtime.core.camera import Camera
from rnd_runtime.ground.shadow import Plane
from rnd_runtime.playback.far import MIN_PIXELS_PER_METRE, Extent, depth_groups
from rnd_runtime.playback.frame import FrameRenderer
from rnd_runtime.playback.scene import Person, SceneRenderer, chosen_levels, frame_people, greatest_sizes, place_at
from rnd_runtime.posing.levels import CULLED_LEVELS
from rnd_runtime.raster.cpu import rasterize
from rnd_runtime.raster.outline import sharpened
from rnd_runtime.shading.light import Light, texel_directions

TIME = 0.4  # s
TRIANGLE = np.triu_indices(3)
CAMERA = Camera.look_at([0.3, 1.4, 5.0], [0, 0.9, 0], width=320, height=370, fov_y=0.5)


def _sun(*direction: float) -> Light:
    """A grey sky and one texel towards ``direction``."""
    radiance = np.full((32, 64, 3), 0.01, np.float32)
    texel = np.argmax(texel_directions(32, 64) @ (np.array(direction) / np.linalg.norm(direction)))
    radiance.reshape(-1, 3)[texel] = 100
    return Light(radiance)


def _all_at_once(people, camera):
    """Albedo and alpha of everybody, posed and moved in the world."""
    arrays = []
    for person in people:
        posed = person.avatar.pose(person.motion, TIME - person.start)
        turn, shift = person.place[:3, :3], person.place[:3, 3]
        means = posed.means @ turn.T + shift
        upper = np.zeros((len(means), 3, 3))
        upper[:, *TRIANGLE] = upper[:, *TRIANGLE[::-1]] = posed.covariances
        covariances = (turn @ upper @ turn.T)[:, *TRIANGLE]
        arrays.append((means, covariances, posed.opacities, posed.albedo))
    whole = (np.concatenate(parts).astype(np.float32) for parts in zip(*arrays))
    return sharpened(rasterize(*whole, camera))


@pytest.mark.parametrize("swapped", [False, True])
def test_one_order_of_depth_for_everybody(avatar, motion, sky, swapped):
    """Two people who stand in one another's way, a third half behind them."""
    spots = [place_at(0.0, 0.15, 0.4), place_at(0.2, 0.0, -2.0), place_at(-0.3, -1.5, 0.0)]
    people = [Person(avatar, motion, 0.3 * k, at) for k, at in enumerate(spots[:: -1 if swapped else 1])]
    with FrameRenderer(avatar, sky, shade="ao", cull=-1) as renderer:
        scene = SceneRenderer(people, renderer, cull=-1)
        frame = scene.draw(scene.encode(TIME), CAMERA, aovs=("albedo", "depth"))
    expected = _all_at_once(people, CAMERA)
    np.testing.assert_allclose(frame.alpha, expected.alpha, atol=2e-3)
    difference = np.abs(frame.aovs["albedo"] - expected.image).max(axis=2)
    assert np.quantile(difference, 0.999) < 2e-3 and difference.max() < 0.1  # rounding may swap two Gaussians
    inside = expected.alpha > 0.9
    depth = expected.depth[inside] / expected.alpha[inside]
    np.testing.assert_allclose(frame.aovs["depth"][inside][:, 0], depth, atol=0.02)


def test_figures_of_few_pixels_are_in_order(avatar, motion, sky):
    """A row of people from 4 to 30 m, one behind the other, against a grid that is fine for everybody."""
    people = [
        Person(avatar, motion, 0.2 * k, place_at(0.1 * k, 1 - d, 0.5 * k)) for k, d in enumerate((0, 3, 8, 16, 26))
    ]
    camera = Camera.look_at([0.2, 1.7, 5.0], [0, 0.9, 0], width=150, height=150, fov_y=0.6)
    with FrameRenderer(avatar, sky, shade="ao", cull=-1) as renderer:
        scene = SceneRenderer(people, renderer, cull=-1)
        bodies = scene.encode(TIME)
        frame = scene.draw(bodies, camera, aovs=("albedo",))
        reverse = SceneRenderer(people[::-1], renderer, cull=-1)
        again = reverse.draw(bodies[::-1], camera, aovs=("albedo",))
    np.testing.assert_allclose(again.aovs["albedo"], frame.aovs["albedo"], atol=0.02)
    fine = _all_at_once(people, camera.resized(1200, 1200))
    albedo, alpha = (layer.reshape(150, 8, 150, 8, -1).mean(axis=(1, 3)) for layer in (fine.image, fine.alpha))
    np.testing.assert_allclose(frame.alpha.sum(), alpha.sum(), rtol=0.01)
    assert np.sqrt(np.mean((frame.aovs["albedo"] - albedo) ** 2)) < 0.012  # any other order: 0.03


def test_groups_are_composited_in_order_of_depth():
    near, far = Extent(2, 3, 1, 0, 0, 50, 90), Extent(8, 9, 3, 30, 20, 60, 40)
    aside = Extent(8.5, 9.5, 3, 70, 20, 90, 40)
    assert [group.bodies for group in depth_groups([far, near, aside])] == [[1], [0], [2]]
    through = near._replace(farthest=8.2)  # as somebody who lies: not completely in front of the second
    groups = depth_groups([far, through, aside])
    assert [group.bodies for group in groups] == [[0, 1], [2]]
    assert groups[0].extent == Extent(2, 9, 3, 0, 0, 60, 90)
    assert [group.bodies for group in depth_groups([far, aside, Extent(7, 8, 3, 55, 0, 75, 90)])] == [[0, 1, 2]]
    # who is behind a body that was moved to the finer grid follows it
    behind = Extent(3.5, 5, 1, 10, 0, 40, 80)
    assert [group.bodies for group in depth_groups([far, through, behind])] == [[0, 1, 2]]


def test_a_body_between_another_and_the_sun_shades_it(avatar, motion):
    """The sun in the west (−X) and low."""
    view = Camera.look_at([0, 1.2, 7.0], [0, 0.9, 0], width=240, height=160, fov_y=0.45)
    spots = [(-1.0, 0.0), (1.0, 0.0)]

    def light_of(people, side):
        scene = SceneRenderer(people, renderer)
        frame = scene.draw(scene.encode(TIME), view)
        return float(frame.radiance[:, :120].sum() if side == "left" else frame.radiance[:, 120:].sum())

    with FrameRenderer(avatar, _sun(-1, 0.05, 0), shade="table+sun") as renderer:
        left, right = (Person(avatar, motion, 0, place_at(x, z, np.pi / 2)) for x, z in spots)
        apart = Person(avatar, motion, 0, place_at(-1.0, 30.0, 0))  # behind the camera
        alone = light_of([right, apart], "right")
        assert light_of([right, left], "right") < 0.5 * alone
        assert light_of([left, right], "left") == pytest.approx(light_of([left, apart], "left"), rel=1e-3)


def test_one_person_is_the_avatar(avatar, motion, sky):
    with FrameRenderer(avatar, sky, CAMERA) as renderer:
        scene = SceneRenderer([Person(avatar, motion)], renderer)
        frame, alone = scene.draw(scene.encode(TIME), CAMERA), renderer.render(motion, TIME)
        np.testing.assert_array_equal(frame.radiance, alone.radiance)
        moved = SceneRenderer([Person(avatar, motion, 0.1, place_at(20.0, -4.0, 1.0))], renderer)
        camera = replace(CAMERA, world_to_camera=CAMERA.world_to_camera @ np.linalg.inv(place_at(20.0, -4.0, 1.0)))
        renderer.turn(-1.0)  # a turn from +X towards +Z is one to the right
        taken = moved.draw(moved.encode(TIME + 0.1), camera)
    np.testing.assert_allclose(taken.radiance, alone.radiance, atol=2e-3)


def test_a_heading_turns_to_the_left_and_the_camera_sees_everybody(avatar, motion):
    placed = place_at(3.0, -2.0, np.pi / 2)
    np.testing.assert_allclose(placed @ [0, 0, 1, 1], [4, 0, -2, 1], atol=1e-12)
    here, there = Person(avatar, motion), Person(avatar, motion, 1.0, placed)
    one, both = frame_people([there]), frame_people([here, there])
    assert one.facing == pytest.approx(frame_people([here]).facing + np.pi / 2)
    np.testing.assert_allclose(one.centre - [3, 0, -2], placed[:3, :3] @ frame_people([here]).centre, atol=1e-9)
    assert both.radius > one.radius and len(both.joints) == 2 * len(one.joints)
    assert there.frames_at(10) == here.frames_at(10) + 10


def test_nobody_hides_another_in_the_default_view(avatar, motion):
    """Who stands behind the first is shown beside him; who stands aside turns nothing."""
    first, behind, aside = (Person(avatar, motion, 0, place_at(x, z, 0)) for x, z in ((0, 0), (0, -2), (1.2, -2)))
    straight = frame_people([first]).facing
    assert frame_people([first, aside]).facing == straight
    turned = frame_people([first, behind]).facing - straight
    assert 0.25 < abs(turned) < 0.4 and 2 * np.sin(abs(turned)) > 0.6


def test_levels_follow_the_size_with_hysteresis():
    at = np.array([np.inf, 50.0, 25.0])  # px per metre up to which each is taken
    sizes = np.array(
        [2 * at[1], at[1] / 1.05, at[1] / 1.2, at[1] / 1.05, at[1] * 1.01, at[2] / 2, np.inf, at[2] / 1.05]
    )
    assert chosen_levels(sizes, at).tolist() == [0, 0, 1, 1, 0, 2, 0, 1]


def test_levels_have_fewer_and_fewer_nodes_and_gaussians(avatar):
    sizes = greatest_sizes(avatar)
    levels = [avatar.level(number) for number in range(len(sizes))]
    assert avatar.level(len(sizes)) is None
    nodes, culls = ([getattr(level, name) for level in levels[1:]] for name in ("nodes", "advice"))
    first = [-(-avatar.nodes // share) for share, _ in CULLED_LEVELS]
    assert nodes == first + [first[-1]] * (len(nodes) - len(first))
    assert [advice.cull for advice in culls[: len(first)]] == [cull for _, cull in CULLED_LEVELS]
    assert culls[-1] == culls[len(first) - 1] and avatar.advice.cull is None
    merged = levels[len(first) :]
    assert merged[0].gaussians == avatar.gaussians and (np.diff([level.gaussians for level in merged]) < 0).all()
    assert sizes[0] == np.inf and (np.diff(sizes) < 0).all()


def test_far_people_get_coarser_levels_and_parts_of_a_run_the_same(avatar, motion):
    """A camera that retreats: levels grow, by the first frame on the same in every part."""
    people = [Person(avatar, motion), Person(avatar, motion, 0, place_at(0.5, -40, 0))]

    def camera_at(frame: int, time: float) -> Camera:
        return Camera.look_at([0, 1, 6 + 12 * frame], [0, 1, 0], width=400, height=400, fov_y=0.8)

    with FrameRenderer(avatar, Light(np.ones((16, 32, 3), np.float32)), shade="ao") as renderer:
        scene = SceneRenderer(people, renderer)
        levels = scene.levels(8, 30.0, camera_at)
        assert (
            (np.diff(levels[:, 0]) >= 0).all() and levels[0, 0] < levels[-1, 0] and (levels[:, 1] >= levels[:, 0]).all()
        )
        np.testing.assert_array_equal(scene.levels(5, 30.0, camera_at), levels[:5])
        alone = SceneRenderer(people[:1], renderer)
        np.testing.assert_array_equal(alone.levels(8, 30.0, camera_at)[:, 0], levels[:, 0])
        near = Camera.look_at([0, 1, 4], [0, 1, 0], width=800, height=800, fov_y=0.8)
        assert greatest_sizes(avatar)[1] > near.K[0, 0] / 4 and not alone.levels(2, 30.0, lambda *_: near).any()
        small = alone.draw(alone.encode(0.2, [int(levels[-1, 0])]), camera_at(7, 0.0))
        whole = alone.draw(alone.encode(0.2), camera_at(7, 0.0))
        assert np.sqrt(np.mean((small.srgb.astype(float) - whole.srgb) ** 2)) < 1
        full, coarse = (
            scene.draw(scene.encode(0.2, chosen), camera_at(2, 0.0)) for chosen in (None, levels[2].tolist())
        )
    difference = np.sqrt(np.mean((full.srgb.astype(float) - coarse.srgb) ** 2))
    assert 0 < difference < 1
    np.testing.assert_allclose(coarse.alpha.sum(), full.alpha.sum(), rtol=0.04)


def test_a_level_leaves_out_the_far_side_unless_all_is_asked_for(avatar, motion, sky):
    camera = Camera.look_at([0, 1, 4], [0, 1, 0], width=200, height=200, fov_y=0.8)
    with FrameRenderer(avatar, sky) as renderer:

        def drawn(cull):
            scene = SceneRenderer([Person(avatar, motion)], renderer, cull=cull)
            return scene.draw(scene.encode(TIME, [len(CULLED_LEVELS)]), camera).radiance

        advised, same, everything = (drawn(cull) for cull in (None, CULLED_LEVELS[-1][1], -1.0))
    np.testing.assert_array_equal(advised, same)
    assert np.abs(advised - everything).max() > 0.01


def test_a_merged_level_is_drawn_on_the_images_own_grid(avatar, motion):
    """As its Gaussians are a pixel apart, finer pixels would show no more: nothing jumps where levels are merged."""
    light = Light(np.ones((16, 32, 3), np.float32))
    sizes = greatest_sizes(avatar)
    number = int(np.flatnonzero(sizes < 0.8 * MIN_PIXELS_PER_METRE)[0])
    size = sizes[number]
    camera = Camera.look_at([0, 1, 10], [0, 1, 0], width=240, height=240, fov_y=2 * np.arctan(120 / (10 * size)))
    with FrameRenderer(avatar, light, shade="ao") as renderer:
        scene = SceneRenderer([Person(avatar, motion)], renderer)
        finer, merged = (scene.draw(scene.encode(TIME, [level]), camera) for level in (number - 1, number))
    assert "compositing" not in merged.stage_seconds
    assert np.sqrt(np.mean((finer.srgb.astype(float) - merged.srgb) ** 2)) < 1


def test_everybody_shades_the_ground_and_no_sun_is_hidden_twice(avatar, motion):
    view = Camera.look_at([0, 2.5, 6.0], [0, 0.2, 0], width=160, height=120, fov_y=0.6)
    here, there = (Person(avatar, motion, 0, place_at(x, 0, 0)) for x in (-0.8, 0.8))
    with FrameRenderer(avatar, _sun(0.2, 1, 0.3)) as renderer:
        renderer.ground = Plane(np.array([0.0, 1, 0]), -0.02)

        def ground(people):
            scene = SceneRenderer(people, renderer)
            return scene.draw(scene.encode(TIME), view).ground

        alone, other, both, twice = (ground(people) for people in ([here], [there], [here, there], [here, here]))
    assert alone.min() < 0.3 and other.min() < 0.3
    apart = np.abs(both - np.minimum(alone, other))
    assert apart.mean() < 2e-3 and (apart > 0.06).mean() < 5e-3  # skies overlap, cells lie elsewhere
    deep = alone.min()
    assert twice.min() == pytest.approx(deep, abs=0.03)  # not as dark as the product
    assert (both <= np.minimum(alone, other) + 2e-3).mean() > 0.99
