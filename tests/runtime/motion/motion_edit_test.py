"""Smoothing, speed, in place and loops: what they change, and what they must leave alone."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from rnd_runtime.core.errors import InputError
from rnd_runtime.motion.edit import MotionEdits, edit_motion, kept_in_place, looped, resampled, smoothed, sped_up
from rnd_runtime.motion.motion import Motion

FPS = 60.0
ROUND_OFF = 1e-12


def _motion(angles: np.ndarray, path: np.ndarray | None = None) -> Motion:
    """One joint turning about X by ``angles`` [F] rad beside a root at rest."""
    vectors = np.zeros((len(angles), 2, 3))
    vectors[:, 1, 0] = angles
    rotations = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(-1, 2, 3, 3)
    return Motion(rotations, np.zeros((len(angles), 3)) if path is None else path, FPS, ("root", "arm"))


def _angles(motion: Motion) -> np.ndarray:
    return np.unwrap(np.arctan2(motion.rotations[:, 1, 2, 1], motion.rotations[:, 1, 1, 1]))


def test_no_edits_change_nothing():
    motion = _motion(np.linspace(0, 1, 20))
    assert edit_motion(motion, MotionEdits()) is motion


def test_smoothing_stills_jitter():
    """1° of noise on a joint at rest: the paper's cutoff of 1 Hz keeps a seventh of it or less."""
    rng = np.random.default_rng(0)
    noise = np.radians(1) * rng.normal(size=600)
    path = 0.005 * rng.normal(size=(600, 3))
    still = smoothed(_motion(0.7 + noise, path), 1.0)
    assert np.std(_angles(still)[60:-60]) < np.std(noise) / 3
    assert np.abs(np.diff(_angles(still), 2)).mean() < np.abs(np.diff(noise, 2)).mean() / 10
    assert abs(_angles(still)[60:-60].mean() - 0.7) < np.radians(0.2)
    assert still.translations[60:-60].std() < path.std() / 3


def test_smoothing_prefers_no_direction_of_time():
    rng = np.random.default_rng(1)
    motion = _motion(rng.normal(size=90), rng.normal(size=(90, 3)))
    back = replace(motion, rotations=motion.rotations[::-1], translations=motion.translations[::-1])
    once, again = smoothed(motion, 1.0), smoothed(back, 1.0)
    assert_allclose(again.rotations[::-1], once.rotations, atol=1e-9)
    assert_allclose(again.translations[::-1], once.translations, atol=ROUND_OFF)


def test_smoothing_leaves_fast_movement_and_its_timing():
    """A wave of 1 Hz through ±60° reaches 6.6 rad/s: it keeps its height within 5 % and does not lag."""
    t = np.arange(300) / FPS
    wave = np.radians(60) * np.sin(2 * np.pi * t)
    after = _angles(smoothed(_motion(wave), 1.0))[60:-60]
    middle = wave[60:-60]
    assert 0.95 < np.ptp(after) / np.ptp(middle) < 1.01
    shifts = range(-8, 9)
    best = max(shifts, key=lambda shift: np.roll(after, shift)[10:-10] @ middle[10:-10])
    assert best == 0


def test_smoothing_crosses_half_a_turn_and_stays_a_rotation():
    motion = _motion(np.linspace(np.pi - 0.5, np.pi + 0.5, 120))
    after = smoothed(motion, 2.0)
    products = after.rotations @ np.swapaxes(after.rotations, -1, -2)
    assert_allclose(products, np.broadcast_to(np.eye(3), products.shape), atol=1e-9)
    assert np.abs(_angles(after) % (2 * np.pi) - _angles(motion) % (2 * np.pi)).max() < 0.05


@pytest.mark.parametrize("speed", [0.5, 2.0, 3.0])
def test_speed_changes_the_time_and_not_the_frame_rate(speed):
    motion = _motion(np.linspace(0, 1.2, 121))
    after = sped_up(motion, speed)
    assert after.fps == FPS and after.duration == pytest.approx(motion.duration / speed)
    assert_allclose(_angles(after), np.linspace(0, 1.2, after.frame_count), atol=ROUND_OFF)


def test_resampling_keeps_the_time():
    motion = _motion(np.linspace(0, 1.2, 121))
    after = resampled(motion, 25.0)
    assert after.fps == 25 and after.frame_count == 51
    assert_allclose(_angles(after), np.linspace(0, 1.2, 51), atol=ROUND_OFF)


def test_more_frames_than_memory_holds_are_refused():
    motion = replace(_motion(np.zeros(3)), fps=1e-3)
    words = r"frames of the motion: expected at most 2000000, got 20000001 in 2000 s at 10000 per second"
    with pytest.raises(InputError, match=words):
        resampled(motion, 1e4)


def test_a_loop_stays_one_at_another_rate_and_speed():
    """Half or twice its frames go round, and none of them twice."""
    once = looped(_motion(0.8 * np.sin(np.arange(72) / 7)))
    assert once.frame_count == 48
    for after, frames in ((resampled(once, 30.0), 24), (resampled(once, 120.0), 96), (sped_up(once, 2.0), 24)):
        assert after.closed and after.frame_count == frames
        assert after.duration == pytest.approx(frames / after.fps)
        expected = once.at(np.arange(frames) * 48 / frames / FPS)
        assert_allclose(after.rotations, expected.rotations, atol=ROUND_OFF)


def test_a_loop_that_no_whole_number_of_frames_goes_round_is_open():
    """48 frames at 60 per second are 20.8 at 26: the one after the 21st would come too late."""
    loop = looped(_motion(0.8 * np.sin(np.arange(72) / 7)))
    after = resampled(loop, 26.0)
    assert after.frame_count == 21 and not after.closed
    assert loop.loop_notes(30.0) == () == after.loop_notes(7.0)
    long = looped(_motion(0.8 * np.sin(np.arange(6011) / 7)))
    for rate in (23.0, 24.0, 29.97, 47.3):
        (note,) = long.loop_notes(rate)
        named = float(note.rpartition("(")[2].partition(" ")[0])
        assert long.goes_round_at(named) and long.frames_at(named) == round(long.duration * rate)
    (note,) = loop.loop_notes(26.0)
    assert note.startswith("the loop of 0.8 s is no whole number of frames at 26") and "26.25 per second" in note


def test_a_loop_of_few_frames_a_second_has_a_seam_of_one():
    assert looped(replace(_motion(np.linspace(0, 1, 10)), fps=0.5)).frame_count == 9


def test_in_place_keeps_heights_and_turns():
    path = np.cumsum(np.random.default_rng(0).normal(size=(30, 3)), 0)
    motion = _motion(np.linspace(0, 1, 30), path)
    after = kept_in_place(motion)
    assert (after.translations[:, [0, 2]] == path[0, [0, 2]]).all() and (after.translations[:, 1] == path[:, 1]).all()
    assert (after.rotations == motion.rotations).all()


def test_a_loop_has_no_seam():
    """Two and a bit periods with a jump where they end: afterwards no step is larger than the motion's own."""
    t = np.arange(150) / FPS
    path = np.stack([0.8 * t, 0.05 * np.sin(9 * t), np.zeros_like(t)], -1)
    motion = _motion(0.8 * np.sin(2 * np.pi * t) + 0.1 * t, path)
    after = looped(motion)
    angles = _angles(after)
    around = np.append(angles, angles[0])
    assert after.frame_count == 120
    assert np.abs(np.diff(around)).max() < 1.3 * np.abs(np.diff(_angles(motion))).max()
    closed = np.vstack([after.translations, after.translations[:1]])
    assert np.linalg.norm(np.diff(closed, axis=0), axis=1).max() < 0.02  # m a frame; the jump back was 2 m
    assert any("1.60 m" in note for note in after.notes)
    assert_allclose(angles[:90], _angles(motion)[30:120], atol=ROUND_OFF)  # all but the seam is as it was


def test_a_loop_goes_round_without_end_or_beginning():
    """At any time, before the start too, it is what the same frames written out three times are in their middle."""
    t = np.arange(100) / FPS
    once = looped(_motion(0.8 * np.sin(5 * t), np.stack([0 * t, np.cos(3 * t), 0 * t], -1)))
    thrice = replace(
        once,
        rotations=np.tile(once.rotations, (3, 1, 1, 1)),
        translations=np.tile(once.translations, (3, 1)),
        closed=False,
    )
    times = np.linspace(-0.9, 1.9, 57) * once.duration
    ours, written_out = once.at(times), thrice.at(times % once.duration + once.duration)
    assert once.closed and once.duration == pytest.approx(once.frame_count / FPS)
    assert_allclose(ours.rotations, written_out.rotations, atol=1e-9)
    assert_allclose(ours.translations, written_out.translations, atol=1e-9)


def test_a_periodic_motion_stays_as_it_is():
    t = np.arange(150) / FPS
    motion = _motion(0.8 * np.sin(4 * np.pi * t))
    after = looped(motion)  # 120 frames: four periods
    assert_allclose(_angles(after), _angles(motion)[30:], atol=1e-9)
    assert after.notes == ()


def test_edits_come_in_order():
    path = np.linspace(0, 2, 121)[:, None] * np.array([1.0, 0, 0])
    after = edit_motion(_motion(np.linspace(0, 1, 121), path), MotionEdits(3.0, 2.0, True, True))
    assert after.frame_count == 41 and np.ptp(after.translations, axis=0).max() < 1e-9 and after.notes == ()


@pytest.mark.parametrize("edits", [{"smooth": 0}, {"smooth": np.nan}, {"speed": -1}, {"loop": True}])
def test_nonsense_is_refused(edits):
    with pytest.raises(InputError, match="--"):
        edit_motion(_motion(np.zeros(3)), MotionEdits(**edits))
