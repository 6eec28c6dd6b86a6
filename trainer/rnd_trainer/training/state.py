"""Saved state of a training: identity and tensors."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from rnd_runtime.capture.capture import Capture
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import sha256_of
from rnd_runtime.shading.light import Light
from rnd_trainer.config import TrainConfig, from_dict, to_dict
from rnd_trainer.model.checkpoint import read_tensors

from .data import TrainingView
from .lighting.lights import light_name

STATE_SCHEMA = "rnd-training/1"
STATE_FILE = "training.state"
"""in a run's folder"""
_THIRD_STAGE_FIELDS = {"unseen_fraction", "weight_edges", "weight_smooth"}


@dataclass(frozen=True)
class TrainingState:
    """State written by ``save_training``; the first word of a tensor's dotted name is its part."""

    path: Path
    tensors: dict[str, Tensor]
    header: dict[str, Any]

    def part(self, name: str) -> dict[str, Tensor]:
        """Tensors of one part by the rest of their names."""
        prefix = f"{name}."
        return {k.removeprefix(prefix): v for k, v in self.tensors.items() if k.startswith(prefix)}

    def refuse_other(
        self, config: TrainConfig, networks: dict[str, str | None], *, what: str = "--resume", hint: str | None = None
    ) -> None:
        """Refuse to resume with another configuration or other perceptual weights.

        Fields of the third stage may differ before it begins.

        Args:
            networks: as of ``losses.perceptual.networks_by_role``.
            what, hint: of the error.

        Raises:
            InputError: they differ.
        """
        try:
            before = to_dict(from_dict(self.header["config"]))
        except (KeyError, TypeError, InputError) as error:
            got = str(error)
            raise InputError("not a training state of this version", got=got, file=self.path) from error
        free = {"save_every", "preview_every"} | (set() if self.part("teacher") else _THIRD_STAGE_FIELDS)
        now = _flat(to_dict(config))
        wrong = sorted(name for name, value in _flat(before).items() if now[name] != value and name not in free)
        if wrong:
            expected = "the configuration it was started with"
            raise InputError(what, expected=expected, got=f"other {wrong}", file=self.path, hint=hint)
        begun, given = _describe(self.header["networks"]), _describe(networks)
        if begun != given:
            expected = f"the perceptual weights {begun}"
            raise InputError(what, expected=expected, got=given, file=self.path, hint=hint)


def _flat(config: dict[str, Any]) -> dict[str, Any]:
    """All fields in one level; names are unique."""
    return {**{name: value for name, value in config.items() if name != "model"}, **config["model"]}


def _describe(networks: dict[str, str | None]) -> str:
    return ", ".join(f"{digest} for {role}" for role, digest in sorted(networks.items()) if digest) or "none"


def read_state(path: Path) -> TrainingState:
    """Read the state in ``path``; raises ``InputError`` if it is not one."""
    return TrainingState(path, *read_tensors(path, STATE_SCHEMA))


def learned_sha256(views: list[TrainingView], capture: Capture, scale: float, lights: dict[str, Light]) -> str:
    """Digest of the training data: images, cameras, frames, poses, body, and given ``lights``.

    Equal on every CPU: computed values are rounded, and of images with ``scale`` ≠ 1 the files are hashed.
    """
    digest = hashlib.sha256()

    def add(*arrays: NDArray[Any] | None) -> None:
        for array in arrays:
            if array is not None:
                digest.update(np.ascontiguousarray(array).data)

    for view in views:
        frame = view.frame
        if scale == 1:
            add(np.array(frame.frame), view.image, view.mask, view.normal, view.albedo_estimate)
        else:
            add(np.array(frame.frame))
            files = (frame.image, frame.mask, frame.normal, frame.normal_gt, frame.albedo_estimate)
            for name in filter(None, files):
                digest.update(sha256_of(capture.folder / name).encode())
        add(_rounded(view.camera.K), _rounded(view.camera.world_to_camera))
    motion, body = capture.motion, capture.body
    add(_rounded(motion.rotations), _rounded(motion.translations), _rounded(motion.fps))
    add(_rounded(body.vertices), body.faces, _rounded(body.skinning_weights))
    add(_rounded(body.skeleton.rest_joints))
    names = [light_name(view.frame) for view in views]
    if len(set(names)) > 1:
        digest.update("\0".join(names).encode())
    for name, radiance in lights.items():
        digest.update(name.encode())
        add(radiance.radiance, _rounded(radiance.rotation))
    return digest.hexdigest()


def _rounded(values: ArrayLike) -> NDArray[np.float32]:
    """``values`` rounded to 1e-6 in float32, without −0."""
    return np.asarray(np.round(np.asarray(values, np.float64), 6) + 0.0, np.float32)
