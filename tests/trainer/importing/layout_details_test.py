"""Details of the layouts that one well-behaved scene cannot tell apart, each against its definition."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from rnd_runtime.core.images import linear_to_srgb, read_image, srgb_to_linear, write_image
from rnd_runtime.core.rotations import axis_angle_to_matrix, matrix_to_axis_angle
from rnd_trainer.importing.body_models import BodyModel
from rnd_trainer.importing.layouts import arah, instant_avatar, nerfstudio, neuman, rana, zju
from rnd_trainer.importing.layouts.colmap import read_text_model
from rnd_trainer.importing.options import Choice
from rnd_trainer.importing.pose_files import read_poses
from rnd_trainer.importing.recording import Lens, Recording, Shot, smpl_poses
from rnd_trainer.importing.write import chosen_shots, placed, write_capture
from support import layouts
from support.known_scene import FRAMES, HEIGHT, WIDTH, axis_angles, cameras, coarse_body
from trainer.importing.pose_files_test import PROGRAMS

BROAD, LOW = 64, 48  # pixels of a landscape picture: the scene's are portraits


def _recording(frames: list[int], shots: list[Shot]) -> Recording:
    lenses = {name: Lens(camera) for name, camera in cameras().items()}
    angles = np.zeros((len(frames), 24, 3))
    angles[:, :, 1] = 0.1 * np.array(frames)[:, None]
    trans = np.array(frames)[:, None] * [0.1, 0, 0]
    return Recording("ours", lenses, shots, smpl_poses(frames, angles, trans))


def _nothing() -> np.ndarray:
    return np.zeros((HEIGHT, WIDTH, 3), np.uint8)


def test_other_cameras_hold_out_every_so_many_of_the_frames_that_there_are() -> None:
    """Counted, not by their numbers, which may be even all of them; after the border they are of novel poses."""
    numbers = list(range(0, 40, 2))
    shots = [Shot(name, number, _nothing) for name in cameras() for number in numbers]
    kept = chosen_shots(_recording(list(range(40)), shots), Choice(held_out_every=4))
    split = {(shot.camera, shot.frame): shot.split for shot in kept}
    assert [split["0", number] for number in numbers] == ["train"] * 16 + ["novel_pose"] * 4
    others = {number: split["1", number] for number in numbers if ("1", number) in split}
    assert list(others) == numbers[::4]
    assert others == {number: "novel_view" if number <= 30 else "novel_pose" for number in numbers[::4]}


def test_half_a_pixel_on_black_is_half_its_light(tmp_path) -> None:
    image = np.full((HEIGHT, WIDTH, 3), 200, np.uint8)
    mask = np.full((HEIGHT, WIDTH), 51, np.uint8)  # a fifth
    recording = _recording([0], [Shot("0", 0, lambda: image, lambda: mask, split="train")])
    scene = placed(recording, BodyModel("SMPL", coarse_body(), np.zeros((1, 3, 0))), "y")
    write_capture(tmp_path, recording, scene, recording.shots)
    written = read_image(next((tmp_path / "images").iterdir()))
    expected = 255 * float(linear_to_srgb(0.2 * srgb_to_linear(np.array(200 / 255))))
    assert np.abs(written - expected).max() <= 0.5


def test_poses_between_given_ones_turn_and_move_evenly() -> None:
    recording = _recording([3, 4, 8], [])
    scene = placed(recording, BodyModel("SMPL", coarse_body(), np.zeros((1, 3, 0))), "y")
    wanted = 0.1 * np.arange(3, 9)
    assert_allclose(matrix_to_axis_angle(scene.motion.rotations)[:, :, 1], np.tile(wanted[:, None], 24), atol=1e-9)
    assert_allclose(scene.motion.translations[:, 0], wanted, atol=1e-9)
    assert "3 of 6 poses lie between given ones" in scene.notes


def _annots(folder: Path, key: str, change) -> None:
    file = folder / "annots.npy"
    content = np.load(file, allow_pickle=True).item()
    content["cams"][key] = [change(k, value) for k, value in enumerate(content["cams"][key])]
    layouts._save_object(file, content)


def test_every_camera_of_zju_mocap_bends_as_its_own_lens_does(tmp_path) -> None:
    layouts.write_zju(tmp_path)
    _annots(tmp_path, "D", lambda k, D: D * (k + 1))
    lenses = zju.read(tmp_path).lenses
    assert [lens.distortion[0] for lens in lenses.values()] == [layouts.K1, 2 * layouts.K1]


def test_zju_mocaps_places_in_metres_stay_metres(tmp_path) -> None:
    layouts.write_zju(tmp_path)
    before = zju.read(tmp_path).lenses
    _annots(tmp_path, "T", lambda k, T: T / 1000)
    for name, lens in zju.read(tmp_path).lenses.items():
        assert_allclose(lens.camera.world_to_camera, before[name].camera.world_to_camera, atol=1e-9)


@pytest.mark.parametrize(("count", "held"), [(20, [2, 7, 12, 17]), (4, [2]), (11, [2, 7])])
def test_neumans_split_begins_half_an_interval_in(count, held) -> None:
    """As its own code has it: every (count // (count // 5))th picture from half of that on."""
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
    parameters, (fx, fy, cx, cy), bent = LENSES[model]
    (tmp_path / "cameras.txt").write_text(f"1 {model} {WIDTH} {HEIGHT} {parameters}\n")
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 0 1 a.png\n\n")
    (posed,) = read_text_model(tmp_path)
    assert_allclose(posed.K, [[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    assert posed.distortion == bent


@pytest.mark.parametrize("program", ["phalp", "romp", "wham"])
def test_a_programs_lens_goes_by_the_longer_side(tmp_path, program) -> None:
    found = read_poses(PROGRAMS[program](tmp_path))
    assert found.focal is not None
    expected = {"phalp": 5000 * BROAD / 256, "romp": 0.5 * BROAD / np.tan(np.radians(30)), "wham": np.hypot(BROAD, LOW)}
    assert found.focal(BROAD, LOW) == pytest.approx(expected[program])


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


def test_nerfstudios_camera_angle_is_of_the_width(tmp_path) -> None:
    layouts.write_nerfstudio(tmp_path)
    K = _first_lens(tmp_path, ("fl_x", "fl_y"), camera_angle_x=np.pi / 2).camera.K
    assert_allclose(K, [[WIDTH / 2, 0, WIDTH / 2], [0, WIDTH / 2, HEIGHT / 2], [0, 0, 1]])


def test_ranas_field_of_view_is_of_the_width(tmp_path) -> None:
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


def test_the_alpha_of_a_picture_is_its_mask(tmp_path) -> None:
    """Of transforms.json, where no mask is named."""
    layouts.write_nerfstudio(tmp_path)
    pixels = np.full((HEIGHT, WIDTH, 4), 90, np.uint8)
    pixels[..., 3] = np.arange(WIDTH) * 5
    write_image(tmp_path / "images" / "0_0.png", pixels)
    record = json.loads((tmp_path / "transforms.json").read_text())
    del record["frames"][0]["mask_path"]
    (tmp_path / "transforms.json").write_text(json.dumps(record))
    mask = nerfstudio.read(tmp_path).shots[0].mask
    assert mask is not None and np.array_equal(mask(), pixels[..., 3])
