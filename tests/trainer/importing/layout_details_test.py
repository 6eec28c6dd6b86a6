"""Details of the layouts, each against its definition."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.images import linear_to_srgb, read_image, srgb_to_linear, write_image
from rnd_runtime.core.rotations import axis_angle_to_matrix, matrix_to_axis_angle
from rnd_runtime.motion.smpl import SMPLX_REST_ROOT
from rnd_trainer.importing.body_models import BodyModel
from rnd_trainer.importing.dataset import ImportedDataset, Lens, Sample
from rnd_trainer.importing.layouts import arah, easymocap, instant_avatar, nerfstudio, neuman, rana, zju
from rnd_trainer.importing.layouts.colmap import read_text_model
from rnd_trainer.importing.options import FrameSelection
from rnd_trainer.importing.poses import smpl_poses
from rnd_trainer.importing.scene import place_scene
from rnd_trainer.importing.select import select_samples
from rnd_trainer.importing.write import write_capture
from support import layouts
from support.known_scene import FRAMES, HEIGHT, WIDTH, axis_angles, cameras, coarse_body
from support.pose_programs import PROGRAMS, write_easymocap_folder, write_romp


def _dataset(frames: list[int], samples: list[Sample]) -> ImportedDataset:
    lenses = {name: Lens(camera) for name, camera in cameras().items()}
    angles = np.zeros((len(frames), 24, 3))
    angles[:, :, 1] = 0.1 * np.array(frames)[:, None]
    trans = np.array(frames)[:, None] * [0.1, 0, 0]
    return ImportedDataset("ours", lenses, samples, smpl_poses(frames, angles, trans))


def _nothing() -> np.ndarray:
    return np.zeros((HEIGHT, WIDTH, 3), np.uint8)


def test_other_cameras_hold_out_frames_at_an_interval() -> None:
    """By count, not by number; after the border as novel poses."""
    numbers = list(range(0, 40, 2))
    samples = [Sample(name, number, _nothing) for name in cameras() for number in numbers]
    kept = select_samples(_dataset(list(range(40)), samples), FrameSelection(held_out_every=4))
    split = {(sample.camera, sample.frame): sample.split for sample in kept}
    assert [split["0", number] for number in numbers] == ["train"] * 16 + ["novel_pose"] * 4
    others = {number: split["1", number] for number in numbers if ("1", number) in split}
    assert list(others) == numbers[::4]
    assert others == {number: "novel_view" if number <= 30 else "novel_pose" for number in numbers[::4]}


def test_half_a_pixel_on_black_is_half_its_light(tmp_path) -> None:
    image = np.full((HEIGHT, WIDTH, 3), 200, np.uint8)
    mask = np.full((HEIGHT, WIDTH), 51, np.uint8)  # a fifth
    dataset = _dataset([0], [Sample("0", 0, lambda: image, lambda: mask, split="train")])
    scene = place_scene(dataset, BodyModel("SMPL", coarse_body(), np.zeros((1, 3, 0))), "y")
    write_capture(tmp_path, dataset, scene, dataset.samples)
    written = read_image(next((tmp_path / "images").iterdir()))
    expected = 255 * float(linear_to_srgb(0.2 * srgb_to_linear(np.array(200 / 255))))
    assert np.abs(written - expected).max() <= 0.5


def test_poses_between_given_ones_are_interpolated_evenly() -> None:
    dataset = _dataset([3, 4, 8], [])
    scene = place_scene(dataset, BodyModel("SMPL", coarse_body(), np.zeros((1, 3, 0))), "y")
    wanted = 0.1 * np.arange(3, 9)
    assert_allclose(matrix_to_axis_angle(scene.motion.rotations)[:, :, 1], np.tile(wanted[:, None], 24), atol=1e-9)
    assert_allclose(scene.motion.translations[:, 0], wanted, atol=1e-9)
    assert "3 of 6 poses are interpolated" in scene.notes


def _annots(folder: Path, key: str, change) -> None:
    file = folder / "annots.npy"
    content = np.load(file, allow_pickle=True).item()
    content["cams"][key] = [change(k, value) for k, value in enumerate(content["cams"][key])]
    layouts.save_object(file, content)


def test_every_camera_of_zju_mocap_has_its_own_distortion(tmp_path) -> None:
    layouts.write_zju(tmp_path)
    _annots(tmp_path, "D", lambda k, D: D * (k + 1))
    lenses = zju.read(tmp_path).lenses
    assert [lens.distortion[0] for lens in lenses.values()] == [layouts.K1, 2 * layouts.K1]


def test_zju_mocaps_positions_in_metres_stay_metres(tmp_path) -> None:
    layouts.write_zju(tmp_path)
    before = zju.read(tmp_path).lenses
    _annots(tmp_path, "T", lambda k, T: T / 1000)
    for name, lens in zju.read(tmp_path).lenses.items():
        assert_allclose(lens.camera.world_to_camera, before[name].camera.world_to_camera, atol=1e-9)


@pytest.mark.parametrize(("count", "held"), [(20, [2, 7, 12, 17]), (4, [2]), (11, [2, 7])])
def test_neumans_split_begins_half_an_interval_in(count, held) -> None:
    """As its own code has it: every (count // (count // 5))th image from half of that on."""
    chosen = [k for k, split in enumerate(neuman._splits(count)) if split == "novel_pose"]
    assert chosen == held


def test_colmaps_unit_is_the_fits_median(tmp_path) -> None:
    pytest.importorskip("joblib")
    layouts.write_neuman(tmp_path)
    assert "COLMAP's unit is 0.4 m by the fits" in neuman.read(tmp_path).notes


LENSES = {
    # COLMAP's parameters, K's f f c c, OpenCV's k1 k2 p1 p2
    "SIMPLE_PINHOLE": ("50 24 32", (50, 50, 24, 32), ()),
    "PINHOLE": ("50 60 24 32", (50, 60, 24, 32), ()),
    "SIMPLE_RADIAL": ("50 24 32 0.1", (50, 50, 24, 32), (0.1, 0, 0, 0)),
    "RADIAL": ("50 24 32 0.1 0.2", (50, 50, 24, 32), (0.1, 0.2, 0, 0)),
    "OPENCV": ("50 60 24 32 0.1 0.2 0.3 0.4", (50, 60, 24, 32), (0.1, 0.2, 0.3, 0.4)),
}


@pytest.mark.parametrize("model", LENSES)
def test_colmaps_lenses_keep_their_terms(tmp_path, model) -> None:
    parameters, (fx, fy, cx, cy), distortion = LENSES[model]
    (tmp_path / "cameras.txt").write_text(f"1 {model} {WIDTH} {HEIGHT} {parameters}\n")
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 0 1 a.png\n\n")
    (posed,) = read_text_model(tmp_path)
    assert_allclose(posed.K, [[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    assert posed.distortion == distortion


def _first_lens(folder: Path, drop: tuple[str, ...] = (), **changes: object) -> Lens:
    file = folder / "transforms.json"
    record = json.loads(file.read_text()) | changes
    record["frames"] = [{k: v for k, v in frame.items() if k not in ("cx", "cy")} for frame in record["frames"]]
    file.write_text(json.dumps({key: value for key, value in record.items() if key not in drop}))
    return nerfstudio.read(folder).lenses["0000"]


def test_nerfstudios_lens_is_in_opencvs_order(tmp_path) -> None:
    layouts.write_nerfstudio(tmp_path)
    terms = {"k3": 0.05, "p2": 0.04, "p1": 0.03, "k2": 0.02, "k1": 0.01}
    lens = _first_lens(tmp_path, fl_x=50, fl_y=60, **terms)
    assert lens.distortion == (0.01, 0.02, 0.03, 0.04, 0.05)
    assert (lens.camera.K[0, 0], lens.camera.K[1, 1]) == (50, 60)


def test_nerfstudios_camera_angle_is_horizontal(tmp_path) -> None:
    layouts.write_nerfstudio(tmp_path)
    K = _first_lens(tmp_path, ("fl_x", "fl_y"), camera_angle_x=np.pi / 2).camera.K
    assert_allclose(K, [[WIDTH / 2, 0, WIDTH / 2], [0, WIDTH / 2, HEIGHT / 2], [0, 0, 1]])


def test_ranas_field_of_view_is_horizontal(tmp_path) -> None:
    layouts.write_rana(tmp_path)
    for file in tmp_path.glob("*.json"):
        record = json.loads(file.read_text())
        del record["skeleton_0"]["smpl_data"]["K"]
        file.write_text(json.dumps(record | {"camera": {"fov": np.pi / 2}}))
    K = rana.read(tmp_path).lenses["0"].camera.K
    assert_allclose(K, [[WIDTH / 2, 0, WIDTH / 2], [0, WIDTH / 2, HEIGHT / 2], [0, 0, 1]])


def test_optimised_poses_come_before_others(tmp_path) -> None:
    """ARAH's opt_models, InstantAvatar's poses_optimized.npz."""
    for name, write in (("arah", layouts.write_arah), ("ia", layouts.write_instant_avatar)):
        (tmp_path / name).mkdir()
        write(tmp_path / name)
    models, better = tmp_path / "arah" / "models", tmp_path / "arah" / "opt_models"
    better.mkdir()
    for file in models.iterdir():
        np.savez(better / file.name, **dict(np.load(file)) | {"trans": np.full(3, 7.0)})
    poses = dict(np.load(tmp_path / "ia" / "poses.npz"))
    np.savez(tmp_path / "ia" / "poses_optimized.npz", **poses | {"transl": np.full((FRAMES, 3), 7.0)})
    for read in (arah.read(tmp_path / "arah"), instant_avatar.read(tmp_path / "ia")):
        assert_allclose(read.poses.root(np.zeros(3)), np.full((FRAMES, 3), 7.0))
        assert_allclose(read.poses.rotations[:, 1:22], axis_angle_to_matrix(axis_angles())[:, 1:22], atol=1e-6)


def test_the_alpha_of_an_image_is_its_mask(tmp_path) -> None:
    """Of transforms.json, where no mask is named."""
    layouts.write_nerfstudio(tmp_path)
    pixels = np.full((HEIGHT, WIDTH, 4), 90, np.uint8)
    pixels[..., 3] = np.arange(WIDTH) * 5
    write_image(tmp_path / "images" / "0_0.png", pixels)
    record = json.loads((tmp_path / "transforms.json").read_text())
    del record["frames"][0]["mask_path"]
    (tmp_path / "transforms.json").write_text(json.dumps(record))
    mask = nerfstudio.read(tmp_path).samples[0].mask
    assert mask is not None and np.array_equal(mask(), pixels[..., 3])


# Images and poses of nerfstudio and EasyMocap


@pytest.mark.parametrize(
    ("numbers", "frames"), [([1, 2, 3, 4], [1, 2, 3, 4]), ([0, 1, 2, 3], [1, 2, 3, 4]), (None, [0, 1, 2, 3])]
)
@pytest.mark.parametrize("moves", [0, 1])
def test_images_of_one_camera_belong_to_poses_by_name(tmp_path, moves, numbers, frames) -> None:
    """In any order of transforms.json: to poses in numbered files and in one."""
    layouts.write_nerfstudio(tmp_path)
    record = json.loads((tmp_path / "transforms.json").read_text())
    for k, entry in zip((2, 1, 4, 3), record["frames"]):
        entry |= {"time_index": None, "file_path": f"f{k}.png"}
        entry["transform_matrix"][0][3] += moves * k
    del record["frames"][FRAMES:]
    (tmp_path / "transforms.json").write_text(json.dumps(record))
    poses = None if numbers is None else write_easymocap_folder(tmp_path, numbers)
    dataset = nerfstudio.read(tmp_path, poses=poses)
    assert {sample.name: sample.frame for sample in dataset.samples} == dict(zip(("f1", "f2", "f3", "f4"), frames))
    assert dataset.poses.frames.tolist() == frames
    assert any("taken for the same" in note for note in dataset.notes) == (numbers == [0, 1, 2, 3])


@pytest.mark.parametrize("program", PROGRAMS)
def test_poses_in_camera_axes_move_into_the_world_of_a_single_camera(tmp_path, program) -> None:
    """A moving camera's world has another scale than the poses."""
    (tmp_path / "source").mkdir()
    layouts.write_nerfstudio(tmp_path / "source")
    file = tmp_path / "source" / "transforms.json"
    record = json.loads(file.read_text())
    poses = PROGRAMS[program](tmp_path)
    with pytest.raises(InputError, match=r"transforms\.json: body poses: expected some in the cameras' world, got .*2"):
        nerfstudio.read(tmp_path / "source", poses=poses)
    file.write_text(json.dumps(record | {"frames": record["frames"][:FRAMES]}))
    theirs = nerfstudio.read(tmp_path / "source", poses=poses).poses
    world = layouts.World(layouts.Z_UP, (0.3, -0.2, 0.1))
    rest = SMPLX_REST_ROOT if program == "gvhmr" else world.rest
    assert_allclose(theirs.root(rest), world.positions, atol=2e-5)
    assert_allclose(theirs.rotations[:, 0], world.roots, atol=2e-5)


def test_poses_in_camera_axes_are_refused_for_easymocaps_cameras(tmp_path) -> None:
    (tmp_path / "source").mkdir()
    layouts.write_easymocap(tmp_path / "source")
    with pytest.raises(InputError, match="expected some in the cameras' world, got ROMP's"):
        easymocap.read(tmp_path / "source", poses=write_romp(tmp_path))


def test_rows_of_easyvolcaps_motion_belong_to_the_images_in_their_order(tmp_path) -> None:
    """Whatever their first number; JSON files have numbers of their own."""
    layouts.write_easymocap(tmp_path, volcap=True)
    for part in ("images", "masks"):
        for file in sorted(tmp_path.glob(f"{part}/*/*"), reverse=True):
            file.rename(file.with_stem(f"{int(file.stem) + 1:06d}"))
    dataset = easymocap.read(tmp_path)
    assert {(sample.name, sample.frame) for sample in dataset.samples} == {(f"{k + 1:06d}", k) for k in range(FRAMES)}
    assert dataset.poses.frames.tolist() == list(range(FRAMES)) and not dataset.notes
    numbered = easymocap.read(tmp_path, poses=write_easymocap_folder(tmp_path, [1, 2, 3, 4]))
    assert {sample.frame for sample in numbered.samples} == {1, 2, 3, 4} == set(numbered.poses.frames.tolist())


FISHEYES = {"camera_model": ["OPENCV_FISHEYE", "EQUIRECTANGULAR"], "is_fisheye": [True], "k4": [0.1]}


@pytest.mark.parametrize(("key", "value"), [(key, value) for key in FISHEYES for value in FISHEYES[key]])
@pytest.mark.parametrize("of_all", [True, False])
def test_fisheye_lenses_are_refused(tmp_path, of_all, key, value) -> None:
    layouts.write_nerfstudio(tmp_path)
    record = json.loads((tmp_path / "transforms.json").read_text())
    (record if of_all else record["frames"][-1])[key] = value
    (tmp_path / "transforms.json").write_text(json.dumps(record))
    with pytest.raises(InputError, match=rf"transforms\.json: {key}: expected .*, got {value}"):
        nerfstudio.read(tmp_path)


@pytest.mark.parametrize("model", ["OPENCV", "SIMPLE_RADIAL", None])
def test_pinholes_are_read(tmp_path, model) -> None:
    """Also with instant-ngp's entries that deny a fisheye."""
    layouts.write_nerfstudio(tmp_path)
    record = json.loads((tmp_path / "transforms.json").read_text())
    more = {"camera_model": model, "is_fisheye": False, "k4": 0}
    (tmp_path / "transforms.json").write_text(json.dumps(record | more))
    assert nerfstudio.read(tmp_path).samples


_MATRIX = "{key}_01: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: {data}\n"


@pytest.mark.parametrize("name", ["intri.yml", "extri.yml"])
@pytest.mark.parametrize(
    "text",
    [
        "",
        "hello",
        "%YAML:1.0\n---\nnames: [1, \n",
        "%YAML:1.0\n---\nnames: &a 3\n",
        "%YAML:1.0\n---\nnames: 3\nK_01: 1\nT_01: 1\n",
        *(
            '%YAML:1.0\n---\nnames: ["01"]\n' + "".join(_MATRIX.format(key=key, data=data) for key in "KTR")
            for data in ("[1, 2]", "[1, 2, 3, 4, 5, 6, 7, 8, .nan]", "3")
        ),
    ],
)
def test_a_damaged_calibration_is_named(tmp_path, name, text) -> None:
    layouts.write_easymocap(tmp_path)
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=r"(in|ex)tri\.yml: .*expected|(in|ex)tri\.yml: .* is missing"):
        easymocap.read(tmp_path)
