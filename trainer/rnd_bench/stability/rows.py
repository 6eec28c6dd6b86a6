"""The rows of the stability list."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from rnd_bench.scenes.subject import Subject

from .figures import Result
from .measures import (
    captures,
    files,
    hostile,
    materials,
    motions,
    operating,
    parity,
    playback,
    poses,
    relighting,
    splats,
    stress,
    trainings,
    twists,
    zero_poses,
)

AVATAR = "the avatar"
SHORT = "a training of at most 4 000 Gaussians, 96²"
MADE = "Gaussians or a light made for it"
FILES = "files made for it"


class Row(NamedTuple):
    """One failure mode: its id in the list, its name, its measure and what it is measured ``on``."""

    id: str
    failure: str
    measure: Callable[[Subject], Result]
    on: str = AVATAR


ROWS: tuple[Row, ...] = (
    Row("P1", "out-of-distribution pose", poses.out_of_distribution),
    Row("P2", "candy wrapper", twists.candy_wrapper),
    Row("P3", "axis-angle wrap", poses.axis_angle_wrap),
    Row("P4", "global rotation", poses.global_rotation),
    Row("P7", "self-contact", playback.self_contact),
    Row("P8", "noisy poses", playback.noisy_poses),
    Row("P9", "flicker of dynamic weights", playback.weight_flicker),
    Row("P10", "the first d frames", playback.cold_start),
    Row("P11", "frame rate", playback.frame_rates),
    Row("P13", "bad motion", motions.bad_motions),
    Row("P14", "joint counts", motions.joint_counts),
    Row("P15", "betas", motions.other_betas),
    Row("P16", "wrong up axis or camera", motions.wrong_camera),
    Row("P17", "noisy poses in training", trainings.noisy_training_poses, SHORT),
    Row("P18", "any zero pose of a recording", zero_poses.any_zero_pose),
    Row("G1", "needles in unseen views", splats.needles),
    Row("G2", "zero, NaN, denormal quaternion; q and −q", splats.broken_quaternions, MADE),
    Row("G3", "camera inside, at a Gaussian, behind", splats.fly_through),
    Row("G5", "nothing in view", splats.nothing_in_view),
    Row("G6", "equal depths", splats.equal_depths, MADE),
    Row("G7", "image sizes", splats.image_sizes, MADE),
    Row("G9", "transfer functions and alpha", splats.grey_card, MADE),
    Row("G10", "rasters disagree", splats.rasters_agree),
    Row("L1", "bright suns", relighting.bright_suns),
    Row("L2", "black map", relighting.dark_maps),
    Row("L3", "broken texels", relighting.broken_texels),
    Row("L4", "orientation of the light", relighting.orientation, MADE),
    Row("L5", "resizing the light", relighting.resizing, MADE),
    Row("L7", "turning the light", relighting.turning_light),
    Row("L8", "white furnace", relighting.white_furnace, MADE),
    Row("L9", "broken normals", relighting.broken_normals),
    Row("L10", "grazing view", relighting.grazing, MADE),
    Row("L11", "albedo–light scale", materials.relit_scale),
    Row("L12", "light baked into albedo", materials.baked_light),
    Row("L13", "visibility blind to pose", materials.crossed_arms),
    Row("L15", "monochrome probe", relighting.monochrome_probe),
    Row("R1", "torch against onnxruntime", parity.torch_against_onnx),
    Row("R2", "f16 and int8", parity.stored_precisions),
    Row("R3", "threads, no AVX-512", parity.threads),
    Row("R4", "broken checkpoint or avatar", files.broken_files),
    Row("R5", "broken capture", captures.broken_captures),
    Row("R6", "empty or full masks", captures.bad_masks),
    Row("R9", "seeds", trainings.seeds, SHORT),
    Row("R10", "NaN while training", trainings.not_finite, SHORT),
    Row("R11", "resume", trainings.resumed, SHORT),
    Row("R12", "no display", files.no_display),
    Row("H1", "heap corruption by a calibration", hostile.calibration_text, FILES),
    Row("H2", "read-only containers", operating.no_home, FILES),
    Row("H3", "signals", operating.signals),
    Row("H4", "bombs", hostile.bombs, FILES),
    Row("H5", "fatter and brighter far away", operating.far_away),
    Row("H6", "graphs that are no exporter's", hostile.foreign_graphs),
    Row("H7", "two writers at once", operating.two_writers),
    Row("H8", "idle connections", operating.idle_clients),
    Row("H9", "a sun cut by HALF", hostile.cut_sun, MADE),
    Row("H10", "millimetres and times out of order", hostile.odd_motions, FILES),
    Row("H11", "numbers, names and modes of files", hostile.small_print, FILES),
)
TIMES = Row("T", "time in the worst cases", stress.worst_cases)
