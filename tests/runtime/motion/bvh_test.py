"""The known motion as BVH; refusals."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from rnd_runtime.core.errors import InputError
from rnd_runtime.motion.motion import load_motion
from rnd_runtime.motion.readers.bvh import read_bvh
from support.known_motion import DOUBLE, FRAMES, MATRICES, METRES, PELVIS, SKELETON, TEXT, Z_UP
from support.known_skeletons import NAMINGS, assert_same_poses, write_bvh


def test_hips_below_a_root_of_their_own_go_where_they_are_sent(tmp_path):
    """The same motion, its hips moved and turned in the frame of a root that is itself moved and turned."""
    file = write_bvh(tmp_path / "a.bvh", NAMINGS["mixamo"], spread={})
    head, _, frames = file.read_text().partition("MOTION\n")
    above = "ROOT Reference\n{\nOFFSET 0 0 0\nCHANNELS 6 Xposition Yposition Zposition Yrotation Xrotation Zrotation\n"
    head = head.replace("ROOT", above + "JOINT", 1) + "}\n"
    turn, place = Rotation.from_euler("Y", 70, degrees=True), np.array([1.0, 0.5, -2.0])
    counts, lines = frames.splitlines()[:2], frames.splitlines()[2:]
    for number, line in enumerate(lines):
        values = np.array([float(word) for word in line.split()])
        hips = Rotation.from_euler("ZXY", values[3:6], degrees=True)
        values[:3] = turn.inv().apply(values[:3] - place)
        values[3:6] = (turn.inv() * hips).as_euler("ZXY", degrees=True)
        lines[number] = " ".join(f"{value:.8f}" for value in [*place, 70, 0, 0, *values])
    below = tmp_path / "b.bvh"
    below.write_text(head + "MOTION\n" + "\n".join([*counts, *lines]) + "\n")
    plain, ours = load_motion(file, SKELETON), load_motion(below, SKELETON)
    assert np.ptp(ours.translations, axis=0).max() > 0.1 and ours.notes == plain.notes
    assert_allclose(ours.translations, plain.translations, atol=TEXT)
    assert_allclose(ours.rotations, plain.rotations, atol=TEXT)


def test_hips_beside_other_joints_of_a_root_go_where_they_are_sent(tmp_path):
    """As Unreal's, beside targets for hands and feet; a still root, and two joints of one name."""
    file = write_bvh(tmp_path / "a.bvh", NAMINGS["unreal"], spread={})
    plain = load_motion(file, SKELETON)
    head, _, frames = file.read_text().partition("MOTION\n")
    aside = "JOINT ik_foot\n{\nOFFSET 0 0 0\nCHANNELS 3 Zrotation Xrotation Yrotation\n}\n"
    above = "ROOT root\n{\nOFFSET 0 0 0\nCHANNELS 3 Zrotation Xrotation Yrotation\n"
    head = head.replace("ROOT", above + "JOINT", 1) + 2 * aside + "}\n"
    first, second, *lines = frames.splitlines()
    moved = [first, second, *(f"0 0 0 {line} 0 0 0 0 0 0" for line in lines)]
    file.write_text(head + "MOTION\n" + "\n".join(moved) + "\n")
    motion = load_motion(file, SKELETON)
    assert np.ptp(motion.translations, axis=0).max() > 0.1 and motion.notes == plain.notes
    assert_allclose(motion.translations, plain.translations, atol=TEXT)
    assert_allclose(motion.rotations, plain.rotations, atol=TEXT)


@pytest.mark.parametrize("added", [False, True])
def test_joints_are_where_their_own_positions_put_them(tmp_path, added):
    """Spine and thigh have positions too, which grow by a tenth or say how far they are from their offsets."""
    file = write_bvh(tmp_path / "a.bvh", NAMINGS["mixamo"], spread={})
    still = read_bvh(file)
    text, channels, joints = file.read_text(), [], []
    for line in text.partition("MOTION\n")[0].splitlines():
        words = line.split()
        if words[0] in ("ROOT", "JOINT"):
            joints.append(" ".join(words[1:]))
        channels += [(joints[-1], name) for name in words[2:] if words[0] == "CHANNELS"]
    thigh = "mixamorig:LeftUpLeg"
    at = [name for name, _ in channels].index(thigh)
    head, _, frames = text.partition("MOTION\n")
    before, mark, after = head.partition(f"JOINT {thigh}\n")
    after = after.replace("CHANNELS 3 ", "CHANNELS 6 Xposition Yposition Zposition ", 1)
    first, second, *lines = frames.splitlines()
    joint = still.names.index(thigh)
    places = still.offsets[joint] * (1 + np.linspace(-0.1, 0.1, FRAMES)[:, None])
    for number, line in enumerate(lines):
        words = line.split()
        words[at:at] = [f"{value:.8f}" for value in places[number] - added * still.offsets[joint]]
        lines[number] = " ".join(words)
    file.write_text(before + mark + after + "MOTION\n" + "\n".join([first, second, *lines]) + "\n")
    tree = read_bvh(file)
    turns = tree.global_rotations()
    positions, parent = tree.positions(turns), tree.parents[joint]
    expected = positions[:, parent] + np.einsum("fij,fj->fi", turns[:, parent], places)
    assert_allclose(positions[:, joint], expected, atol=TEXT)


@pytest.mark.parametrize(
    ("frames", "time"), [("Frames:12", "Frame Time:0.0083333"), ("Frames : 12", "Frame Time\t:\t.0083333")]
)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-be", "utf-16-le"])
def test_spaces_and_encodings_make_no_difference(tmp_path, frames, time, encoding):
    file = write_bvh(tmp_path / "a.bvh", NAMINGS["mixamo"])
    plain, text = load_motion(file, SKELETON), file.read_text()
    assert "Frames: 12\nFrame Time: 0.0083333" in text
    text = text.replace("Frames: 12\nFrame Time: 0.0083333", f"{frames}\n{time}").replace("\n", "\r\n")
    file.write_bytes(text.encode(encoding))
    motion = load_motion(file, SKELETON)
    assert motion.fps == plain.fps
    assert_allclose(motion.rotations, plain.rotations, atol=DOUBLE)


BROKEN_BVH = {
    "frames": "HIERARCHY ROOT a { OFFSET 0 0 0 CHANNELS 1 Xrotation } MOTION Frames 3 Frame Time: 0.03 1 2",
    "frame time": "HIERARCHY ROOT a { OFFSET 0 0 0 CHANNELS 1 Xrotation } MOTION Frames: 1 FrameRate: 0.03 1",
    "cut in channels": "HIERARCHY ROOT a { OFFSET 0 0 0 CHANNELS 3 Xrotation Yrotation",
    "empty": "",
    "no motion": "HIERARCHY\nROOT a\n{\nOFFSET 0 0 0\nCHANNELS 0\n}\n",
    "text": "HIERARCHY\nROOT a\n{\nOFFSET x 0 0\n",
    "other": "hello world",
    "end site first": "HIERARCHY End Site { OFFSET 0 0 0 } MOTION",
    "offset": "HIERARCHY ROOT a { OFFSET 0 nan 0 CHANNELS 0 } MOTION Frames: 1 Frame Time: 0.1",
    "short": "HIERARCHY ROOT a { OFFSET 0 0 0 CHANNELS 1 Xrotation } MOTION Frames: 3 Frame Time: 0.03 1 2",
    "time": "HIERARCHY ROOT a { OFFSET 0 0 0 CHANNELS 1 Xrotation } MOTION Frames: 1 Frame Time: 0 1",
    "no frames": "HIERARCHY ROOT a { OFFSET 0 0 0 CHANNELS 1 Xrotation } MOTION Frames: 0 Frame Time: 0.1",
    "two roots": "HIERARCHY ROOT a { OFFSET 0 0 0 CHANNELS 0 } ROOT b { OFFSET 0 0 0 CHANNELS 0 } MOTION Frames: 1",
    "channel": "HIERARCHY ROOT a { OFFSET 0 0 0 CHANNELS 1 Wrotation } MOTION Frames: 1 Frame Time: 0.1 1",
    "no channels": "HIERARCHY ROOT a { OFFSET 0 0 0 CHANNELS 0 } MOTION Frames: 1000000000000 Frame Time: 0.1",
    "far offset": "HIERARCHY ROOT a { OFFSET 0 1e200 0 CHANNELS 1 Xrotation } MOTION Frames: 1 Frame Time: 0.1 1",
    "huge turn": "HIERARCHY ROOT a { OFFSET 0 0 0 CHANNELS 1 Xrotation } MOTION Frames: 2 Frame Time: 0.1 1 1e300",
    "nan": "HIERARCHY ROOT a { OFFSET 0 0 0 CHANNELS 1 Xrotation } MOTION Frames: 2 Frame Time: 0.1 1 nan",
}


@pytest.mark.parametrize("broken", BROKEN_BVH)
def test_broken_bvh_is_refused_in_one_line(tmp_path, broken):
    (tmp_path / "a.bvh").write_text(BROKEN_BVH[broken])
    with pytest.raises(InputError) as caught:
        load_motion(tmp_path / "a.bvh", SKELETON)
    assert "a.bvh" in str(caught.value)
    assert ("frame 1" in str(caught.value)) == (broken in ("nan", "huge turn"))
    assert ("OFFSET: expected" in str(caught.value)) == (broken in ("offset", "far offset"))


@pytest.mark.parametrize("t_pose", [False, True])
def test_a_recorded_root_too_far_away_is_named_by_its_frame(tmp_path, t_pose):
    file = write_bvh(tmp_path / "a.bvh", NAMINGS["smpl"], t_pose=t_pose)
    lines = file.read_text().splitlines()
    lines[-1] = " ".join(["90000", *lines[-1].split()[1:]])
    file.write_text("\n".join(lines) + "\n")
    with pytest.raises(InputError, match=rf"frame {FRAMES - 1 + t_pose}: trans: expected metres, at most 1000"):
        load_motion(file, SKELETON)


@pytest.mark.parametrize("order", ["XYZ", "ZYX", "YXZ"])
@pytest.mark.parametrize("up", ["y", "z"])
def test_zero_pose_axes_units_and_channel_orders_make_no_difference(tmp_path, order, up):
    axes = Z_UP if up == "z" else np.eye(3)
    file = write_bvh(tmp_path / "a.bvh", NAMINGS["mixamo"], axes=axes, unit=100 / 2.54, order=order)
    motion = load_motion(file, SKELETON)
    assert_same_poses(motion.rotations, MATRICES)
    assert_allclose(np.diff(motion.translations, axis=0), np.diff(PELVIS, axis=0), atol=METRES)
