"""The embedded assets: a person, a walk, a sky and a capture that agree with one another."""

from __future__ import annotations

import importlib

import cv2
import numpy as np
import pytest

from rnd_runtime.capture.body import Body
from rnd_runtime.capture.capture import Capture, Frame, Split, load_capture
from rnd_runtime.core.camera import Camera
from rnd_runtime.core.images import srgb_to_linear
from rnd_runtime.core.rotations import axis_angle_to_matrix, matrix_to_axis_angle
from rnd_runtime.motion.motion import load_motion
from rnd_runtime.motion.skeleton import bone_transforms
from rnd_runtime.motion.smpl import SMPL_NAMES, SMPL_PARENTS
from rnd_runtime.shading.files.load import load_light
from rnd_runtime.shading.light import downsize, texel_directions, texel_solid_angles
from support.paths import ASSETS

HUMAN_SPEED = 15.0  # rad/s; sprinters' knees reach about 12
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
MIRROR_X, MIRROR_Z = np.diag([-1.0, 1, 1]), np.diag([1.0, 1, -1])


@pytest.fixture(scope="module")
def body() -> Body:
    return Body.load(ASSETS / "body.npz")


@pytest.fixture(scope="module")
def capture() -> Capture:
    return load_capture(ASSETS / "capture")


def posed(body: Body, rotations: np.ndarray, translation: np.ndarray) -> np.ndarray:
    bones = bone_transforms(body.skeleton, rotations, translation)
    blended = np.tensordot(body.skinning_weights, bones, axes=1)
    return np.einsum("vij,vj->vi", blended[:, :, :3], body.vertices) + blended[:, :, 3]


def silhouette(vertices: np.ndarray, faces: np.ndarray, camera: Camera) -> np.ndarray:
    seen = vertices @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    pixels = seen @ camera.K.T
    corners = np.round(16 * (pixels[:, :2] / pixels[:, 2:] - 0.5)).astype(np.int32)  # 4 fractional bits
    mask = np.zeros((camera.height, camera.width), np.uint8)
    for triangle in corners[faces]:
        cv2.fillConvexPoly(mask, triangle, 1, shift=4)
    return mask.astype(bool)


def winding_numbers(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """1 inside, 0 outside: solid angles of all faces (van Oosterom and Strackee 1983) over 4π."""
    a, b, c = (vertices[faces[:, k]] - points[:, None] for k in range(3))
    la, lb, lc = (np.linalg.norm(e, axis=-1) for e in (a, b, c))
    triple = np.sum(a * np.cross(b, c), axis=-1)
    dots = la * lb * lc + (a * b).sum(-1) * lc + (b * c).sum(-1) * la + (c * a).sum(-1) * lb
    return np.arctan2(triple, dots).sum(axis=1) / (2 * np.pi)


def sides(body: Body) -> tuple[np.ndarray, np.ndarray]:
    names = body.skeleton.names
    left, right = (np.array([n.startswith(side) for n in names]) for side in ("left_", "right_"))
    return body.skinning_weights[:, left].sum(axis=1), body.skinning_weights[:, right].sum(axis=1)


def test_body_is_closed_and_faces_outwards(body: Body) -> None:
    edges = np.concatenate([body.faces[:, [0, 1]], body.faces[:, [1, 2]], body.faces[:, [2, 0]]])
    directed = {tuple(e) for e in edges.tolist()}
    assert len(directed) == len(edges)  # consistently wound: no directed edge twice
    assert all((b, a) in directed for a, b in directed)  # closed: every edge has its opposite
    a, b, c = (body.vertices[body.faces[:, k]] for k in range(3))
    litres = 1000 * np.sum(a * np.cross(b, c)) / 6
    assert 60 < litres < 85  # outward, and a person of about 70 kg
    assert len(body.vertices) - len(edges) // 2 + len(body.faces) == 2  # one piece without handles


def test_body_has_human_measures(body: Body) -> None:
    low, high = body.vertices.min(axis=0), body.vertices.max(axis=0)
    assert high[1] - low[1] == pytest.approx(1.75, abs=0.01)
    assert abs(low[1]) < 0.005  # stands on y = 0
    assert high[0] - low[0] == pytest.approx(1.75, abs=0.05)  # the span of the arms is the height
    assert 7_000 <= len(body.vertices) <= 10_000
    toes = body.vertices[body.vertices[:, 1] < 0.03]
    assert toes[:, 2].max() > 2 * -toes[:, 2].min()  # faces +Z
    assert body.skeleton.rest_joints[SMPL_NAMES.index("left_hip"), 0] > 0


def test_skeleton_is_smpl_and_lies_inside(body: Body) -> None:
    assert body.license == "CC0-1.0"
    assert body.skeleton.names == SMPL_NAMES
    assert tuple(body.skeleton.parents) == SMPL_PARENTS
    inside = winding_numbers(body.skeleton.rest_joints, body.vertices, body.faces)
    np.testing.assert_allclose(inside, 1.0, atol=1e-6)


def test_weights_keep_the_sides_apart(body: Body) -> None:
    left, right = sides(body)
    x, y = body.vertices[:, 0], body.vertices[:, 1]
    assert right[x > 0.03].max() == 0.0
    assert left[x < -0.03].max() == 0.0
    legs = y < 0.75
    assert right[legs & (x > 0)].max() < 0.01
    assert left[legs & (x < 0)].max() < 0.01
    assert np.abs(body.skinning_weights.sum(axis=1) - 1).max() < 1e-6


def test_walk_loops_at_human_speed_with_its_feet_on_the_ground(body: Body) -> None:
    walk = load_motion(ASSETS / "walk.npz", body.skeleton)
    assert 4.0 <= walk.frame_count / walk.fps <= 6.0
    following = np.roll(walk.rotations, -1, axis=0)
    steps = np.linalg.norm(matrix_to_axis_angle(np.swapaxes(walk.rotations, -1, -2) @ following), axis=-1)
    assert steps.max() * walk.fps < HUMAN_SPEED
    assert (steps[-1] <= 1.05 * steps[:-1].max(axis=0) + 1e-9).all()  # the seam is a step like any other
    assert np.abs(walk.translations[-1] - walk.translations[0]).max() < 0.01
    knees = matrix_to_axis_angle(walk.rotations[:, [4, 5]])[..., 0]
    assert knees.min() > -0.05 and knees.max() > 0.8  # bend, and only backwards
    for frame in range(0, walk.frame_count, 11):
        lowest = posed(body, walk.rotations[frame], walk.translations[frame])[:, 1].min()
        assert abs(lowest) < 0.02, frame


def test_sky_has_its_sun_where_it_should_be() -> None:
    light = load_light(ASSETS / "sky.exr")
    assert light.radiance.shape == (128, 256, 3)
    assert light.repaired == 0
    luminance = light.radiance @ LUMINANCE
    assert 5e3 < luminance.max() < 2e4
    power = np.where(luminance > 100, luminance, 0) * texel_solid_angles(128, 256)
    mean = (texel_directions(128, 256) * power[..., None]).sum(axis=(0, 1))
    assert np.degrees(np.arctan2(mean[2], mean[0])) == pytest.approx(48.0, abs=0.3)  # from +X towards +Z
    assert np.degrees(np.arcsin(mean[1] / np.linalg.norm(mean))) == pytest.approx(42.0, abs=0.3)
    assert 0.005 < (luminance > 100).mean() * 256 * 128 / 100 < 0.5  # a disc of a few texels


def test_the_scripts_make_what_is_here(tmp_path, monkeypatch) -> None:
    monkeypatch.syspath_prepend(str(ASSETS.parent))
    make = importlib.import_module("assets.make.__main__")
    monkeypatch.setattr(make, "ASSETS", tmp_path)
    make.main(["body", "walk", "turn", "sky"])
    for name in ("body.npz", "walk.npz", "turn.npz"):
        with np.load(tmp_path / name) as made, np.load(ASSETS / name) as kept:
            assert set(made) == set(kept)
            for key in made:
                if made[key].dtype.kind == "f":
                    np.testing.assert_allclose(made[key], kept[key], atol=1e-6, err_msg=f"{name}: {key}")
                else:
                    np.testing.assert_array_equal(made[key], kept[key], err_msg=f"{name}: {key}")
    made, kept = (load_light(folder / "sky.exr").radiance for folder in (tmp_path, ASSETS))
    np.testing.assert_allclose(made, kept, rtol=1e-6)


def test_capture_has_its_splits(capture: Capture) -> None:
    train = capture.split("train")
    assert 60 <= len(train) <= 80
    assert len({(f.camera, f.light) for f in train}) == 1
    seen = {f.frame for f in train}
    for split, least in (("novel_view", 12), ("novel_pose", 10), ("relight", 8)):
        frames = capture.split(split)
        assert len(frames) >= least
        assert all(f.albedo and f.normal_gt for f in frames)
    assert {f.camera for f in capture.split("novel_view")}.isdisjoint({train[0].camera})
    assert seen >= {f.frame for f in capture.split("novel_view")}
    assert min(f.frame for f in capture.split("novel_pose")) > max(seen)
    assert {f.light for f in capture.split("relight")}.isdisjoint({train[0].light})
    assert capture.motion.fps == 30.0


def test_template_fits_the_masks(capture: Capture) -> None:
    body, motion = capture.body, capture.motion
    views = {(f.camera, f.frame): f for f in capture.frames}
    for (camera, index), frame in sorted(views.items())[::2]:
        mask = capture.load_frame(frame).mask > 0.5
        vertices = posed(body, motion.rotations[index], motion.translations[index])
        template = silhouette(vertices, body.faces, capture.cameras[camera])
        assert (mask & template).sum() / (mask | template).sum() > 0.80, (camera, index)  # 0.86 measured
        assert (mask & template).sum() / template.sum() > 0.97, (camera, index)  # clothes lie outside
        assert not mask[[0, -1]].any() and not mask[:, [0, -1]].any(), (camera, index)  # nothing is cut off


def test_normals_face_the_camera(capture: Capture) -> None:
    errors = []
    for frame in capture.frames[::3]:
        images = capture.load_frame(frame)
        covered = images.mask > 0.5
        for normals in (images.normal, images.normal_gt):
            if normals is not None:
                assert (normals[covered][:, 2] < 0).mean() > 0.99, frame
                np.testing.assert_allclose(np.linalg.norm(normals[covered], axis=1), 1.0, atol=1e-3)
        errors.append(covered.mean())
    assert 0.05 < np.mean(errors) < 0.25  # the person fills the image, not more


@pytest.mark.parametrize("split", ["novel_view", "novel_pose", "relight"])
def test_light_camera_and_normals_agree(capture: Capture, split: Split) -> None:
    """Albedo × unshadowed irradiance explains every image better than with the light rotated or mirrored.

    Cast shadows keep the correlation from being higher; the studio's boxes stand nearly symmetrically.
    """
    margins = []
    for frame in capture.split(split):
        right = _explained(capture, frame, np.eye(3))
        rotations = [axis_angle_to_matrix([0.0, np.radians(angle), 0.0]) for angle in (90, 180, 270)]
        wrong = max(_explained(capture, frame, rotation) for rotation in [*rotations, MIRROR_X, MIRROR_Z])
        assert right > max(wrong, 0.5), frame.image
        margins.append(right - wrong)
    assert np.mean(margins) > 0.15


def _explained(capture: Capture, frame: Frame, rotation: np.ndarray) -> float:
    """Correlation of the image's shading with unshadowed irradiance of the light rotated by ``rotation``."""
    images, light = capture.load_frame(frame), capture.load_light(frame.light or "")
    covered = images.mask > 0.99
    assert images.normal_gt is not None and images.albedo_srgb is not None
    normals = images.normal_gt[covered] @ capture.cameras[frame.camera].world_to_camera[:3, :3]
    directions = texel_directions(16, 32).reshape(-1, 3) @ rotation.T
    power = (downsize(light.radiance, 16, 32) @ LUMINANCE * texel_solid_angles(16, 32)).reshape(-1)
    predicted = np.maximum(normals @ directions.T, 0) @ power
    albedo = np.maximum(srgb_to_linear(images.albedo_srgb[covered]) @ LUMINANCE, 0.02)
    shading = srgb_to_linear(images.image_srgb[covered]) @ LUMINANCE / albedo
    return float(np.corrcoef(predicted, shading)[0, 1])
