"""Noise that differs from frame to frame, taken out of estimated motions: who looks at single images jitters.

Each joint is smoothed by local polynomials (Savitzky and Golay 1964) of the width of least risk (Stein 1981). The noise
is measured on sixth differences, in which the motion of people hardly shows.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d
from scipy.signal import savgol_coeffs

from rnd_runtime.core.rotations import axis_angle_to_matrix, matrix_to_axis_angle
from rnd_runtime.motion.motion import Motion

Floats = NDArray[np.float64]

REACHES = (2, 3, 4, 5, 6, 7, 8, 10)
"""frames on each side that a polynomial spans"""
DEGREE = 3
DIFFERENCES = 6
SLOWEST_FPS = 24.0
"""below which people's own motion differs as much from frame to frame"""
AROUND_SECONDS = 4.0
"""time over which a width's risk is averaged"""
_MEDIAN = 0.6745  # of the absolute value of a standard normal variable


def without_jitter(motion: Motion) -> Motion:
    """``motion`` smoothed as far as each joint jitters; its ends stay, and so do slow and short ones as a whole."""
    reach = max(REACHES)
    count = motion.frame_count
    if count <= 2 * reach or motion.fps < SLOWEST_FPS:
        return motion
    shifted = np.clip(np.arange(count)[:, None] + np.arange(-reach, reach + 1), 0, count - 1)  # [T, 2·reach + 1]
    around = round(AROUND_SECONDS * motion.fps)
    rotations = motion.rotations.copy()
    for joint in range(rotations.shape[1]):
        now = motion.rotations[:, joint]
        turns = matrix_to_axis_angle(np.swapaxes(now, -1, -2)[:, None] @ now[shifted])
        rotations[:, joint] = now @ axis_angle_to_matrix(_correction(turns, around))
    moves = motion.translations[shifted] - motion.translations[:, None]
    return replace(motion, rotations=rotations, translations=motion.translations + _correction(moves, around))


def _correction(nearby: Floats, around: int) -> Floats:
    """Corrections [T, 3] of least risk, from the frames ``nearby`` [T, 2·reach + 1, 3] each, relative to it."""
    count, middle = len(nearby), nearby.shape[1] // 2
    noise = _noise(nearby[middle:-middle, middle - DIFFERENCES // 2 : middle + DIFFERENCES // 2 + 1])
    corrections, risks = [np.zeros((count, 3))], [np.zeros(count)]
    for reach in REACHES:
        weights = savgol_coeffs(2 * reach + 1, DEGREE)  # of the polynomial's value in the middle
        inside = slice(reach, count - reach)
        correction, risk = np.zeros((count, 3)), np.full(count, np.inf)
        correction[inside] = np.einsum("k,tkc->tc", weights, nearby[inside, middle - reach : middle + reach + 1])
        each = (correction[inside] ** 2).sum(1) + 6 * (weights[reach] - 1) * noise
        risk[inside] = uniform_filter1d(each, around, mode="nearest")
        corrections.append(correction)
        risks.append(risk)
    least = np.argmin(risks, axis=0)
    return np.asarray(np.stack(corrections)[least, np.arange(count)])


def _noise(nearby: Floats) -> float:
    """Variance of each axis of what differs from frame to frame."""
    differences = np.diff(nearby, DIFFERENCES, axis=1)
    return float((np.median(np.abs(differences)) / _MEDIAN) ** 2 / math.comb(2 * DIFFERENCES, DIFFERENCES))
