"""One frame of every readable motion: the file's own skeleton beside the avatar in the pose that was read.

    python scripts/motion_sheet.py docs/images/motions.png

Files come from the writers of tests/runtime/motion and from ../shared. Skeletons of files that hold one are drawn
from the file's own positions; of files of body models, from the motion that was written into them. Left limbs are
blue, right ones red.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

ROOT = Path(__file__).parent.parent
sys.path += [str(ROOT / "tests")]

from rnd_runtime.avatar.avatar import Avatar  # noqa: E402
from rnd_runtime.core.camera import Camera  # noqa: E402
from rnd_runtime.core.images import write_image  # noqa: E402
from rnd_runtime.core.rotations import axis_angle_to_matrix  # noqa: E402
from rnd_runtime.motion.formats.recordings import Recording, read_recording  # noqa: E402
from rnd_runtime.motion.joint_names import match_joints  # noqa: E402
from rnd_runtime.motion.limbs import Bones  # noqa: E402
from rnd_runtime.motion.motion import Motion, load_motion  # noqa: E402
from rnd_runtime.motion.solving.bones import leg_length  # noqa: E402
from rnd_runtime.motion.standing import UP_ROTATIONS  # noqa: E402
from rnd_runtime.playback.frame import FrameRenderer  # noqa: E402
from rnd_runtime.shading.files.load import load_light  # noqa: E402
from runtime.motion.formats_test import BONES, MIXAMO, POSITIONS, VRM_0, VRM_1, VRMA  # noqa: E402
from support import foreign_motion, known_motion  # noqa: E402
from support.known_motion import SKELETON  # noqa: E402
from support.known_skeletons import NAMINGS, write_amc, write_bvh  # noqa: E402
from support.paths import CASES, SHARED  # noqa: E402

WIDTH, HEIGHT, CAPTION, COLUMNS = 84, 150, 13, 11
GREY, TRUNK, LEFT, RIGHT = (52, 52, 56), (225, 225, 225), (90, 160, 255), (255, 120, 90)
AZIMUTH, DISTANCE, FOV = np.radians(30), 14.0, 0.152
LABEL = (205, 205, 205)

Floats = np.ndarray


class Panel(NamedTuple):
    """A motion file, the up axis of its skeleton, and the joints [F, J, 3] that were written where it has none."""

    name: str
    write: Callable[[Path], Path]
    up: str = "y"
    written: Floats | None = None
    part: float = 0.6
    """of the clip: the frame"""


class Figure(NamedTuple):
    """A skeleton: positions [J, 3], and of each joint its parent and the name by which it is coloured."""

    joints: Floats
    parents: Sequence[int]
    names: Sequence[str]


def panels() -> Iterator[Panel]:
    """Every layout of tests/runtime/motion, each naming and odd zero pose of BVH, and real recordings."""
    known = SKELETON.joint_transforms(known_motion.MATRICES, known_motion.PELVIS - SKELETON.rest_joints[0])[..., :3, 3]
    alike = (
        "dict in a pickle",
        "AMASS, split, body only",
        "pose_seq",
        "GoMAvatar",
        "EasyMocap, SMPL-H",
        "EasyMocap without its root",
    )
    for name, (write, _, _) in known_motion.LAYOUTS.items():
        if name not in alike:
            yield Panel(name, write, written=known)
    for name, write in {
        "PHALP": known_motion.write_phalp,
        "TRAM": known_motion.write_tram,
        "VIBE": known_motion.write_vibe,
        "WHAM, camera": known_motion.write_wham_in_camera,
    }.items():
        yield Panel(name, write, written=known)
    for name in ("joint positions", "MDM", "HumanML3D"):
        yield Panel("MDM's results" if name == "MDM" else name, POSITIONS[name], written=foreign_motion.JOINTS)
    for name, write in {
        "Kimodo": foreign_motion.write_kimodo,
        "GEM-X": foreign_motion.write_gemx,
        "SOMA-X": foreign_motion.write_somax,
        "SAM 3D Body": foreign_motion.write_sam3d,
        "GLB": lambda folder: foreign_motion.write_glb(folder, MIXAMO),
        "VRM 0": lambda folder: foreign_motion.write_glb(folder, BONES, VRM_0, "a.vrm"),
        "VRM 1": lambda folder: foreign_motion.write_glb(folder, BONES, VRM_1, "a.vrm"),
        "VRMA": lambda folder: foreign_motion.write_glb(folder, BONES, VRMA, "a.vrma"),
    }.items():
        yield Panel(name, write)
    yield Panel("ASF/AMC", write_amc)
    for naming in NAMINGS:
        if naming != "acclaim":
            yield Panel(f"BVH {naming}", lambda folder, naming=naming: write_bvh(folder / "a.bvh", NAMINGS[naming]))
    z_up = known_motion.Z_UP
    yield Panel("BVH, Z up", lambda folder: write_bvh(folder / "a.bvh", NAMINGS["smpl"], axes=z_up), "z")
    cases = ("bones_along_x/bones_along_x", "trunk_rolled/hips_rolled", "root_not_trunk/root_turned")
    for case in cases:
        yield Panel(f"BVH {case.rpartition('/')[2]}", lambda folder, case=case: CASES / f"bvh_{case}.bvh")
    for name in ("cmu_12_03.bvh", "dab.bvh", "jumping.bvh", "wave_hello.bvh", "02_01.amc"):
        up = "z" if name in ("dab.bvh", "jumping.bvh", "wave_hello.bvh") else "y"
        yield Panel(name, lambda folder, name=name: SHARED / "data/motion/bvh" / name, up)


def main(out: Path) -> None:
    """Write the sheet to ``out``."""
    avatar = Avatar.load(ROOT / "assets/avatar.onnx")
    renderer = FrameRenderer(avatar, load_light(ROOT / "assets/sky.exr"))
    tiles = []
    for panel in panels():
        with tempfile.TemporaryDirectory() as folder:
            tiles.append(_tile(panel, panel.write(Path(folder)), avatar, renderer))
    empty = np.full_like(tiles[0], GREY)
    tiles += [empty] * (-len(tiles) % COLUMNS)
    rows = [np.concatenate(tiles[k : k + COLUMNS], axis=1) for k in range(0, len(tiles), COLUMNS)]
    write_image(out, np.concatenate(rows))


def _tile(panel: Panel, path: Path, avatar: Avatar, renderer: FrameRenderer) -> Floats:
    motion = load_motion(path, avatar.skeleton)
    frame = round(panel.part * (motion.frame_count - 1))
    skeleton = avatar.skeleton
    pose = skeleton.joint_transforms(motion.rotations[frame : frame + 1], motion.translations[frame : frame + 1])
    ours = pose[0, :, :3, 3]
    figure, matched = _own_skeleton(panel, path, frame, motion)
    theirs = {name: figure.joints[k] for name, k in matched.items()}
    scale = leg_length({name: ours[k] for k, name in enumerate(skeleton.names)}) / leg_length(theirs)
    turn = _heading(motion) @ UP_ROTATIONS[panel.up]
    joints = scale * figure.joints @ turn.T
    joints -= scale * turn @ theirs["left_hip"] - ours[skeleton.names.index("left_hip")]
    camera = _camera(ours[0])
    drawn = _drawn(figure._replace(joints=joints), camera)
    shown = renderer.render(motion, frame / motion.fps, camera)
    alpha = np.asarray(shown.alpha)[..., None]
    body = (shown.srgb + (1 - alpha) * np.array(GREY)).clip(0, 255).astype(np.uint8)
    caption = np.full((CAPTION, 2 * WIDTH, 3), GREY, np.uint8)
    cv2.putText(caption, panel.name, (4, 10), cv2.FONT_HERSHEY_SIMPLEX, 0.34, LABEL, 1, cv2.LINE_AA)
    return np.concatenate([caption, np.concatenate([drawn, body], axis=1)])


def _own_skeleton(panel: Panel, path: Path, frame: int, motion: Motion) -> tuple[Figure, dict[str, int]]:
    """The skeleton of ``frame``, and its joints by our names."""
    if panel.written is not None:
        count = panel.written.shape[1]
        figure = Figure(panel.written[frame], SKELETON.parents[:count].tolist(), SKELETON.names[:count])
        return figure, {name: k for k, name in enumerate(figure.names)}
    recording = read_recording(path)
    assert isinstance(recording, Recording)
    tree, matched = recording.tree, recording.matched
    if matched is None:
        matched = match_joints(tree.names, SKELETON.names, bones=Bones(tree.parents, tree.offsets))
    skipped = len(tree.rotations) - motion.frame_count  # a reference pose
    joints = tree.positions(tree.global_rotations())[frame + skipped]
    names = list(tree.names)
    for ours, theirs in matched.items():
        names[theirs] = ours
    for joint, parent in enumerate(tree.parents):  # fingers and ends in the colour of their limb
        side = names[parent].partition("_")[0] if parent >= 0 else ""
        if side in ("left", "right") and not names[joint].startswith(("left", "right")):
            names[joint] = f"{side}_{joint}"
    first = next((k for k in range(len(names)) if names[k] in matched), 0)  # not the way from a scene's origin
    parents = [parent if parent >= first else -1 for parent in tree.parents]
    return Figure(joints, parents, names), dict(matched)


def _heading(motion: Motion) -> Floats:
    """The quarter turn of which the motion's notes tell."""
    words = next((note for note in motion.notes if note.startswith("rotated by")), "rotated by 0°")
    degrees = float(words.split()[2].rstrip("°"))
    return axis_angle_to_matrix([0.0, np.radians(degrees), 0.0])


def _camera(pelvis: Floats) -> Camera:
    target = np.array([pelvis[0], pelvis[1] + 0.02, pelvis[2]])
    eye = target + DISTANCE * np.array([np.sin(AZIMUTH), 0.12, np.cos(AZIMUTH)])
    return Camera.look_at(eye, target, width=WIDTH, height=HEIGHT, fov_y=FOV)


def _drawn(figure: Figure, camera: Camera) -> Floats:
    """Bones as lines on grey, at twice the size and reduced; nearer ones last."""
    seen = figure.joints @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    pixels = seen @ camera.K.T
    pixels = 16 * 2 * pixels[:, :2] / pixels[:, 2:]
    canvas: Any = np.full((2 * HEIGHT, 2 * WIDTH, 3), GREY, np.uint8)
    bones = [(seen[[k, parent], 2].mean(), k, parent) for k, parent in enumerate(figure.parents) if parent >= 0]
    for _, joint, parent in sorted(bones, reverse=True):
        side = figure.names[joint].partition("_")[0]
        colour = {"left": LEFT, "right": RIGHT}.get(side, TRUNK)
        ends = [tuple(int(value) for value in pixels[k]) for k in (parent, joint)]
        cv2.line(canvas, *ends, colour, 4, cv2.LINE_AA, shift=4)
        cv2.circle(canvas, ends[1], 16 * 3, colour, -1, cv2.LINE_AA, shift=4)
    return cv2.resize(canvas, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
