"""One call from a pose to pixels, against its parts."""

from __future__ import annotations

import numba
import numpy as np
import pytest

from rnd_runtime.avatar.avatar import Avatar
from rnd_runtime.core.camera import Camera
from rnd_runtime.core.images import linear_to_srgb, to_bytes
from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_runtime.motion.motion import Motion
from rnd_runtime.playback.frame import FrameRenderer, PosedAvatar, draw_gaussians, in_root_frame
from rnd_runtime.playback.rasterizer import make_rasterizer
from rnd_runtime.raster.cpu import rasterize
from rnd_runtime.raster.in_view import in_view
from rnd_runtime.raster.outline import sharpened
from rnd_runtime.raster.tone import tone_map
from rnd_runtime.shading.files.load import load_light
from rnd_runtime.shading.light import Light
from rnd_runtime.shading.shader import Shader
from support.paths import ASSETS

LEAST = -0.5  # n·v of what is culled in these tests, as the renderer proposes
CULLED = 45.0  # dB that culling must leave against the whole picture
CAMERA = Camera.look_at([0.5, 1.2, 3.2], [0, 0.9, 0], width=96, height=128, fov_y=0.65)


def _taken(motion, place, moved):
    """``motion`` with the whole body taken along by ``moved`` [4, 4]; ``place``: [3] of the root at rest."""
    turn, rotations = moved[:3, :3], motion.rotations.copy()
    rotations[:, 0] = turn @ rotations[:, 0]
    translations = (place + motion.translations) @ turn.T + moved[:3, 3] - place
    return Motion(rotations, translations, motion.fps, motion.joint_names)


# with 3DGS's dilation 0.06 and 0.17
@pytest.mark.parametrize(("side", "stouter"), [(256, 0.02), (128, 0.06)])
def test_a_person_is_not_stouter_in_a_small_picture(avatar, motion, side, stouter):
    gaussians = avatar.pose(motion, 0.3)
    covered = []
    for size in (1024, side):
        camera = Camera.look_at([0.5, 1.2, 3.2], [0, 0.9, 0], width=size, height=size, fov_y=0.65)
        geometry = gaussians.means, gaussians.covariances, gaussians.opacities
        covered.append(rasterize(*geometry, gaussians.albedo, camera, depth=False).alpha.mean())
    assert covered[1] < (1 + stouter) * covered[0]


def test_a_frame_is_its_parts(avatar, motion, sky):
    near = CAMERA.resized(192, 256)  # enough pixels to be rendered as they are
    frame = FrameRenderer(avatar, sky, near).render(motion, 0.3)
    encoded = avatar.encode(motion, 0.3)
    gaussians = avatar.posed(encoded)
    shader, camera = in_root_frame(encoded.root, Shader(sky), near)
    radiance = shader.shade(gaussians, camera.position)
    expected = sharpened(rasterize(gaussians.means, gaussians.covariances, gaussians.opacities, radiance, camera))
    np.testing.assert_array_equal(frame.radiance, expected.image)
    np.testing.assert_array_equal(frame.alpha, expected.alpha)
    np.testing.assert_array_equal(frame.srgb, to_bytes(linear_to_srgb(expected.image)))
    assert frame.srgb.max() > 100 and min(frame.stage_seconds.values()) > 0


@pytest.mark.parametrize("mode", ["table", "table+sun", "ao", "lights:8"])
@pytest.mark.parametrize("cull", [None, LEAST])
def test_encoded_and_posed_bodies_give_one_frame(avatar, motion, sky, mode, cull):
    camera = Camera.look_at([0.2, 1.5, 1.4], [0, 1.3, 0], width=70, height=50, fov_y=0.6)
    renderer = FrameRenderer(avatar, sky, camera, shade=mode, cull=-1 if cull is None else cull)
    renderer.turn(0.7)
    frame, encoded = renderer.render(motion, 0.3), avatar.encode(motion, 0.3)
    parts = renderer.draw(PosedAvatar(avatar.posed(encoded), encoded.root, avatar.joints(encoded)))
    np.testing.assert_array_equal(frame.radiance, parts.radiance)
    np.testing.assert_array_equal(frame.srgb, tone_map(parts.radiance, parts.alpha))
    stages = ["motion", "encoders", "posing", "shading", "projection", "sort", "raster", "tone map"]
    assert list(frame.stage_seconds) == stages


def test_turning_the_light_equals_another_light(avatar, motion, sky):
    turned, fresh = FrameRenderer(avatar, sky, CAMERA), FrameRenderer(avatar, sky, CAMERA)
    still = turned.render(motion, 0.3).srgb
    turned.turn(1.0)
    fresh.relight(load_light(ASSETS / "sky.exr", yaw=1.0))
    np.testing.assert_array_equal(turned.render(motion, 0.3).srgb, fresh.render(motion, 0.3).srgb)
    assert (turned.render(motion, 0.3).srgb != still).any()


def test_a_turn_of_body_and_camera_changes_no_more_than_rounding(avatar, motion):
    """Shadow maps and the order of depths turn with the root; a grey sky has no sides."""
    grey = Light(np.full((16, 32, 3), 0.7, np.float32))
    renderer = FrameRenderer(avatar, grey, CAMERA, shade="table")
    still = renderer.render(motion, 0.3).srgb.astype(int)
    turn = axis_angle_to_matrix([0.8, -1.1, 0.4])
    moved = np.eye(4)
    moved[:3, :3], moved[:3, 3] = turn, [300.0, -20.0, 1000.0]
    renderer.camera = CAMERA.in_frame(np.linalg.inv(moved))
    turned = renderer.render(_taken(motion, avatar.skeleton.rest_joints[0], moved), 0.3).srgb
    assert still.max() > 50
    assert np.abs(turned - still).max() <= 1


def test_what_is_posed_in_the_world_stands_where_the_motion_says(avatar, motion):
    encoded = avatar.encode(motion, 0.3)
    local, world = avatar.posed(encoded), avatar.posed(encoded.in_world())
    root = encoded.root
    expected = local.means @ root[:3, :3].T + root[:3, 3]
    np.testing.assert_allclose(world.means, expected, atol=2e-6)
    np.testing.assert_allclose(world.normals, local.normals @ root[:3, :3].T, atol=2e-6)
    np.testing.assert_allclose(world.root_rotation, root[:3, :3], atol=1e-6)
    np.testing.assert_array_equal(local.root_rotation, np.eye(3))
    assert np.abs(root - np.eye(4)).max() > 0.01


def test_only_what_is_seen_is_shaded(avatar, motion, sky):
    """A camera close to the head leaves most of the body unshaded, and the picture is the same."""
    gaussians = avatar.pose(motion, 0.3)
    close = Camera.look_at([0.2, 1.6, 1.2], [0, 1.5, 0], width=64, height=64, fov_y=0.4)
    scene = gaussians.means, gaussians.covariances, gaussians.opacities
    seen = in_view(*scene, close)
    assert 0.05 < seen.mean() < 0.5
    shader = Shader(sky)
    everything, some = (shader.shade(gaussians, close.position, who) for who in (None, seen))
    np.testing.assert_array_equal(some[seen], everything[seen])
    assert not some[~seen].any()
    expected = rasterize(*scene, everything, close, depth=False, outlines=True)
    with make_rasterizer("cpu") as cpu:
        np.testing.assert_array_equal(draw_gaussians(gaussians, shader, close, cpu).image, expected.image)


def test_culling_keeps_what_faces_the_camera_and_the_picture(avatar, motion, sky):
    gaussians = avatar.pose(motion, 0.3)
    to_eye = CAMERA.position - gaussians.means
    cosines = (gaussians.normals * to_eye).sum(1) / np.linalg.norm(to_eye, axis=1)
    scene = gaussians.means, gaussians.covariances, gaussians.opacities
    everything, kept = (in_view(*scene, CAMERA, normals=gaussians.normals, cull=least) for least in (None, LEAST))
    sure = np.abs(cosines - LEAST) > 1e-5
    np.testing.assert_array_equal(kept[sure], (everything & (cosines >= LEAST))[sure])
    assert 0.5 * everything.sum() < kept.sum() < 0.9 * everything.sum()
    whole = FrameRenderer(avatar, sky, CAMERA).render(motion, 0.3).srgb.astype(float)
    culled = FrameRenderer(avatar, sky, CAMERA, cull=LEAST).render(motion, 0.3).srgb
    assert 10 * np.log10(255**2 / np.mean((whole - culled) ** 2)) > CULLED


def test_threads_change_no_byte(avatar, motion, sky):
    images = []
    before = numba.get_num_threads()
    try:
        for threads in (1, before):
            numba.set_num_threads(threads)
            images.append(
                FrameRenderer(Avatar.load(ASSETS / "avatar.onnx", threads=threads), sky, CAMERA).render(motion, 0.3)
            )
    finally:
        numba.set_num_threads(before)
    np.testing.assert_array_equal(images[0].radiance, images[1].radiance)
    np.testing.assert_array_equal(images[0].srgb, images[1].srgb)
