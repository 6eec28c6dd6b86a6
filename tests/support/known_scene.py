"""One known scene for all importer tests: a shaped body, four poses, two off-centre cameras, 48×64 pixels."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from rnd_runtime.capture.body import Body, posed_vertices
from rnd_runtime.capture.capture import Capture, Frame, load_capture, save_capture
from rnd_runtime.core.camera import Camera
from rnd_runtime.core.images import to_bytes, write_image
from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_runtime.motion.motion import Motion
from rnd_trainer.checking.silhouette import RenderedMesh, render_mesh
from support.tiny import body as embedded_body

WIDTH, HEIGHT, FRAMES, FPS = 48, 64, 4, 30.0
BETAS = np.array([0.8, -0.5, 0.3, 0, 0, 0, 0, 0, 0, 0.2])
CELL = 0.03  # m
GREY = 90  # of the background that importers must remove


@cache
def coarse_body() -> Body:
    """The embedded body with the vertices of every 3 cm cell merged: small files, fast rendering."""
    fine = embedded_body()
    cells, member = np.unique(np.floor(fine.vertices / CELL), axis=0, return_inverse=True)
    member = member.reshape(-1)
    share = np.bincount(member)[:, None]

    def mean(values):
        total = np.zeros((len(cells), values.shape[1]))
        np.add.at(total, member, values)
        return total / share

    faces = member[fine.faces]
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    return Body(mean(fine.vertices), faces, mean(fine.skinning_weights), fine.skeleton)


@cache
def smpl_arrays() -> dict[str, np.ndarray]:
    """The members of an SMPL file whose mean shape is the coarse body."""
    body = coarse_body()
    vertices = body.vertices
    x, y, z = vertices.T
    waves = np.stack([np.sin((k + 1) * 2 * y + 0.3 * k) for k in range(10)], 1)  # [V, 10]
    shape_dirs = 0.01 * np.stack([x[:, None] * (1 + waves), y[:, None] * waves[:, ::-1], z[:, None] * (1 - waves)], 1)
    homogeneous = np.concatenate([vertices, np.ones((len(vertices), 1))], 1)
    joints = np.concatenate([body.skeleton.rest_joints, np.ones((24, 1))], 1)
    regressor = joints @ np.linalg.pinv(homogeneous)  # least norm; reproduces joints, rows sum to 1
    parents = body.skeleton.parents.astype(np.int64)
    tree = np.stack([np.where(parents < 0, 2**32 - 1, parents), np.arange(24)])
    return {
        "v_template": vertices,
        "f": body.faces.astype(np.uint32),
        "weights": body.skinning_weights.astype(np.float64),
        "kintree_table": tree,
        "J_regressor": regressor,
        "shapedirs": shape_dirs,
        "J": body.skeleton.rest_joints,
    }


@cache
def shaped_body() -> Body:
    """The body for BETAS, by the published formulas, written out."""
    arrays, template = smpl_arrays(), coarse_body()
    vertices = arrays["v_template"] + np.einsum("vck,k->vc", arrays["shapedirs"], BETAS)
    skeleton = type(template.skeleton)(
        template.skeleton.names, template.skeleton.parents, arrays["J_regressor"] @ vertices
    )
    return Body(vertices, template.faces, template.skinning_weights, skeleton)


@cache
def axis_angles() -> np.ndarray:
    """[F, 24, 3] rad: the person leans, rotates and moves the arms, so that no rotation is about one axis only."""
    names = coarse_body().skeleton.names
    angles = np.zeros((FRAMES, 24, 3))
    phase = np.arange(FRAMES) / FRAMES
    angles[:, 0] = np.stack([0.2 + 0.2 * phase, 1.2 * phase - 0.4, 0.25 * np.cos(6 * phase)], 1)
    angles[:, names.index("left_shoulder"), 2] = -0.9 + phase
    angles[:, names.index("right_shoulder"), 2] = 1.0 - 0.5 * phase
    angles[:, names.index("left_knee"), 0] = 0.3 + 0.4 * phase
    angles[:, names.index("head"), 1] = 0.2
    return angles


def translations() -> np.ndarray:
    """[F, 3] m."""
    phase = np.arange(FRAMES) / FRAMES
    return np.stack([0.1 * phase - 0.05, 0.05 + 0.02 * phase, 0.2 - 0.1 * phase], 1)


def cameras() -> dict[str, Camera]:
    """Two cameras of the same Y-up world, with off-centre principal points."""
    result = {}
    for name, eye, shift in (("0", [0.3, 1.1, 3.4], (1.7, -2.3)), ("1", [3.1, 1.4, 0.9], (-1.2, 1.9))):
        camera = Camera.look_at(eye, [0.0, 0.9, 0.1], width=WIDTH, height=HEIGHT, fov_y=0.72)
        K = camera.K.copy()
        K[:2, 2] += shift
        result[name] = Camera(WIDTH, HEIGHT, K, camera.world_to_camera)
    return result


def motion() -> Motion:
    return Motion(axis_angle_to_matrix(axis_angles()), translations(), FPS, coarse_body().skeleton.names)


@dataclass(frozen=True)
class Truth:
    """What a camera sees of a frame: colours [H, W, 3] uint8, mask [H, W] bool, normals [H, W, 3]."""

    image: np.ndarray
    mask: np.ndarray
    normals: np.ndarray


@cache
def see(camera: str, frame: int, k1: float = 0.0) -> Truth:
    """The view of ``camera`` in ``frame`` through a lens of distortion ``k1``, on grey."""
    view = view_of(cameras()[camera], frame, k1)
    colours = to_bytes(0.2 + 0.35 * (view.normals + 1))
    return Truth(np.where(view.mask[..., None], colours, GREY).astype(np.uint8), view.mask, view.normals)


def view_of(camera: Camera, frame: int, k1: float = 0.0) -> RenderedMesh:
    vertices = posed_vertices(shaped_body(), motion().rotations[frame], motion().translations[frame])
    return render_mesh(vertices, shaped_body().faces, camera, k1)


def write_true_capture(folder, *, k1: float = 0.0) -> Capture:
    """The scene in our own format."""
    frames = []
    for name in cameras():
        for k in range(FRAMES):
            truth, file = see(name, k, k1), f"{name}_{k}.png"
            write_image(folder / "images" / file, truth.image * truth.mask[..., None])
            write_image(folder / "masks" / file, (255 * truth.mask).astype(np.uint8))
            normals = to_bytes((truth.normals + 1) / 2) * truth.mask[..., None]
            write_image(folder / "normals" / file, normals)
            split = "train" if name == "0" else "novel_view"
            frames.append(Frame(f"images/{file}", f"masks/{file}", name, k, split, normal=f"normals/{file}"))
    save_capture(Capture(folder, cameras(), {}, shaped_body(), motion(), tuple(frames)))
    return load_capture(folder)
