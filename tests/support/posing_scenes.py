"""Random rest poses and what is posed of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rnd_runtime.posing.rest import RestPose


def template_logs(rng, count: int, joints: int, most: int):
    """As rnd-export writes them: up to ``most`` joints a Gaussian, the others at a floor of one in a million."""
    own = rng.permuted(np.tile(np.arange(joints) < most, (count, 1)), axis=1)
    return np.float32(np.where(own, rng.uniform(0, np.log(1e6), (count, joints)), 0.0))


def posing_scene(joints: int, *, count: int = 300, nodes: int = 40, harmonics: int = 16, most: int = 5):
    """Nodes agree on Δ logits, up to a constant each, which no softmax sees: nothing is lost in interpolating."""
    rng = np.random.default_rng(joints)
    weights = rng.uniform(0.1, 1, (count, 4))
    normals = rng.normal(size=(count, 3))
    rest = RestPose(
        rng.integers(0, nodes, (count, 4)).astype(np.int32),
        np.float32(weights / weights.sum(1, keepdims=True)),
        template_logs(rng, count, joints, most),
        np.float32(rng.normal(size=(count, 3))),
        np.float32(0.02 * rng.normal(size=(count, 9))),
        np.float32(normals / np.linalg.norm(normals, axis=1, keepdims=True)),
        np.float32(
            np.concatenate(
                [normals[::-1] / np.linalg.norm(normals[::-1], axis=1, keepdims=True), 0.1 * normals, weights[:, :1]], 1
            )
        ),
        max_offset=0.06,
        floor=1e-8,
        fallback=1e-3,
    )
    logits = np.float32(2 * rng.normal(size=joints) + rng.normal(size=(nodes, 1)))
    offsets = np.float32(2 * rng.normal(size=(nodes, 6)))
    visibility = np.float32(rng.normal(size=(nodes, harmonics)))
    bones = np.float32(np.eye(3, 4) + 0.3 * rng.normal(size=(joints, 3, 4)))
    return rest, (logits, offsets, visibility, bones)


BROKEN = [
    (field, value)
    for field in ("logits", "log_template", "offsets", "turns", "bones", "points")
    for value in (np.nan, np.inf, -np.inf)
]


def broken_scene(field, value):
    """A scene of 24 joints with one number of Gaussian 0's that is not finite."""
    rest, (logits, offsets, visibility, bones) = posing_scene(24)
    changed = {"log_template": rest.log_template.copy(), "points": rest.points.copy()}
    places = {
        "logits": (logits, (rest.neighbours[0, 0], 2)),
        "offsets": (offsets, (rest.neighbours[0, 0], 1)),
        "turns": (offsets, (rest.neighbours[0, 0], 4)),
        "bones": (bones, (3, 0, 0)),
        **{name: (array, (0, 2)) for name, array in changed.items()},
    }
    array, place = places[field]
    array[place] = value
    return replace(rest, **changed), (logits, offsets, visibility, bones)


def page_arrays(rest: RestPose) -> dict[str, np.ndarray]:
    """The arrays of ``rest`` by the names that the static page's code has for them."""
    return {
        "neighbours": rest.neighbours,
        "weights": rest.neighbour_weights,
        "template": rest.log_template,
        "points": rest.points,
        "factors": rest.factors,
        "normals": rest.normals,
        "limbs": rest.limbs,
        "limits": np.float32([rest.max_offset, rest.floor, rest.fallback]),
    }
