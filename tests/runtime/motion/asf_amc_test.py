"""The known motion as ASF and AMC; refusals."""

import re

import numpy as np
import pytest
from numpy.testing import assert_allclose

from rnd_runtime.core.errors import InputError
from rnd_runtime.motion.motion import load_motion, motion_inputs
from support.known_motion import FRAMES, MATRICES, METRES, PELVIS, SKELETON, write_easymocap
from support.known_skeletons import assert_same_poses, write_amc


def test_acclaim_is_the_same_motion(tmp_path):
    motion = load_motion(write_amc(tmp_path), SKELETON)
    assert motion.fps == 120 and any("120" in note for note in motion.notes)
    assert_same_poses(motion.rotations, MATRICES)
    assert_allclose(np.diff(motion.translations, axis=0), np.diff(PELVIS, axis=0), atol=METRES)
    assert load_motion(tmp_path / "02_01.amc", SKELETON, fps=60).notes == ()


def test_the_inputs_of_a_motion_are_the_files_that_it_is_read_from(tmp_path):
    file = write_amc(tmp_path)
    (tmp_path / "03.asf").write_text(":root\n")
    assert motion_inputs(file) == [file, tmp_path / "02.asf"]
    folder = write_easymocap(tmp_path, frames=range(FRAMES))
    (folder / "out").mkdir()
    for name in ("picture.png", "out/000001.json"):
        (folder / name).write_text("{}")
    assert motion_inputs(folder) == [folder / f"{frame:06d}.json" for frame in range(FRAMES)]
    assert motion_inputs(tmp_path / "walk.npz") == [tmp_path / "walk.npz"]
    with pytest.raises(InputError) as caught:
        motion_inputs(tmp_path / "other" / "run.amc")
    assert str(caught.value) == f"{tmp_path / 'other' / 'run.amc'}: motion not found"


def test_acclaim_bones_keep_their_lengths(tmp_path):
    file = write_amc(tmp_path)
    skeleton = tmp_path / "02.asf"
    before = skeleton.read_text()
    at = before.index("name lfemur")
    skeleton.write_text(before[:at] + before[at:].replace("dof rx ry rz", "dof rx ry rz l", 1))
    lines = [line + " 1.5" if line.startswith("lfemur ") else line for line in file.read_text().splitlines()]
    file.write_text("\n".join(lines) + "\n")
    assert_same_poses(load_motion(file, SKELETON).rotations, MATRICES)
    skeleton.write_text(before[:at] + before[at:].replace("dof rx ry rz", "dof rx ry rq", 1))
    with pytest.raises(InputError, match=r"02\.asf: skeleton: .* freedom rq of lfemur"):
        load_motion(file, SKELETON)
    for number in ("nan", "inf"):
        words = before[:at] + before[at:].replace("length 0", f"length {number}", 1)
        skeleton.write_text(words)
        with pytest.raises(InputError, match=r"02\.asf: skeleton: .* not finite: " + number):
            load_motion(file, SKELETON)
    for words, replaced, reason in (
        ("direction 0 1 0", "direction 0 1", "2 numbers of three: 0 1"),
        ("    root link1", "    nobody link1", "link1 that no line of the hierarchy joins to the root"),
    ):
        assert words in before
        skeleton.write_text(before.replace(words, replaced).replace(" name lfemur", " name nobody\n  name lfemur"))
        with pytest.raises(InputError, match=r"02\.asf: skeleton: .*" + reason):
            load_motion(file, SKELETON)


def test_acclaims_numbers_beyond_any_use_are_refused(tmp_path):
    file = write_amc(tmp_path)
    skeleton, text = tmp_path / "02.asf", file.read_text()
    bone = next(line for line in text.splitlines() if line.startswith("lfemur"))
    file.write_text(text.replace(bone, "lfemur 1e300 0 0", 1))
    with pytest.raises(InputError, match=r"02_01\.amc: frame 0: lfemur: expected numbers of at most 1e\+06, got 1e"):
        load_motion(file, SKELETON)
    file.write_text(text)
    skeleton.write_text(skeleton.read_text().replace("length 0\n", "length 1e300\n", 1))
    with pytest.raises(InputError, match=r"02\.asf: skeleton: expected numbers of at most 1e\+06, got 1e"):
        load_motion(file, SKELETON)


def test_an_acclaim_frame_without_a_bone_of_the_others_is_refused(tmp_path):
    file = write_amc(tmp_path)
    lines = file.read_text().splitlines()
    file.write_text("\n".join(lines[:-3]) + "\n")
    with pytest.raises(InputError, match=rf"frame {FRAMES - 1}: \w+: expected numbers, as other frames have, got none"):
        load_motion(file, SKELETON)
    file.write_text("\n".join(line for line in lines if not line.startswith(("root", "lhand"))) + "\n")
    notes = load_motion(file, SKELETON).notes
    assert "bones that no frame has stay as the skeleton has them: root, lhand" in notes


def test_acclaim_needs_its_skeleton_and_fitting_bones(tmp_path):
    file = write_amc(tmp_path)
    skeleton = tmp_path / "02.asf"
    text = file.read_text()
    file.write_text(text.replace("lfemur", "lfemmur"))
    with pytest.raises(InputError, match="lfemmur"):
        load_motion(file, SKELETON)
    bone = next(line for line in text.splitlines() if line.startswith("lfemur"))
    for broken, words in (
        (text.replace(bone, "lfemur nan 0 0", 1), "frame 0: lfemur: expected finite numbers, got not finite: nan 0 0"),
        (text.replace(bone, bone + " 1", 1), "frame 0: lfemur: expected 3 numbers, got 4"),
        (bone + "\n" + text, "AMC motion: expected a frame's number before its bones, got lfemur"),
    ):
        file.write_text(broken)
        with pytest.raises(InputError, match=re.escape(words)):
            load_motion(file, SKELETON)
    file.write_text(text)
    skeleton.rename(tmp_path / "other.asf")
    assert load_motion(file, SKELETON).frame_count == FRAMES  # the only one there
    (tmp_path / "02.ASF").write_text(":root\n")
    assert motion_inputs(file.with_suffix(".AMC"))[1] == tmp_path / "02.ASF"
    (tmp_path / "02.ASF").unlink()
    (tmp_path / "third.asf").write_text(":root\n")
    with pytest.raises(InputError, match=r"02_01\.asf"):
        load_motion(file, SKELETON)
    (tmp_path / "02_01.asf").write_text("hello\n")
    with pytest.raises(InputError, match=r"02_01\.asf"):
        load_motion(file, SKELETON)
