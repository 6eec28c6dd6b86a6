"""The variants of the studies: the paper's ablations, causes that limit quality, numbers of steps."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from rnd_runtime.core.errors import InputError
from rnd_trainer.config import TrainConfig, nodes_for

POSE_SECONDS = 0.3 / 9  # between two poses of a window, for every d


@dataclass(frozen=True)
class StudyRow:
    """A variant.

    Attributes:
        what: what is switched.
        beside: the variant it is compared with.
        model, train: fields of the configuration that differ from ours.
        noisy: train on the capture's ``motion_noisy.npz``, score with the exact poses.
        length: factor on the number of steps.
    """

    name: str
    what: str
    beside: str | None
    model: dict[str, Any] = dataclasses.field(default_factory=dict)
    train: dict[str, Any] = dataclasses.field(default_factory=dict)
    noisy: bool = False
    length: float = 1.0


def _window(d: int) -> StudyRow:
    model = {"window_poses": d, "window_seconds": (d - 1) * POSE_SECONDS}
    return StudyRow(f"d = {d}", f"a window of {d} poses instead of 10", "ours", model)


_NO_GC = {"weight_consistency": 0.0}
VARIANTS = (
    StudyRow("ours", "everything, L_gc too", "+ D_W"),
    StudyRow(
        "LBS, plain colour",
        "plain colours on linear blend skinning, the same under every light",
        "ours",
        {"dynamic_skinning": False},
        {"light": "none", **_NO_GC},
    ),
    StudyRow("static skinning", "the template's weights, no L_gc", "ours", {"dynamic_skinning": False}, _NO_GC),
    StudyRow("+ D_W", "dynamic skinning, no L_gc", "static skinning", {}, _NO_GC),
    StudyRow(
        "+ unseen poses",
        "the third stage: edge lengths",
        "ours",
        {},
        {"unseen_fraction": TrainConfig().unseen_fraction},
    ),
    StudyRow("spatial only", "no temporal attention", "ours", {"motion_encoder": "spatial"}),
    *(_window(d) for d in (2, 5, 20, 30)),
    StudyRow("grey light", "a probe of one channel, as printed", "ours", {}, {"probe_channels": 1}),
    StudyRow("light from white", "no search for sky and suns", "ours", {}, {"light_search": False}),
    StudyRow("paper's visibility", "of the direction to the camera", "ours", {"visibility": "paper"}),
    StudyRow("no visibility", "no shadows", "ours", {"visibility": "none"}),
    StudyRow("mesh normals", "the template's normals for shading", "ours", {"learned_normals": False}),
)


def _gaussians(count: int) -> StudyRow:
    model = {"gaussians": count, "nodes": nodes_for(count)}
    return StudyRow(f"N = {count}", f"{count} Gaussians", "ours", model)


CAUSES = (
    StudyRow("ours", "everything learned, exact poses", None),
    StudyRow("true light", "the capture's own light map", "ours", {}, {"light": "capture"}),
    StudyRow("true normals", "exact normals instead of estimated ones", "ours", {}, {"normals": "true"}),
    StudyRow("noisy poses", "the capture's noisy poses", "ours", {}, {}, noisy=True),
    StudyRow("noisy poses, refined", "and corrected", "noisy poses", {}, {"refine_poses": True}, noisy=True),
    *(_gaussians(count) for count in (7_500, 15_000, 60_000, 120_000)),
)
LENGTHS = (
    StudyRow("ours", "the steps of the preset", None),
    *(
        StudyRow(name, f"{name} times the steps", "ours", length=length)
        for name, length in (("1/8", 1 / 8), ("1/4", 1 / 4), ("1/2", 1 / 2), ("5", 5.0))
    ),
)


def chosen(variants: Sequence[StudyRow], names: Sequence[str]) -> tuple[StudyRow, ...]:
    """The variants of ``names`` in the study's order, by default all; unknown names are refused."""
    known = [variant.name for variant in variants]
    unknown = [name for name in names if name not in known]
    if unknown:
        raise InputError("--variants", expected="some of " + ", ".join(known), got=", ".join(unknown))
    return tuple(variant for variant in variants if not names or variant.name in names)
