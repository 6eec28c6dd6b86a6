"""The known scene written in other people's layouts, byte by byte as their programs expect them."""

from __future__ import annotations

import json
import pickle  # noqa: TID251  # writes what others' programs write
from pathlib import Path

import cv2
import numpy as np

from rnd_runtime.core.camera import Camera
from rnd_runtime.core.images import to_bytes, write_image
from rnd_runtime.core.rotations import axis_angle_to_matrix, matrix_to_axis_angle, matrix_to_quaternion
from support.known_scene import (
    BETAS,
    FRAMES,
    HEIGHT,
    WIDTH,
    axis_angles,
    cameras,
    motion,
    see,
    shaped_body,
    smpl_arrays,
)

K1 = -0.8  # strong: at 48×64 pixels a common lens would move the edges by less than one
Z_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # our (x, y, z) is their (x, −z, y)
FLIP = np.diag([1.0, -1, -1])


def body_file(folder: Path) -> Path:
    """An SMPL file of the scene's person."""
    np.savez(folder / "SMPL_SCENE.npz", **smpl_arrays())
    return folder / "SMPL_SCENE.npz"


def smplx_body_file(folder: Path) -> Path:
    """An SMPL-X file of the same person: their hands' weights are the wrists', the further joints have none."""
    arrays = smpl_arrays()
    weights = np.zeros((len(arrays["weights"]), 55))
    weights[:, :22] = arrays["weights"][:, :22]
    weights[:, 20:22] += arrays["weights"][:, 22:]
    further = [15] * 3 + [20] * 15 + [21] * 15  # jaw and eyes, left fingers, right fingers
    np.savez(
        folder / "SMPLX_SCENE.npz",
        weights=weights,
        kintree_table=np.stack([[*arrays["kintree_table"][0, :22], *further], np.arange(55)]),
        J_regressor=np.concatenate([arrays["J_regressor"][:22], arrays["J_regressor"][further]]),
        **{name: arrays[name] for name in ("v_template", "f", "shapedirs")},
    )
    return folder / "SMPLX_SCENE.npz"


class World:
    """The scene in a source's world x' = s (rotation x + shift): cameras' R, t; root rotations and positions."""

    def __init__(self, rotation: np.ndarray, shift=(0, 0, 0)) -> None:
        self.rotation, shift = np.asarray(rotation), np.asarray(shift, float)
        self.cameras: dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]] = {}
        for name, camera in cameras().items():
            R = camera.world_to_camera[:3, :3] @ self.rotation.T
            self.cameras[name] = (camera.K, R, camera.world_to_camera[:3, 3] - R @ shift)
        self.rest = shaped_body().skeleton.rest_joints[0]
        self.roots = self.rotation @ motion().rotations[:, 0]  # [F, 3, 3]
        self.positions = (motion().translations + self.rest) @ self.rotation.T + shift  # of the pelvis [F, 3]

    @property
    def trans(self) -> np.ndarray:
        """SMPL: v = R (v0 − J0) + J0 + trans."""
        return self.positions - self.rest

    @property
    def Rh(self) -> np.ndarray:
        return matrix_to_axis_angle(self.roots)

    @property
    def Th(self) -> np.ndarray:
        """EasyMocap: v = R(Rh) v0 + Th, so that the pelvis lies at R J0 + Th."""
        return self.positions - self.roots @ self.rest

    @property
    def thetas(self) -> np.ndarray:
        """[F, 72] with the root of this world."""
        return np.concatenate([self.Rh, axis_angles()[:, 1:].reshape(FRAMES, -1)], 1)


def camera_world(name: str = "0") -> World:
    """The world that is the frame of a camera: y down, the camera at the origin."""
    pose = cameras()[name].world_to_camera
    return World(pose[:3, :3], pose[:3, 3])


def opencv_K(K: np.ndarray) -> np.ndarray:
    """Pixel centres at whole numbers."""
    return K - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])


def _jpeg(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    flags = [cv2.IMWRITE_JPEG_QUALITY, 100, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    assert cv2.imwrite(str(path), image[..., ::-1], flags)


def save_object(path: Path, content: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.save(path, content, allow_pickle=True)


def write_pickle(path: Path, content: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(pickle.dumps(content, protocol=2))


def _mask(name: str, k: int, k1: float = 0.0) -> np.ndarray:
    return see(name, k, k1).mask.astype(np.uint8)


def write_zju(folder: Path, *, refined: bool = False, early: bool = False) -> None:
    """ZJU-MoCap: lenses bend, masks hold part labels, T in millimetres, Z up.

    ``early`` is CoreView_313's and 315's naming, whose frames count from 1.
    """
    world = World(Z_UP, (0.3, -0.2, 0.1))
    names = {"0": "00", "1": "01"} if refined else {"0": "Camera_B1", "1": "Camera_B2"}
    if early:
        names = {"0": "Camera (1)", "1": "Camera (2)"}
    cams: dict[str, list] = {"K": [], "D": [], "R": [], "T": []}
    for name in names:
        K, R, t = world.cameras[name]
        for key, value in (("K", opencv_K(K)), ("D", [[K1], [0], [0], [0], [0]]), ("R", R), ("T", 1000 * t[:, None])):
            cams[key].append(np.array(value, np.float64))
    rows = []
    for k in range(FRAMES):
        row = []
        for name, theirs in names.items():
            stem = (
                f"CoreView_313_{theirs.replace(' ', '_')}_{k + 1:04d}_2019-08-23_16-08-50.592" if early else f"{k:06d}"
            )
            inner = f"images/{theirs}/{stem}.jpg" if refined else f"{theirs}/{stem}.jpg"
            row.append(inner)
            _jpeg(folder / inner, see(name, k, K1).image)
            if refined:
                write_image(folder / "mask" / theirs / f"{stem}.png", 255 * _mask(name, k, K1))
            else:  # each of the two misses a part
                for part, rows_kept in (("mask", slice(0, 40)), ("mask_cihp", slice(20, None))):
                    labels = np.zeros((HEIGHT, WIDTH), np.uint8)
                    labels[rows_kept] = 3 * _mask(name, k, K1)[rows_kept]
                    write_image(folder / part / theirs / f"{stem}.png", labels)
        rows.append({"ims": row})
        poses = np.concatenate([np.zeros(3), axis_angles()[k, 1:].ravel()])
        record = {"poses": poses[None], "Rh": world.Rh[k][None], "Th": world.Th[k][None], "shapes": BETAS[None]}
        save_object(
            folder / ("params" if refined else "new_params") / f"{k + early}.npy",
            {key: value.astype(np.float32) for key, value in record.items()},
        )
    save_object(folder / "annots.npy", {"cams": cams, "ims": rows})


def write_arah(folder: Path) -> None:
    """ARAH: SMPL's own root, T in metres."""
    world = World(Z_UP, (0.3, -0.2, 0.1))
    record: dict = {"all_cam_names": ["1", "2"]}
    for name, theirs in (("0", "1"), ("1", "2")):
        K, R, t = world.cameras[name]
        record[theirs] = {
            "K": opencv_K(K).tolist(),
            "D": [[K1], [0], [0], [0], [0]],
            "R": R.tolist(),
            "T": t[:, None].tolist(),
        }
        for k in range(FRAMES):
            _jpeg(folder / theirs / f"{k:06d}.jpg", see(name, k, K1).image)
            write_image(folder / theirs / f"{k:06d}.png", _mask(name, k, K1))
    (folder / "cam_params.json").write_text(json.dumps(record))
    (folder / "models").mkdir()
    for k in range(FRAMES):
        np.savez(
            folder / "models" / f"{k:06d}.npz",
            minimal_shape=shaped_body().vertices,
            betas=BETAS[None],
            Jtr_posed=np.zeros((24, 3)),
            bone_transforms=np.zeros((24, 4, 4)),
            trans=world.trans[k],
            root_orient=world.Rh[k],
            pose_body=axis_angles()[k, 1:22].ravel(),
            pose_hand=axis_angles()[k, 22:].ravel(),
        )


def write_humannerf(folder: Path) -> None:
    """HumanNeRF: one static camera, EasyMocap's root, pickles by image name."""
    world = World(Z_UP)
    K, R, t = world.cameras["0"]
    extrinsic = np.eye(4)
    extrinsic[:3, :3], extrinsic[:3, 3] = R, t
    lens, meshes = {}, {}
    for k in range(FRAMES):
        name = f"frame_{k:06d}"
        write_image(folder / "images" / f"{name}.png", see("0", k, K1).image)
        write_image(folder / "masks" / f"{name}.png", np.repeat(255 * _mask("0", k, K1)[..., None], 3, 2))
        lens[name] = {"intrinsics": opencv_K(K), "extrinsics": extrinsic, "distortions": np.array([K1, 0, 0, 0, 0])}
        poses = np.concatenate([np.zeros(3), axis_angles()[k, 1:].ravel()])
        meshes[name] = {"Rh": world.Rh[k], "Th": world.Th[k], "poses": poses, "joints": np.zeros((24, 3))}
    write_pickle(folder / "cameras.pkl", lens)
    write_pickle(folder / "mesh_infos.pkl", meshes)
    np.save(folder / "avg_betas.npy", BETAS)


def write_video(path: Path, images: list[np.ndarray], *, fps: int = 30) -> None:
    """A lossless mp4."""
    import av

    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=fps, options={"qp": "0", "preset": "ultrafast"})
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt = "yuv444p"
        for image in images:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")))
        container.mux(stream.encode(None))


def write_snapshot(folder: Path) -> None:
    """PeopleSnapshot raw: two poses too many, at the start."""
    import h5py

    world, K = camera_world(), opencv_K(cameras()["0"].K)
    lens = {
        "camera_f": np.array([K[0, 0], K[1, 1]]),
        "camera_c": K[:2, 2],
        "camera_k": np.array([K1, 0, 0, 0, 0]),
        "camera_rt": np.zeros(3),
        "camera_t": np.zeros(3),
        "width": WIDTH,
        "height": HEIGHT,
    }
    write_pickle(folder / "camera.pkl", lens)
    write_video(folder / "me.mp4", [see("0", k, K1).image for k in range(FRAMES)])
    with h5py.File(folder / "masks.hdf5", "w") as file:
        file["masks"] = np.stack([_mask("0", k, K1) for k in range(FRAMES)])
    with h5py.File(folder / "reconstructed_poses.hdf5", "w") as file:
        file["betas"] = BETAS
        file["pose"] = np.concatenate([np.ones((2, 72)), world.thetas])
        file["trans"] = np.concatenate([np.ones((2, 3)), world.trans])


def write_instant_avatar(folder: Path) -> None:
    """PeopleSnapshot as InstantAvatar ships it: undistorted, masks as arrays."""
    world = camera_world()
    for k in range(FRAMES):
        write_image(folder / "images" / f"image_{k:04d}.png", see("0", k).image)
        (folder / "masks").mkdir(exist_ok=True)
        np.save(folder / "masks" / f"mask_{k:04d}.npy", _mask("0", k))
    np.savez(
        folder / "cameras.npz", intrinsic=opencv_K(cameras()["0"].K), extrinsic=np.eye(4), height=HEIGHT, width=WIDTH
    )
    np.savez(
        folder / "poses.npz", betas=BETAS, thetas=world.thetas.astype(np.float32), transl=world.trans.astype(np.float32)
    )


def write_snapshot_split(folder: Path, train: range, test: range) -> None:
    """A subject of InstantAvatar's: every image of the video, frame k in the scene's pose k % 4, and poses that were
    optimised for the frames of its splits alone; the first poses beside them are worthless."""
    write_instant_avatar(folder)
    count = test.stop
    for k in range(FRAMES, count):
        for part, name in (("images", "image_{:04d}.png"), ("masks", "mask_{:04d}.npy")):
            (folder / part / name.format(k)).hardlink_to(folder / part / name.format(k % FRAMES))
    np.savez(folder / "poses.npz", betas=BETAS, thetas=np.ones((count, 72)), transl=np.ones((count, 3)))
    world = camera_world()
    (folder / "poses").mkdir()
    for name, part in (("train", train), ("test", test)):
        rows = np.array(part) % FRAMES
        np.savez(
            folder / "poses" / f"anim_nerf_{name}.npz",
            betas=BETAS[None].astype(np.float32),
            global_orient=world.thetas[rows, :3].astype(np.float32),
            body_pose=world.thetas[rows, 3:].astype(np.float32),
            transl=world.trans[rows].astype(np.float32),
        )


def write_intrinsic_avatar(folder: Path, *, many: bool) -> None:
    """RANA (one camera) or SyntheticHuman (several) as IntrinsicAvatar prepares them."""
    world = World(np.eye(3)) if many else camera_world()
    names = {"0": "00", "1": "01"} if many else {"0": ""}
    record: dict = {"all_cam_names": list(names.values())} if many else {}
    for name, theirs in names.items():
        K, R, t = world.cameras[name]
        extrinsic = np.block([[R, t[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])
        entry = {
            "intrinsic": K.tolist(),
            "extrinsic": extrinsic.tolist(),
            "distortion": [0, 0, 0, 0],
            "height": HEIGHT,
            "width": WIDTH,
        }
        record |= {theirs: entry} if many else entry
        for k in range(FRAMES):
            write_image(folder / "images" / theirs / f"image_{k:04d}.png", see(name, k).image)
            write_image(
                folder / ("normals_png" if many else "normals") / theirs / f"normal_{k:04d}.png", opengl_map(name, k)
            )
            (folder / "masks" / theirs).mkdir(exist_ok=True, parents=True)
            np.save(folder / "masks" / theirs / f"mask_{k:04d}.npy", _mask(name, k))
    (folder / "cameras.json").write_text(json.dumps(record))
    np.savez(
        folder / "poses.npz",
        betas=BETAS[None],
        global_orient=world.thetas[:, :3],
        body_pose=world.thetas[:, 3:],
        transl=world.trans,
    )


def opengl_map(name: str, k: int) -> np.ndarray:
    """(n + 1)/2 with Y up, Z to the viewer, black outside."""
    truth = see(name, k)
    return to_bytes((truth.normals @ FLIP + 1) / 2) * truth.mask[..., None]


def write_rana(folder: Path) -> None:
    """RANA raw: global_trans in units of ``scale``, masks in the alpha of ``_semantic``."""
    world, scale = camera_world(), 1000.0
    for k in range(FRAMES):
        stem = f"frame_{k:06d}"
        write_image(folder / f"{stem}.png", see("0", k).image)
        write_image(folder / f"{stem}_normals.png", opengl_map("0", k))
        semantic = np.full((HEIGHT, WIDTH, 4), 77, np.uint8)
        semantic[..., 3] = 255 * _mask("0", k)
        write_image(folder / f"{stem}_semantic.png", semantic)
        data = {
            "gender": "neutral",
            "K": cameras()["0"].K.tolist(),
            "pose": world.thetas[k, 3:].tolist(),
            "betas": BETAS.tolist(),
            "global_orient": world.Rh[k].tolist(),
            "global_trans": (scale * world.positions[k]).tolist(),
            "scale": scale,
        }
        (folder / f"{stem}.json").write_text(json.dumps({"skeleton_0": {"smpl_data": data}}))


NEUMAN_SCALE = 2.5


def neuman_camera(k: int) -> str:
    """NeuMan's camera moves: here it jumps between the scene's two."""
    return "01"[k % 2]


def write_neuman(folder: Path, *, hugs: bool = False) -> None:
    """NeuMan: COLMAP's tilted world in units of 0.4 m, masks white outside; with HUGS' fits or its own."""
    import joblib

    tilt = axis_angle_to_matrix([0.4, 2.0, 2.2])
    world = World(tilt, (0.5, 0.1, -0.3))
    (folder / "sparse").mkdir()
    lens, views = ["# Camera list"], ["# Image list"]
    for k in range(FRAMES):
        name = neuman_camera(k)
        K, R, t = world.cameras[name]
        lens.append(f"{k + 1} PINHOLE {WIDTH} {HEIGHT} {K[0, 0]} {K[1, 1]} {K[0, 2]} {K[1, 2]}")
        q = matrix_to_quaternion(R)
        views += [" ".join(map(str, [k + 1, *q, *(NEUMAN_SCALE * t), k + 1, f"{k:05d}.png"])), "1.0 2.0 -1"]
        write_image(folder / "images" / f"{k:05d}.png", see(name, k).image)
        write_image(folder / "segmentations" / f"{k:05d}.png", (255 * (1 - _mask(name, k))).astype(np.uint8))
    (folder / "sparse" / "cameras.txt").write_text("\n".join(lens) + "\n")
    (folder / "sparse" / "images.txt").write_text("\n".join(views[:1] + views[1:]) + "\n")
    if hugs:
        # x = s · smpl(pose, root about its pelvis) + transl
        transl = NEUMAN_SCALE * (world.positions - world.rest)
        (folder / "4d_humans" / "sam_segmentations").mkdir(parents=True)
        for k in range(FRAMES):
            write_image(folder / "4d_humans" / "sam_segmentations" / f"{k:05d}.png", 255 * _mask(neuman_camera(k), k))
        np.savez(
            folder / "4d_humans" / "smpl_optimized_aligned_scale.npz",
            global_orient=world.thetas[:, :3],
            body_pose=world.thetas[:, 3:],
            transl=transl,
            betas=np.tile(BETAS, (FRAMES, 1)),
            scale=np.full(FRAMES, NEUMAN_SCALE),
        )
        return
    # ROMP sees the camera's frame; the alignment (4 × 3, transposed) takes its body to COLMAP's world
    alignments, poses = {}, []
    for k in range(FRAMES):
        _, R, t = world.cameras[neuman_camera(k)]
        scale = NEUMAN_SCALE * (1 + 0.02 * (k - 1.5))  # fits scatter; the median is not quite the true scale
        seen = matrix_to_axis_angle(R @ world.roots[k])
        poses.append(np.concatenate([seen, world.thetas[k, 3:]]))
        position = R @ world.positions[k] + t  # metres before the camera
        linear = scale * R.T
        center = -R.T @ t
        shift = NEUMAN_SCALE * center + scale * R.T @ position - linear @ world.rest
        alignments[f"{k:05d}.png"] = np.concatenate([linear.T, shift[None]], 0)
    save_object(folder / "alignments.npy", alignments)
    person = {
        "pose": np.stack(poses).astype(np.float32),
        "betas": np.tile(BETAS, (FRAMES, 1)),
        "verts": np.zeros((FRAMES, 5, 3)),
    }
    joblib.dump({1: person}, folder / "smpl_output_romp.pkl")


def write_nerfstudio(folder: Path) -> None:
    """transforms.json: OpenGL's camera-to-world, Z up, lenses that bend, SMPL poses beside it."""
    world = World(Z_UP, (0.3, -0.2, 0.1))
    frames = []
    for name in ("0", "1"):
        K, R, t = world.cameras[name]
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = R.T @ FLIP, -R.T @ t
        for k in range(FRAMES):
            write_image(folder / "images" / f"{name}_{k}.png", see(name, k, K1).image)
            write_image(folder / "masks" / f"{name}_{k}.png", 255 * _mask(name, k, K1))
            frames.append(
                {
                    "file_path": f"images/{name}_{k}.png",
                    "mask_path": f"masks/{name}_{k}.png",
                    "time_index": k,
                    "transform_matrix": pose.tolist(),
                    "cx": K[0, 2],
                    "cy": K[1, 2],
                }
            )
    record = {
        "camera_model": "OPENCV",
        "fl_x": K[0, 0],
        "fl_y": K[1, 1],
        "w": WIDTH,
        "h": HEIGHT,
        "k1": K1,
        "frames": frames,
    }
    (folder / "transforms.json").write_text(json.dumps(record))
    np.savez(folder / "poses.npz", poses=world.thetas, trans=world.trans, betas=BETAS, mocap_framerate=30.0)


def _opencv_yaml(path: Path, entries: dict[str, object]) -> None:
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for key, value in entries.items():
        if isinstance(value, list):
            storage.startWriteStruct(key, cv2.FileNode_SEQ)
            for item in value:
                storage.write("", item)
            storage.endWriteStruct()
        else:
            storage.write(key, np.asarray(value, np.float64))
    storage.release()


def write_easymocap(folder: Path, *, volcap: bool = False) -> None:
    """EasyMocap (a JSON file a frame) or EasyVolcap (motion.npz)."""
    world = World(Z_UP, (0.3, -0.2, 0.1))
    names = {"0": "01", "1": "02"}
    intrinsics: dict[str, object] = {"names": list(names.values())}
    extrinsics: dict[str, object] = {"names": list(names.values())}
    folder.mkdir(exist_ok=True)
    for name, theirs in names.items():
        K, R, t = world.cameras[name]
        intrinsics |= {f"K_{theirs}": opencv_K(K), f"dist_{theirs}": np.array([[K1, 0, 0, 0, 0]])}
        extrinsics |= {f"R_{theirs}": matrix_to_axis_angle(R)[:, None], f"T_{theirs}": t[:, None]}
        if volcap:
            extrinsics |= {f"Rot_{theirs}": R}
        for k in range(FRAMES):
            _jpeg(folder / "images" / theirs / f"{k:06d}.jpg", see(name, k, K1).image)
            write_image(folder / ("masks" if volcap else "mask") / theirs / f"{k:06d}.png", 255 * _mask(name, k, K1))
    _opencv_yaml(folder / "intri.yml", intrinsics)
    _opencv_yaml(folder / "extri.yml", extrinsics)
    body = axis_angles()[:, 1:].reshape(FRAMES, -1)
    if volcap:
        poses = np.concatenate([np.zeros((FRAMES, 3)), body], 1)
        np.savez(folder / "motion.npz", poses=poses, Rh=world.Rh, Th=world.Th, shapes=np.tile(BETAS, (FRAMES, 1)))
        return
    for k in range(FRAMES):
        path = folder / "output" / "smpl" / "smpl" / f"{k:06d}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        person = {
            "id": 0,
            "Rh": [world.Rh[k].tolist()],
            "Th": [world.Th[k].tolist()],
            "poses": [body[k].tolist()],
            "shapes": [BETAS.tolist()],
        }
        path.write_text(json.dumps([person]))


def video_camera(focal: float) -> Camera:
    """The first camera with a centred lens, as programs for videos assume it."""
    K = np.array([[focal, 0, WIDTH / 2], [0, focal, HEIGHT / 2], [0, 0, 1]])
    return Camera(WIDTH, HEIGHT, K, cameras()["0"].world_to_camera)
