"""From what the networks say at the nodes to posed Gaussians, in one compiled pass.

An avatar's graph evaluates its networks at M nodes and does the rest for N Gaussians, operation by operation: two
thirds of its time. Here each Gaussian goes through all of it at once:

    fields = Σ_k weight_k · node fields[neighbour_k]          Δ logits, Δx and Δr before tanh, visibility
    W      = softmax(log W_template + Δ logits)
    A      = Σ_j W_j B_j = [A_R | A_T]                        see below
    t      = min(1, |cofactor(A_R) u| / |A_R u|²)             u: the limb's axis; 1 but where it is twisted
    κ      = share · (Newton–Schulz factor of t − 1)          widens what a twist has pinched
    mean   = A_R (x_c + max_offset · tanh Δx + κ lever) + A_T
    Σ      = F Fᵀ + floor² I,  F = A_R · C · R(tanh Δr) · (R S)   R(v): the quaternion normalize(1, v/2)
    normal = normalize((cofactor(A_R) + fallback · A_R) (n_c + κ u (u·n_c)))      C = (1 + κ) I − κ u uᵀ

``posing_reference`` says the same in plain float64.

The template gives a Gaussian a few joints, and to all others its floor, one in a million, which Δ logits may raise. So
A is summed over these few joints exactly, and over the floor of all joints at the nodes, between which it is then
interpolated as the fields are: with the node's greatest Δ logit c_k and c = Σ_k weight_k c_k,

    A ∝ Σ_{j of the template} (W_template,j / floor − 1) e^{Δ_j − c} B_j + Σ_k weight_k Σ_j e^{Δ_kj − c_k} B_j.

The second sum has the mean of the nodes' exponentials where the definition has the exponential of their mean. A trained
avatar's Gaussians are moved by 0.6 µm in the mean by that, the worst of 30 000 by 0.2 mm.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numba import njit, prange
from numpy.typing import ArrayLike, NDArray

from rnd_runtime.core.arrays import floats
from rnd_runtime.core.simd import (
    WIDTH,
    aligned_floats,
    exp2,
    lanes,
    load,
    prefetch,
    prefetch_to_write,
    root,
    select,
    spread,
    store,
    transpose,
)

Floats32 = NDArray[np.float32]

_HARMONICS = 16
_CHUNK = 256  # Gaussians handed to a thread at a time
_LOG2_E = np.float32(np.log2(np.e))
_SMALLEST_POWER = np.float32(-126)  # of two in float32
_LARGEST_TANH = np.float32(9)  # beyond it tanh is 1 in float32
_ZERO, _HALF, _ONE, _TWO = (np.float32(x) for x in (0, 0.5, 1, 2))
_SHORTEST = np.float32(1e-9)  # of a normal before it is normalised
TWIST_STEPS = 3  # of Newton–Schulz, s → s (3 − s²)/2 on s = √t: two leave 0.54 of a limb at 150°, three 0.73
SMALLEST_SQUARE = np.float32(1e-6)  # of |A_R u|: a blend without length has no axis to be widened about
_THREE = np.float32(3)
# Where each begins among the rest pose's components, and how many these are
_POINTS, _FACTORS, _NORMALS, _LIMBS, _FLOOR, _OWN = (0, 3, 12, 15, 22, 23)
_DEEPEST = 60.0  # logarithm below which a floor is 0 beside the greatest weight, and not yet in float32
# A node's fields: Σ_j e^(Δ_j − c) B_j by rows, the same without B, and c; offsets, visibility, sixteen each; Δ_j
_SUM, _GREATEST, _OFFSETS, _VISIBILITY, _CHANGES = (12, 13, WIDTH, 2 * WIDTH, 3 * WIDTH)
NEVER = np.float32(-1e30)  # log of no weight


class Posed(NamedTuple):
    """Posed Gaussians in the frame of the bones; see ``core.gaussians.Gaussians``."""

    means: Floats32  # [N, 3] m
    covariances: Floats32  # [N, 6] m²
    normals: Floats32  # [N, 3] unit
    visibility: Floats32  # [N, 16]


class Template(NamedTuple):
    """The template relative to a Gaussian's greatest weight: its floor, and what some joints have above."""

    floors: Floats32  # [N]
    gaussians: NDArray[np.intp]  # [L] ascending
    joints: NDArray[np.intp]  # [L]
    logs: Floats32  # [L] of the weight less the floor


@dataclass(frozen=True, eq=False)
class RestPose:
    """What of an avatar does not depend on the pose.

    Attributes:
        neighbours: [N, K] nodes between which a Gaussian is interpolated.
        neighbour_weights: [N, K].
        log_template: [N, J] log of the template's skinning weights, up to a constant for each Gaussian.
        points: [N, 3] m, x_c.
        factors: [N, 9] m, R S row by row.
        normals: [N, 3] unit.
        limbs: [N, 7] the limb's axis (unit), the lever from it to the point (m, times the share), and the
            share of a limb (0…1).
        max_offset: m. floor: m², added to variances. fallback: share of A_R in a normal.
    """

    neighbours: NDArray[np.int32]
    neighbour_weights: Floats32
    log_template: Floats32
    points: Floats32
    factors: Floats32
    normals: Floats32
    limbs: Floats32
    max_offset: float
    floor: float
    fallback: float

    def pose(self, logits: ArrayLike | None, offsets: ArrayLike, visibility: ArrayLike, bones: ArrayLike) -> Posed:
        """Pose all Gaussians.

        Args:
            logits: [M, J] Δ logits at the nodes; None where skinning is the template's.
            offsets: [M, 6] Δx and Δr before tanh.
            visibility: [M, S] harmonics, S ≤ 16; what is missing is 0.
            bones: [J, 3, 4] m, rest pose → posed.
        """
        nodes = self.nodes(logits, offsets, visibility)
        posed: Posed = pose(self.arrays, nodes, floats(bones), self.limits, len(self.points))
        return posed

    def node_fields(
        self, logits: ArrayLike | None, offsets: ArrayLike, visibility: ArrayLike, bones: ArrayLike
    ) -> Floats32:
        """What is interpolated between the nodes, [M, 48 + C].

        Σ_j e^(Δ_j − c) B_j row by row [12], the same without B, c and two zeros; offsets [6] and zeros up to 16;
        visibility [16]; Δ logits with zeros up to C, a whole number of 16.
        """
        fields: Floats32 = _node_fields(*self.nodes(logits, offsets, visibility), _bone_rows(floats(bones)))
        return fields

    def nodes(
        self, logits: ArrayLike | None, offsets: ArrayLike, visibility: ArrayLike
    ) -> tuple[Floats32, Floats32, Floats32]:
        """The networks' outputs as the kernels want them: Δ logits [M, J], which may be None, offsets, visibility."""
        offsets = floats(offsets)
        changes = np.zeros((len(offsets), self.log_template.shape[1])) if logits is None else logits
        return floats(changes), offsets, floats(visibility)

    @cached_property
    def limits(self) -> tuple[np.float32, np.float32, np.float32]:
        """Of offsets, of variances, and a normal's share of A_R."""
        return np.float32(self.max_offset), np.float32(self.floor), np.float32(self.fallback)

    @cached_property
    def template(self) -> Template:
        """The template as it is summed."""
        given = np.asarray(self.log_template, np.float32)
        least = np.where(given > -np.inf, given, np.float32(np.inf)).min(1)
        gaussians, joints = np.nonzero(~(given <= least[:, None]))  # what is no number stays none
        heights = given[gaussians, joints].astype(np.float64) - least[gaussians]
        top = np.zeros(len(given))
        with np.errstate(invalid="ignore"):
            np.maximum.at(top, gaussians, heights)
            logs = heights + np.log(-np.expm1(-heights)) - top[gaussians]
        floors = np.exp(-np.minimum(top, _DEEPEST))
        return Template(floors.astype(np.float32), gaussians, joints, logs.astype(np.float32))

    @cached_property
    def arrays(self) -> RestArrays:
        """As the kernel wants them."""
        count = len(self.points)
        whole = -(-count // WIDTH) * WIDTH
        own = np.zeros((whole, _OWN), np.float32)
        floors = self.template.floors
        for first, values in (
            (_POINTS, self.points),
            (_FACTORS, self.factors),
            (_NORMALS, self.normals),
            (_LIMBS, self.limbs),
            (_FLOOR, floors[:, None]),
        ):
            own[:count, first : first + values.shape[1]] = values
        neighbours = np.zeros((whole, self.neighbours.shape[1]), np.int32)
        weights = np.zeros(neighbours.shape, np.float32)
        neighbours[:count], weights[:count] = self.neighbours, self.neighbour_weights
        by_sixteens = own.reshape(-1, WIDTH, _OWN).transpose(0, 2, 1)
        return RestArrays(neighbours, weights, *_slots(self.template, whole), by_sixteens.ravel())


def _slots(template: Template, whole: int) -> tuple[NDArray[np.int32], NDArray[np.int32], Floats32]:
    """``starts``, ``joints`` and ``logs`` of ``RestArrays``."""
    _, gaussians, joints, logs = template
    counts = np.bincount(gaussians, minlength=whole)
    starts = np.concatenate([[0], np.cumsum(counts.reshape(-1, WIDTH).max(1))])
    slots = starts[gaussians // WIDTH] + np.arange(len(joints)) - (np.cumsum(counts) - counts)[gaussians]
    of_slots = np.zeros((starts[-1], WIDTH), np.int32)
    logs_of_slots = np.full(of_slots.shape, NEVER, np.float32)
    of_slots[slots, gaussians % WIDTH], logs_of_slots[slots, gaussians % WIDTH] = joints, logs
    return starts.astype(np.int32), of_slots.ravel(), logs_of_slots.ravel()


class RestArrays(NamedTuple):
    """Constants of a ``RestPose`` in the order in which they are read; N is a whole number of registers of 16.

    A frame reads them all, and caches that others share do not keep them: every number less and every stream less of
    them counts. Sixteen Gaussians have as many slots for joints each, since processors could not predict a number of
    its own for each; 2.5 of 24 joints in the mean.
    """

    neighbours: NDArray[np.int32]  # [N, K]
    weights: Floats32  # [N, K]
    starts: NDArray[np.int32]  # [N/16 + 1]: the slots of the sixteen i are starts[i] : starts[i + 1]
    joints: NDArray[np.int32]  # [S · 16], one of each Gaussian's joints a slot: as many as the one with most has
    logs: Floats32  # [S · 16] of the template's weights less its floor, relative to the greatest
    own: Floats32  # [N/16 · 23 · 16] points, factors, normals, limbs, floors by component, sixteen by sixteen


class Unposed(NamedTuple):
    """N Gaussians before they are posed: arguments of ``RestPose.pose`` for M nodes, and their material."""

    rest: RestPose
    logits: Floats32 | None  # [M, J]
    offsets: Floats32  # [M, 6]
    visibility: Floats32  # [M, S]
    bones: Floats32  # [J, 3, 4] m, rest pose → posed
    opacities: Floats32  # [N]
    albedo: Floats32  # [N, 3]
    roughness: Floats32  # [N]

    @property
    def root_rotation(self) -> Floats32:
        """[3, 3], root frame → that of the bones."""
        return self.bones[0, :, :3]


@njit(inline="always")
def _exp(x):  # type: ignore[no-untyped-def]
    """What is no number stays none: here and in ``_tanh`` comparisons fall to the bound only where they hold."""
    power = x * _LOG2_E
    return exp2(select(power < _SMALLEST_POWER, _SMALLEST_POWER, power))


@njit(inline="always")
def _tanh(x):  # type: ignore[no-untyped-def]
    """To 1e-7, absolute."""
    x = select(x > _LARGEST_TANH, _LARGEST_TANH, x)
    x = select(x < -_LARGEST_TANH, -_LARGEST_TANH, x)
    return lanes(_ONE) - lanes(_TWO) / (_exp(x * _TWO) + _ONE)


@njit(error_model="numpy", nogil=True, cache=True)
def pose(rest, nodes, bones, limits, count):  # type: ignore[no-untyped-def]
    """The ``count`` Gaussians of ``rest`` ``Posed``; arguments as ``RestPose`` makes them."""
    logits, offsets, visibility = nodes
    rows = _bone_rows(bones)
    fields = _node_fields(logits, offsets, visibility, rows)
    whole = len(rest.neighbours)
    means, covariances = np.empty((whole, 3), np.float32), np.empty((whole, 6), np.float32)
    normals, harmonics = np.empty((whole, 3), np.float32), np.empty((whole, _HARMONICS), np.float32)
    _pose(fields, rest, rows, limits, Posed(means, covariances, normals, harmonics))
    return Posed(means[:count], covariances[:count], normals[:count], harmonics[:count])


@njit(error_model="numpy", nogil=True, cache=True)
def _bone_rows(bones):  # type: ignore[no-untyped-def]
    """[J, 16]: of each joint B row by row, a one and zeros."""
    rows = np.zeros((len(bones), WIDTH), np.float32)
    for j in range(len(bones)):
        for k in range(_SUM):
            rows[j, k] = bones[j, k // 4, k % 4]
        rows[j, _SUM] = _ONE
    return rows


@njit(parallel=True, nogil=True, cache=True, error_model="numpy")
def _node_fields(logits, offsets, visibility, bones):  # type: ignore[no-untyped-def]
    """[M, 48 + J up to a whole number of 16]: of every node what is interpolated."""
    joints = len(bones)
    columns = _CHANGES + (joints + WIDTH - 1) // WIDTH * WIDTH
    fields = np.zeros((len(offsets), columns), np.float32)
    for m in prange(len(offsets)):
        greatest = logits[m, 0]
        for j in range(joints):
            fields[m, _CHANGES + j] = logits[m, j]
            greatest = max(greatest, logits[m, j])
        blend = lanes(_ZERO)
        for j in range(joints):
            blend += _exp(lanes(logits[m, j] - greatest)) * load(bones, j * WIDTH)
        store(fields, m * columns, blend)
        fields[m, _GREATEST] = greatest
        for k in range(offsets.shape[1]):
            fields[m, _OFFSETS + k] = offsets[m, k]
        for k in range(visibility.shape[1]):
            fields[m, _VISIBILITY + k] = visibility[m, k]
    return fields


@njit(error_model="numpy")
def _interpolate_sixteen(first, fields, rest, blends, offsets, visibility, changes):  # type: ignore[no-untyped-def]
    """Fields of sixteen Gaussians a row each: sixteen columns of ``blends``, ``offsets`` and ``visibility`` (of which
    theirs is filled), and Δ logits less the nodes' greatest in ``changes``."""
    width, changing = fields.shape[1], len(changes) // WIDTH
    for lane in range(WIDTH):
        i = first + lane
        blend, offset, seen = lanes(_ZERO), lanes(_ZERO), lanes(_ZERO)
        for k in range(rest.neighbours.shape[1]):
            at, weight = rest.neighbours[i, k] * width, rest.weights[i, k]
            blend += weight * load(fields, at)
            offset += weight * load(fields, at + _OFFSETS)
            seen += weight * load(fields, at + _VISIBILITY)
        store(blends, lane * WIDTH, blend)
        store(offsets, lane * WIDTH, offset)
        store(visibility, i * WIDTH, seen)
        for column in range(0, changing, WIDTH):
            change = lanes(_ZERO) - spread(blends, lane * WIDTH + _GREATEST)
            for k in range(rest.neighbours.shape[1]):
                at = rest.neighbours[i, k] * width + _CHANGES + column
                change += rest.weights[i, k] * load(fields, at)
            store(changes, lane * changing + column, change)


@njit(error_model="numpy")
def _blend_sixteen(first, rest, bones, rows, changes, shares, blend):  # type: ignore[no-untyped-def]
    """A [3, 4] by component of sixteen Gaussians, from what is interpolated for them in ``rows`` and ``changes``.

    NaN where a logit is NaN or +∞, as a softmax is: the node's sums are. ``shares`` [slots, lanes] is working memory.
    """
    width = len(changes) // WIDTH
    start, end = WIDTH * rest.starts[first // WIDTH], WIDTH * rest.starts[first // WIDTH + 1]
    for at in range(start, end, WIDTH):
        for lane in range(WIDTH):
            shares[at - start + lane] = changes[lane * width + rest.joints[at + lane]]
        logs = load(rest.logs, at)
        weights = _exp(load(shares, at - start) + logs)
        store(shares, at - start, select(logs < _HALF * NEVER, _ZERO, weights))
    for lane in range(WIDTH):
        row = rest.own[first * _OWN + _FLOOR * WIDTH + lane] * load(rows, lane * WIDTH)
        for at in range(start + lane, end, WIDTH):
            row += shares[at - start] * load(bones, rest.joints[at] * WIDTH)
        store(rows, lane * WIDTH, row)
    transpose(rows, blend)
    scale = _ONE / load(blend, _SUM * WIDTH)
    for at in range(0, _SUM * WIDTH, WIDTH):
        store(blend, at, load(blend, at) * scale)


@njit
def _row(x, y, z, b):  # type: ignore[no-untyped-def]
    """(x, y, z) B."""
    return x * b[0] + y * b[3] + z * b[6], x * b[1] + y * b[4] + z * b[7], x * b[2] + y * b[5] + z * b[8]


@njit
def _apply(a, x, y, z):  # type: ignore[no-untyped-def]
    """A (x, y, z)."""
    return a[0] * x + a[1] * y + a[2] * z, a[3] * x + a[4] * y + a[5] * z, a[6] * x + a[7] * y + a[8] * z


@njit
def _cofactors(a):  # type: ignore[no-untyped-def]
    """det(A) A⁻ᵀ, finite whatever A is."""
    return (
        a[4] * a[8] - a[5] * a[7],
        a[5] * a[6] - a[3] * a[8],
        a[3] * a[7] - a[4] * a[6],
        a[7] * a[2] - a[8] * a[1],
        a[8] * a[0] - a[6] * a[2],
        a[6] * a[1] - a[7] * a[0],
        a[1] * a[5] - a[2] * a[4],
        a[2] * a[3] - a[0] * a[5],
        a[0] * a[4] - a[1] * a[3],
    )


@njit
def _turned(x, y, z, f):  # type: ignore[no-untyped-def]
    """R(x, y, z) F with F row by row; R of the quaternion normalize(1, v/2)."""
    x, y, z = _HALF * x, _HALF * y, _HALF * z
    scale = _TWO / (_ONE + x * x + y * y + z * z)
    first = _row(_ONE - scale * (y * y + z * z), scale * (x * y - z), scale * (x * z + y), f)
    second = _row(scale * (x * y + z), _ONE - scale * (x * x + z * z), scale * (y * z - x), f)
    third = _row(scale * (x * z - y), scale * (y * z + x), _ONE - scale * (x * x + y * y), f)
    return first + second + third


@njit
def _widening(a, cofactors, axis, share):  # type: ignore[no-untyped-def]
    """κ of a blend A about a limb's axis."""
    x, y, z = _apply(a, axis[0], axis[1], axis[2])
    length_squared = x * x + y * y + z * z
    length_squared = select(length_squared > SMALLEST_SQUARE, length_squared, SMALLEST_SQUARE)
    x, y, z = _apply(cofactors, axis[0], axis[1], axis[2])
    kept = root(x * x + y * y + z * z) / length_squared
    kept = select(kept > _ONE, _ONE, kept)
    factor = lanes(_ONE)
    for _ in range(TWIST_STEPS):
        step = _HALF * (_THREE - kept)
        factor, kept = factor * step, kept * step * step
    return share * (factor - _ONE)


@njit
def _three(array, first, i, stride):  # type: ignore[no-untyped-def]
    """Components ``first`` … ``first + 2`` of sixteen Gaussians, which begin at ``i`` and lie ``stride`` apart."""
    at = first * stride + i
    return load(array, at), load(array, at + stride), load(array, at + 2 * stride)


@njit
def _pose_sixteen(i, blend, offset, rest, limits, out):  # type: ignore[no-untyped-def]
    """Means, covariances and normals of Gaussians i … i + 15, twelve rows of sixteen in ``out``.

    ``blend`` has their A and ``offset`` their bounded offsets and turns, both by component.
    """
    max_offset, floor, fallback = limits
    at, stride = i * _OWN, WIDTH
    first, second, third = (_three(blend, 0, 0, WIDTH), _three(blend, 4, 0, WIDTH), _three(blend, 8, 0, WIDTH))
    a = first + second + third
    cofactors = _cofactors(a)
    axis, lever = _three(rest.own, _LIMBS, at, stride), _three(rest.own, _LIMBS + 3, at, stride)
    kappa = _widening(a, cofactors, axis, load(rest.own, (_LIMBS + 6) * stride + at))

    point, moved = _three(rest.own, _POINTS, at, stride), _three(offset, 0, 0, WIDTH)
    x = point[0] + max_offset * moved[0] + kappa * lever[0]
    y = point[1] + max_offset * moved[1] + kappa * lever[1]
    z = point[2] + max_offset * moved[2] + kappa * lever[2]
    x, y, z = _apply(a, x, y, z)
    store(out, 0, x + load(blend, 3 * WIDTH))
    store(out, WIDTH, y + load(blend, 7 * WIDTH))
    store(out, 2 * WIDTH, z + load(blend, 11 * WIDTH))

    f = (
        _three(rest.own, _FACTORS, at, stride)
        + _three(rest.own, _FACTORS + 3, at, stride)
        + _three(rest.own, _FACTORS + 6, at, stride)
    )
    turn = _three(offset, 3, 0, WIDTH)
    f = _turned(turn[0], turn[1], turn[2], f)
    wide = _ONE + kappa
    x, y, z = _row(kappa * axis[0], kappa * axis[1], kappa * axis[2], f)
    f = (
        wide * f[0] - axis[0] * x,
        wide * f[1] - axis[0] * y,
        wide * f[2] - axis[0] * z,
        wide * f[3] - axis[1] * x,
        wide * f[4] - axis[1] * y,
        wide * f[5] - axis[1] * z,
        wide * f[6] - axis[2] * x,
        wide * f[7] - axis[2] * y,
        wide * f[8] - axis[2] * z,
    )
    f0, f1, f2 = _row(a[0], a[1], a[2], f)
    f3, f4, f5 = _row(a[3], a[4], a[5], f)
    f6, f7, f8 = _row(a[6], a[7], a[8], f)
    store(out, 3 * WIDTH, f0 * f0 + f1 * f1 + f2 * f2 + floor)
    store(out, 4 * WIDTH, f0 * f3 + f1 * f4 + f2 * f5)
    store(out, 5 * WIDTH, f0 * f6 + f1 * f7 + f2 * f8)
    store(out, 6 * WIDTH, f3 * f3 + f4 * f4 + f5 * f5 + floor)
    store(out, 7 * WIDTH, f3 * f6 + f4 * f7 + f5 * f8)
    store(out, 8 * WIDTH, f6 * f6 + f7 * f7 + f8 * f8 + floor)

    normal = _three(rest.own, _NORMALS, at, stride)
    along = kappa * (axis[0] * normal[0] + axis[1] * normal[1] + axis[2] * normal[2])
    nx, ny, nz = normal[0] + axis[0] * along, normal[1] + axis[1] * along, normal[2] + axis[2] * along
    x, y, z = _apply(cofactors, nx, ny, nz)
    u, v, w = _apply(a, nx, ny, nz)
    x, y, z = x + fallback * u, y + fallback * v, z + fallback * w
    length = root(x * x + y * y + z * z)
    scale = _ONE / select(length > _SHORTEST, length, _SHORTEST)
    store(out, 9 * WIDTH, x * scale)
    store(out, 10 * WIDTH, y * scale)
    store(out, 11 * WIDTH, z * scale)


@njit(inline="always")
def _fetch_sixteen(first, rest, posed):  # type: ignore[no-untyped-def]
    """Has what a later sixteen reads and writes brought to the caches: a seventh of the time."""
    neighbours = rest.neighbours.shape[1]
    for line in range(0, _OWN * WIDTH, WIDTH):
        prefetch(rest.own, first * _OWN + line)
    for line in range(0, neighbours * WIDTH, WIDTH):
        prefetch(rest.neighbours, first * neighbours + line)
        prefetch(rest.weights, first * neighbours + line)
    for values in posed:
        for line in range(0, values.shape[1] * WIDTH, WIDTH):
            prefetch_to_write(values, first * values.shape[1] + line)


@njit(parallel=True, nogil=True, cache=True, error_model="numpy")
def _pose(fields, rest, bones, limits, posed):  # type: ignore[no-untyped-def]
    """All Gaussians, whose arrays are as long as a whole number of registers."""
    count = len(rest.neighbours)
    means, covariances, normals = posed.means, posed.covariances, posed.normals
    for chunk in prange((count + _CHUNK - 1) // _CHUNK):
        shares, rows = aligned_floats(len(bones) * WIDTH), aligned_floats(WIDTH * WIDTH)
        changes = aligned_floats((fields.shape[1] - _CHANGES) * WIDTH)
        blend, offset = aligned_floats(WIDTH * WIDTH), aligned_floats(WIDTH * WIDTH)
        out = aligned_floats(WIDTH * WIDTH)
        for first in range(chunk * _CHUNK, min((chunk + 1) * _CHUNK, count), WIDTH):
            _fetch_sixteen(first + WIDTH, rest, posed)
            _interpolate_sixteen(first, fields, rest, rows, out, posed.visibility, changes)
            transpose(out, offset)
            _blend_sixteen(first, rest, bones, rows, changes, shares, blend)
            for c in range(6):
                store(offset, c * WIDTH, _tanh(load(offset, c * WIDTH)))
            _pose_sixteen(first, blend, offset, rest, limits, out)
            transpose(out, rows)
            for i in range(first, first + WIDTH):
                at = (i - first) * WIDTH
                for c in range(3):
                    means[i, c], normals[i, c] = rows[at + c], rows[at + 9 + c]
                for c in range(6):
                    covariances[i, c] = rows[at + 3 + c]
