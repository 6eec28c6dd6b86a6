"""Checkpoints in safetensors: tensors and a JSON header."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from rnd_runtime.capture.capture import Capture
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import atomic_path, existing_file, sha256_of
from rnd_runtime.core.kinds import explained
from rnd_runtime.motion.skeleton import Skeleton
from rnd_trainer.config import TrainConfig, from_dict, to_dict

from .model import AvatarModel
from .template import Template
from .twist import twist_frames

SCHEMA = "rnd-checkpoint/1"
UNKNOWN_LIGHT = "unknown"
"""name of the light of images without one"""
_KEY = "rnd_checkpoint"


@dataclass
class Checkpoint:
    """A trained avatar."""

    model: AvatarModel
    probes: dict[str, Tensor]  # [32, 64, 3] linear radiance of each training light, the default one first
    skeleton: Skeleton
    config: TrainConfig
    info: dict[str, Any]  # provenance, see ``Training.info``
    file: Path
    sha256: str  # of ``file``

    @property
    def probe(self) -> Tensor:
        """The default light [32, 64, 3], which an export embeds."""
        return next(iter(self.probes.values()))

    def probe_of(self, name: str | None) -> Tensor:
        """The training light called ``name`` [32, 64, 3], by default the default one."""
        return self.probes.get(name or UNKNOWN_LIGHT, self.probe)

    def learned_from(self, capture: Path) -> bool:
        """Whether the avatar was trained on this capture.json."""
        return bool(self.info.get("capture_sha256") == sha256_of(capture))

    def learned_under(self, capture: Capture) -> set[str | None]:
        """Names of the lights of ``capture`` that the avatar was trained under."""
        lights = self.info.get("lights", {})
        return {name for name, digest in lights.items() if capture.light_sha256(name) == digest}

    def note(self) -> str | None:
        """Note for the user if the training stopped before the second stage, else None."""
        if self.config.light == "none" or self.info.get("lit", True):
            return None
        stopped = f"step {self.info.get('step')} of {self.info.get('steps_planned')}"
        return f"{self.file}: stopped at {stopped}, before light and albedo were learned; rnd-train --resume goes on"


def save_checkpoint(
    path: Path,
    model: AvatarModel,
    probes: Mapping[str, Tensor],
    skeleton: Skeleton,
    config: TrainConfig,
    info: dict[str, Any],
) -> None:
    """Write ``avatar.ckpt`` atomically; ``probes`` [32, 64, 3] linear, the default one first, ``info`` of JSON values.

    The first is the tensor ``probe``, others are ``probe.1``, ``probe.2``, …
    """
    tensors = {f"model.{k}": v.detach().cpu().contiguous() for k, v in model.state_dict().items()}
    for index, probe in enumerate(probes.values()):
        tensors[_probe_tensor(index)] = probe.detach().cpu().contiguous()
    tensors["skeleton.rest_joints"] = torch.as_tensor(np.asarray(skeleton.rest_joints), dtype=torch.float64)
    header = {
        "schema": SCHEMA,
        "config": to_dict(config),
        "skeleton": {"names": list(skeleton.names), "parents": [int(p) for p in skeleton.parents]},
        "lights": list(probes),
        "info": info,
    }
    write_tensors(path, tensors, header)


def load_checkpoint(path: str | Path) -> Checkpoint:
    """Read ``avatar.ckpt``; raises ``InputError`` if it is not a complete checkpoint of this schema."""
    try:
        tensors, header = read_tensors(path, SCHEMA)
    except InputError as error:
        raise explained(error, path, "checkpoint") from error
    try:
        config = from_dict(header["config"])
        tree = header["skeleton"]
        skeleton = Skeleton(
            tuple(tree["names"]), np.array(tree["parents"]), tensors["skeleton.rest_joints"].numpy().astype(np.float64)
        )
        state = {k.removeprefix("model."): v for k, v in tensors.items() if k.startswith("model.")}
        model = rebuild_model(config, state, skeleton)
        info = header.get("info", {})
        names = header.get("lights") or [*info.get("lights", {}), UNKNOWN_LIGHT][:1]
        probes = {str(name): tensors[_probe_tensor(index)] for index, name in enumerate(names)}
    except (KeyError, TypeError, RuntimeError, IndexError, ValueError, AttributeError) as error:
        raise InputError("not an avatar checkpoint", got=str(error).splitlines()[0], file=path) from error
    if not all(bool(torch.isfinite(t).all()) for t in tensors.values() if t.is_floating_point()):
        raise InputError("checkpoint", expected="finite numbers", got="NaN or infinity", file=path)
    return Checkpoint(model, probes, skeleton, config, info, Path(path), sha256_of(path))


def _probe_tensor(index: int) -> str:
    return f"probe.{index}" if index else "probe"


def rebuild_model(config: TrainConfig, state: dict[str, Tensor], skeleton: Skeleton) -> AvatarModel:
    """Model of ``config`` with the tensors of ``state``, in evaluation mode."""
    neighbours = state["interpolate.neighbours"]
    if int(neighbours.min()) < 0 or int(neighbours.max()) >= config.model.nodes:
        raise ValueError("interpolation neighbours out of range")
    points, weights = state["points"].double().numpy(), state["log_weights"].double().exp().numpy()
    template = Template(
        points=points,
        normals=state["rest_normals"].numpy(),
        codes=state["codes"].numpy(),
        weights=weights,
        spacing=float(state["spacing"]),
        neighbours=neighbours.numpy(),
        neighbour_weights=state["interpolate.weights"].numpy(),
        limbs=twist_frames(points, weights, skeleton),
        nodes=config.model.nodes,
    )
    model = AvatarModel(config.model, template)
    model.load_state_dict(state)
    return model.eval()


def write_tensors(path: Path, tensors: dict[str, Tensor], header: dict[str, Any]) -> None:
    """Write a safetensors file with ``header`` as JSON, atomically."""
    with atomic_path(path) as temporary:
        try:
            save_file(tensors, temporary, metadata={_KEY: json.dumps(header, sort_keys=True)})
        except SafetensorError as error:  # e.g. of a full disk
            raise InputError("cannot be written", got=str(error).splitlines()[0], file=path) from error


def read_tensors(path: str | Path, schema: str) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors and JSON header of a safetensors file of ``schema``; raises ``InputError`` otherwise."""
    path = existing_file(path, what="checkpoint")
    try:
        with safe_open(path, framework="pt") as file:
            header = json.loads((file.metadata() or {}).get(_KEY, "null"))
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (no mapping)
    except (SafetensorError, json.JSONDecodeError, OSError, ValueError, RecursionError) as error:
        raise InputError("not a whole safetensors file", got=str(error).splitlines()[0], file=path) from error
    found = header.get("schema") if isinstance(header, dict) else None
    if found != schema:
        raise InputError("schema", expected=schema, got=found, file=path)
    return tensors, header
