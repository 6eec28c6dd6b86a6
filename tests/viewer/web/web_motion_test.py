"""The page for static hosts reads the motions that Python reads, to the same poses, and refuses the others alike."""

from __future__ import annotations

import json
import shutil
import subprocess
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.npz import Npz
from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_runtime.motion.motion import load_motion
from rnd_runtime.motion.skeleton import Skeleton, smpl_skeleton
from support.paths import ROOT

WEB = ROOT / "viewer/web"
NODE = shutil.which("node")
ROUND_OFF = 1e-12
FRAMES = 5
Page = Callable[..., Any]

pytestmark = [
    pytest.mark.skipif(NODE is None, reason="needs Node.js"),
    pytest.mark.skipif(not (WEB / "node_modules/fflate").is_dir(), reason="needs npm ci in viewer/web"),
]

# Reads files as the page's worker does, one for each line
_READER = """
import { readFileSync } from "node:fs";
import { createInterface } from "node:readline";
const source = process.argv[1];
const rooms = ["motion/motion", "files/motion_files", "files/npz"];
const [{ fitMotion }, { readMotionFile }, { Npz }] =
    await Promise.all(rooms.map((name) => import(`${source}/${name}.js`)));
const attempt = (read) => { try { return read(); } catch (error) { return { refused: error.message }; } };
const members = (bytes, file, kind) => {
    const archive = new Npz(bytes, file, "motion");
    return Object.fromEntries(archive.names.map((name) => [name, attempt(() => archive[kind](name))]));
};
const plain = (key, value) => (value instanceof Float64Array ? [...value] : value);
for await (const line of createInterface({ input: process.stdin })) {
    const { file, skeleton, kind } = JSON.parse(line), bytes = new Uint8Array(readFileSync(file));
    const read = () => (skeleton ? fitMotion(readMotionFile(bytes, file), skeleton) : members(bytes, file, kind));
    console.log(JSON.stringify(attempt(read), plain));
}
"""


@pytest.fixture(scope="module")
def page() -> Iterator[Page]:
    """What the page's code makes of a file, in Node.js."""
    assert NODE is not None
    command = [NODE, "--input-type=module", "--eval", _READER, WEB.as_uri() + "/src"]
    pipes: Any = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "encoding": "utf-8", "bufsize": 1}
    with subprocess.Popen(command, **pipes) as process:

        def read(file: Path, **wish: object) -> Any:
            assert process.stdin is not None and process.stdout is not None
            print(json.dumps({"file": str(file), **wish}), file=process.stdin)
            return json.loads(process.stdout.readline(), parse_int=float)

        yield read


def _skeleton() -> Skeleton:
    """SMPL's tree, its root elsewhere than SMPL's own."""
    rest = np.random.default_rng(5).normal(size=(24, 3)) * 0.3
    rest[0] = [0.01, 1.0, 0.02]
    return smpl_skeleton(rest)


def _page_motion(page: Page, file: Path) -> Any:
    skeleton = _skeleton()
    rest = skeleton.rest_joints.reshape(-1).tolist()
    return page(file, skeleton={"names": skeleton.names, "rest": rest})


def _save(path: Path, **members: object) -> Path:
    np.savez(path, **{name: np.asarray(value) for name, value in members.items()})
    return path


def _assert_the_same(page: Page, file: Path) -> tuple[str, ...]:
    """The page makes of ``file`` what Python does; its notes."""
    got, expected = _page_motion(page, file), load_motion(file, _skeleton())
    assert "refused" not in got, got
    frames = expected.frame_count
    assert (got["frames"], got["joints"], got["fps"]) == (frames, 24, expected.fps)
    assert got["duration"] == pytest.approx(expected.duration)
    assert_allclose(np.reshape(got["rotations"], (frames, 24, 3, 3)), expected.rotations, atol=ROUND_OFF)
    assert_allclose(np.reshape(got["translations"], (frames, 3)), expected.translations, atol=ROUND_OFF)
    assert tuple(got["notes"]) == expected.notes
    return expected.notes


def _assert_refused_alike(page: Page, file: Path) -> str:
    """The page refuses ``file`` in Python's words; these."""
    with pytest.raises(InputError) as refused:
        load_motion(file, _skeleton())
    assert _page_motion(page, file) == {"refused": str(refused.value)}
    return str(refused.value)


def _poses(columns: int, frames: int = FRAMES) -> np.ndarray:
    return np.random.default_rng(columns).normal(size=(frames, columns)) * 0.5


TRANS = np.random.default_rng(9).normal(size=(FRAMES, 3))


# Arrays as numpy writes them

_NATIVE = ["f2", "f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "?"]
_SWAPPED = [">f2", ">f4", ">f8", ">i2", ">i8", ">u4"]


def _assert_members_are_the_same(page: Page, file: Path, *, strings: bool = False) -> None:
    got = page(file, kind="strings" if strings else "numbers")
    with Npz(file, what="motion") as members:
        assert sorted(got) == sorted(members.names)
        for name in members.names:
            try:
                if strings:
                    expected: Any = list(members.strings(name))
                else:
                    numbers = members.numbers(name)
                    expected = {"shape": list(numbers.shape), "numbers": numbers.reshape(-1).tolist()}
            except InputError as error:
                expected = {"refused": str(error)}
            assert got[name] == expected, name


@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("dtype", _NATIVE + _SWAPPED)
def test_numbers_of_every_type_and_order(page, tmp_path, dtype, order):
    kind, rng = np.dtype(dtype), np.random.default_rng(1)
    arrays = {}
    for shape in [(0, 3), (), (64,), (4, 3), (2, 3, 5)]:
        noise = rng.bytes(kind.itemsize * int(np.prod(shape)))
        numbers = np.frombuffer(noise, kind).reshape(shape) if kind.kind in "iu" else rng.normal(size=shape)
        arrays[f"shape {shape}"] = np.asarray(numbers).astype(kind, order=order)
    np.savez_compressed(tmp_path / "a.npz", **arrays)
    _assert_members_are_the_same(page, tmp_path / "a.npz")


def test_every_half_float(page, tmp_path):
    halves = np.arange(65536, dtype=np.uint16).view(np.float16)
    broken = {"nan": halves[0x7C01:0x7C03], "inf": halves[0xFC00:0xFC01], "frame": halves[0x7BFE:0x7C02].reshape(2, 2)}
    _save(tmp_path / "a.npz", halves=halves[np.isfinite(halves)], **broken)
    _assert_members_are_the_same(page, tmp_path / "a.npz")


def test_what_is_no_number(page, tmp_path):
    mixed = np.zeros(2, [("a", "<f8"), ("b", "<i4")])
    _save(
        tmp_path / "a.npz", text=["x"], raw=b"x", complex=[1j], single=np.complex64(1j), mixed=mixed, names=[None, "x"]
    )
    with zipfile.ZipFile(tmp_path / "a.npz", "a") as archive:
        archive.writestr("readme.txt", "not an array")
        archive.writestr("poses.npy", "not an array")
        archive.writestr("torn.npy", archive.read("complex.npy")[:-3])
        archive.writestr("short.npy", archive.read("complex.npy")[:9])
    _assert_members_are_the_same(page, tmp_path / "a.npz")


def test_strings(page, tmp_path):
    words = np.array([["pelvis", "", "a\0b"], ["Hüfte", "腰", "🦴"]])
    lone = np.array(["ab"])
    lone.view(np.uint32)[1] = 0xD800
    _save(
        tmp_path / "a.npz",
        words=words,
        columns=np.asfortranarray(words),
        swapped=words.astype(words.dtype.newbyteorder(">")),
        single="z",
        utf8=np.char.encode(words, "utf-8"),
        latin=np.array([b"H\xfcfte"]),
        lone=lone,
        numbers=np.arange(3),
        floats=np.zeros(3, np.float16),
        truths=np.zeros(3, bool),
    )
    _assert_members_are_the_same(page, tmp_path / "a.npz", strings=True)


def test_poses_by_columns_in_halves_are_a_motion(page, tmp_path):
    arrays = {
        "poses": np.asfortranarray(_poses(72), np.float16),
        "trans": np.asfortranarray(0.05 * TRANS),
        "fps": np.uint16(30),
    }
    assert _assert_the_same(page, _save(tmp_path / "a.npz", **arrays)) == ()
    _save(tmp_path / "a.npz", **(arrays | {"poses": np.asfortranarray(_poses(72).reshape(FRAMES, 24, 3))}))
    assert _assert_the_same(page, tmp_path / "a.npz") == ()


# Layouts

SPLIT = {"pose_body": _poses(63), "root_orient": _poses(3), "trans": TRANS}
AMASS_X = SPLIT | {"mocap_frame_rate": 120.0, "surface_model_type": "smplx", "betas": np.zeros(16)}
HANDS = {"pose_hand": _poses(90)}
EASYMOCAP = {"poses": _poses(72), "Rh": _poses(3), "Th": TRANS, "fps": 50}
NAMED = {"poses": _poses(15), "joint_names": ["root", "left_knee", "head", "tail", "left_index1"], "trans": TRANS}

UPSIDE_DOWN = np.pi * np.eye(72)[0]

LAYOUTS: dict[str, dict[str, object]] = {
    "SMPL": {"poses": _poses(72), "trans": TRANS, "fps": [30]},
    "SMPL, joints apart": {"poses": _poses(66).reshape(FRAMES, 22, 3), "transl": TRANS, "fps": 30},
    "SMPL-H": {"poses": _poses(156), "trans": TRANS, "mocap_framerate": 120.0, "betas": np.zeros(16)},
    "SMPL-X": {"poses": _poses(165), "trans": TRANS, "mocap_frame_rate": 30},
    "SMPL-X, Y up": {"poses": _poses(165), "trans": TRANS, "up_axis": "Y"},
    "split": SPLIT | {"fps": 30},
    "split, Z up": SPLIT | {"fps": 30, "up_axis": "z"},
    "split, fingers": SPLIT | {"left_hand_pose": _poses(45), "right_hand_pose": _poses(45).reshape(FRAMES, 15, 3)},
    "split, no root": {"body_pose": _poses(69), "transl": TRANS},
    "AMASS, split": AMASS_X | HANDS,
    "AMASS, split, body only": AMASS_X,
    "AMASS, split, few fingers": AMASS_X | {"pose_hand": _poses(12)},
    "AMASS, split, uneven sides": AMASS_X | {"left_hand_pose": _poses(42), "right_hand_pose": _poses(48)},
    "AMASS, split, a number for a hand": AMASS_X | {"pose_hand": np.array(1.0)},
    "AMASS, split, other fingers": AMASS_X | {"pose_hand": _poses(90, FRAMES + 1)},
    "AMASS, split, sides": AMASS_X | {"left_hand_pose": _poses(45), "right_hand_pose": _poses(45)},
    "AMASS, split, by its rate": SPLIT | {"mocap_frame_rate": 120.0},
    "AMASS, split, by its model": SPLIT | {"surface_model_type": "smplx"},
    "AMASS, split, by its length": SPLIT | {"mocap_time_length": 2.0},
    "AMASS, split, Y up": AMASS_X | {"up_axis": "y"},
    "AMASS beside its parts": AMASS_X | HANDS | {"poses": _poses(165)},
    "AMASS' parts, no poses of body": {"body_pose": _poses(63), "root_orient": _poses(3), "mocap_frame_rate": 30},
    "EasyMocap": EASYMOCAP,
    "EasyMocap, rows": EASYMOCAP | {"Rh": _poses(3)[:, None], "Th": TRANS[:, None]},
    "EasyMocap, all": {"poses_all": _poses(72), "Rh_all": _poses(3), "Th_all": TRANS},
    "EasyMocap, no root": EASYMOCAP | {"poses": _poses(69)},
    "EasyMocap, SMPL-X": EASYMOCAP | {"poses": _poses(165)},
    "named": NAMED | {"fps": 30},
    "named, a world before the root": NAMED
    | {"joint_names": ["world", "left_knee", "head", _skeleton().names[0], "left_index1"]},
    "named, Z up": NAMED | {"up_axis": ["z"]},
    "named parts": {"pose_body": _poses(63), "joint_names": list(_skeleton().names[1:22]), "mocap_frame_rate": 30},
    "still": {"poses": _poses(72)},
    "Python beside": {"poses": _poses(72), "trans": TRANS, "info": np.array([{"a": 1}, None])},
    "times": {"poses": _poses(72), "trans": TRANS, "times": 2 + np.arange(FRAMES) / 24},
    "uneven times": {
        "poses": _poses(72),
        "trans": TRANS,
        "timestamps": np.arange(FRAMES) / 24 + 2 * (np.arange(FRAMES) > 2),
    },
    "times that are none": {
        "poses": _poses(72),
        "trans": TRANS,
        "times": np.arange(FRAMES),
        "timestamps": ["a"] * FRAMES,
    },
    "degrees": {"poses": _poses(72) * 30, "trans": TRANS, "fps": 30},
    "matrices": {"poses": axis_angle_to_matrix(_poses(72).reshape(FRAMES, 24, 3)), "trans": TRANS, "fps": 30},
    "SMPL-X, standing along Y": {"poses": 0.1 * _poses(165), "trans": TRANS, "mocap_frame_rate": 30},
    "SMPL, standing along -Y": {"poses": 0.1 * _poses(72) + UPSIDE_DOWN, "trans": TRANS, "fps": 30},
    "SMPL-H, lying": {"poses": 0.1 * _poses(156), "trans": 0.05 * TRANS + np.array([0, 9, 0]), "fps": 30},
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_layout_is_the_same_motion(page, tmp_path, layout):
    notes = _assert_the_same(page, _save(tmp_path / "walk.npz", **LAYOUTS[layout]))
    assert any("are these degrees" in note for note in notes) == (layout == "degrees")


# Refusals


def _with(array: np.ndarray, place: tuple[int, ...], value: float) -> np.ndarray:
    changed = array.copy()
    changed[place] = value
    return changed


SMPL = LAYOUTS["SMPL"]
REFUSED: dict[str, tuple[dict[str, object], str]] = {
    "no poses": ({"trans": TRANS}, "a member called poses"),
    "nothing": ({}, "an empty archive"),
    "poses of text": (SMPL | {"poses": ["x"]}, "poses: expected numbers"),
    "poses of objects": (SMPL | {"poses": np.array([None])}, "Python objects"),
    "complex trans": (SMPL | {"trans": TRANS * 1j}, "trans: expected numbers"),
    "NaN in poses": (SMPL | {"poses": _with(_poses(72), (3, 40), np.nan)}, "frame 3: poses"),
    "NaN in trans": (SMPL | {"trans": _with(TRANS, (2, 1), np.nan)}, "frame 2: trans: expected finite"),
    "infinite trans": (SMPL | {"trans": _with(TRANS, (4, 0), -np.inf)}, "got -inf"),
    "NaN in Rh": (EASYMOCAP | {"Rh": _with(_poses(3), (1, 2), np.nan)}, "frame 1: Rh"),
    "NaN in Th": (EASYMOCAP | {"Th": _with(TRANS, (1, 2), np.nan)}, "frame 1: Th"),
    "NaN in a root": (SPLIT | {"root_orient": _with(_poses(3), (1, 2), np.nan)}, "frame 1: root_orient"),
    "NaN in a finger": (AMASS_X | {"pose_hand": _with(_poses(90), (1, 2), np.nan)}, "frame 1: pose_hand"),
    "one hand": (AMASS_X | {"left_hand_pose": _poses(45)}, "right_hand_pose is missing"),
    "millimetres": (SMPL | {"trans": TRANS * 1000}, "are these millimetres?"),
    "times that repeat": (SMPL | {"times": [0, 0.1, 0.1, 0.2, 0.3]}, "frame 2: times: expected numbers that increase"),
    "frames reversed": (SMPL | {"frame_ids": np.arange(FRAMES)[::-1]}, "got 3 after 4"),
    "kilometres of micrometres": (SMPL | {"trans": TRANS * 1e9}, "e+0"),
    "millimetres in Th": (EASYMOCAP | {"Th": TRANS * 1000}, "are these millimetres?"),
    "degrees": (SMPL | {"poses": _with(_poses(72), (2, 9), 180.0)}, "frame 2: poses: spine1"),
    "garbage": (SMPL | {"poses": _with(_poses(72), (0, 0), 3e38)}, "pelvis: expected an axis-angle"),
    "flat poses": (SMPL | {"poses": np.zeros(72)}, "shape of poses"),
    "a pose": (SMPL | {"poses": 1.0}, "a single number"),
    "odd columns": (SMPL | {"poses": np.zeros((FRAMES, 70))}, "shape of poses"),
    "matrices of nothing": (SMPL | {"poses": np.zeros((FRAMES, 24, 3, 3))}, "frame 0: poses: joint 0"),
    "mirrors": (SMPL | {"poses": np.tile(np.diag([1.0, 1, -1]), (FRAMES, 24, 1, 1))}, "expected rotation matrices"),
    "parts of matrices": (SMPL | {"poses": np.zeros((FRAMES, 24, 3, 2))}, "shape of poses"),
    "no frames": (SMPL | {"poses": np.zeros((0, 72))}, "at least one frame"),
    "fewer trans": (SMPL | {"trans": TRANS[1:]}, "as many frames as poses"),
    "turned trans": (SMPL | {"trans": TRANS.T}, "as many frames as poses"),
    "flat trans": (SMPL | {"trans": TRANS.ravel()}, "as many frames as poses"),
    "Rh alone": ({"poses": _poses(72), "Rh": _poses(3)}, "Th is missing"),
    "unknown joints": ({"poses": _poses(30)}, "10 joints (30 columns)"),
    "other names": (NAMED | {"poses": _poses(12)}, "expected 5 joints"),
    "a name twice": (NAMED | {"joint_names": ["root", "head", "head", "tail", "neck"]}, "each name once"),
    "names of numbers": (NAMED | {"joint_names": np.arange(5)}, "joint_names: expected strings"),
    "nobody's names": (NAMED | {"joint_names": list("abcde")}, "some of the avatar's"),
    "no rate": (SMPL | {"fps": 0}, "got [0.0]"),
    "two rates": (SMPL | {"fps": [30, 29.97]}, "got [30.0, 29.97]"),
    "endless rate": (SMPL | {"fps": np.inf}, "fps: expected finite"),
    "wild rate": (SMPL | {"mocap_framerate": 1e5}, "mocap_framerate"),
    "hardly a rate": (SMPL | {"fps": 0.0005}, "per second, 0.001 to 10000"),
    "rate of text": (SMPL | {"fps": "thirty"}, "fps: expected numbers"),
    "X up": (SMPL | {"up_axis": "x"}, "expected y or z"),
    "up by number": (SMPL | {"up_axis": 1}, "up_axis: expected strings"),
}


@pytest.mark.parametrize("mistake", REFUSED)
def test_what_cannot_be_a_motion_is_refused_in_pythons_words(page, tmp_path, mistake):
    members, reason = REFUSED[mistake]
    message = _assert_refused_alike(page, _save(tmp_path / "walk.npz", **members))
    assert reason in message and "\n" not in message


def _damaged(name: str) -> Callable[[Path], None]:
    """The archive with its member ``name`` cut short."""

    def write(path: Path) -> None:
        with zipfile.ZipFile(path) as archive:
            contents = {entry: archive.read(entry) for entry in archive.namelist()}
        with zipfile.ZipFile(path, "w") as archive:
            for entry, content in contents.items():
                archive.writestr(entry, content[:-8] if entry == name else content)

    return write


def _flip(path: Path) -> None:
    """The archive with one bit of a number changed, which only a checksum tells."""
    content, number = bytearray(path.read_bytes()), TRANS.astype(np.float64).tobytes()[:8]
    content[content.index(number)] ^= 1
    path.write_bytes(content)


DAMAGED: dict[str, Callable[[Path], Any]] = {
    "torn": lambda path: path.write_bytes(path.read_bytes()[:-200]),
    "empty": lambda path: path.write_bytes(b""),
    "text": lambda path: path.write_text("frame, x, y, z\n" * 100),
    "one array": lambda path: path.write_bytes(zipfile.ZipFile(path).read("poses.npy")),
    "no members": lambda path: zipfile.ZipFile(path, "w").close(),
    "poses cut": _damaged("poses.npy"),
    "trans cut": _damaged("trans.npy"),
    "rate cut": _damaged("fps.npy"),
    "a bit flipped": _flip,
}


@pytest.mark.parametrize("damage", DAMAGED)
def test_a_damaged_archive_is_refused_in_pythons_words(page, tmp_path, damage):
    file = _save(tmp_path / "walk.npz", **SMPL)
    DAMAGED[damage](file)
    assert "\n" not in _assert_refused_alike(page, file)
