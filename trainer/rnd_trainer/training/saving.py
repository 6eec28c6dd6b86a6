"""Saving and resuming a training, and the provenance of what it learned."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numba
import torch
from torch import Tensor

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import sha256_of
from rnd_runtime.motion.motion import save_motion
from rnd_runtime.playback.doctor import machine
from rnd_trainer.config import to_dict
from rnd_trainer.losses.perceptual import networks_by_role, networks_sha256
from rnd_trainer.model.checkpoint import save_checkpoint, write_tensors

from .state import STATE_FILE, STATE_SCHEMA, read_state
from .training import Training
from .unseen import UnseenPoses

REFINED_MOTION = "refined_motion.npz"
"""in a run's folder: the capture's motion with corrected training frames"""


def save_training(training: Training, folder: Path) -> None:
    """Write the state, the checkpoint, and the refined motion if there is one."""
    model, probes = training.model, training.lights.probes
    parts: dict[str, dict[str, Any]] = {"model": model.state_dict(), "probes": probes.state_dict()}
    if training.refinement is not None:
        parts["poses"] = training.refinement.state_dict()
    if training.unseen is not None:
        parts["teacher"] = training.unseen.teacher.state_dict()
    for name, optimizer in training.optimizers.items():
        for index, values in optimizer.state_dict()["state"].items():
            parts[f"{name}.{index}"] = values
    tensors = {
        f"{part}.{name}": torch.as_tensor(value).cpu().contiguous()
        for part, values in parts.items()
        for name, value in values.items()
    }
    tensors["generator"] = training.generator.get_state()
    capture, config = training.capture, training.config
    header = {
        "schema": STATE_SCHEMA,
        "config": to_dict(config),
        "step": training.step_index,
        "seconds": training.seconds,
        "bad_steps": training.bad_steps,
        "lit": training.lit,
        "networks": networks_by_role(training.perceptual, training.consistency),
        "capture_sha256": sha256_of(capture.file),
        "motion": Path(capture.motion.source).name,
        "learned_from_sha256": training.learned_from_sha256,
    }
    write_tensors(folder / STATE_FILE, tensors, header)
    checkpoint = folder / "avatar.ckpt"
    lights, skeleton = training.lights.by_name(), capture.body.skeleton
    save_checkpoint(checkpoint, model, lights, skeleton, config, provenance(training))
    if training.refinement is not None:
        save_motion(folder / REFINED_MOTION, training.motion())


def resume_training(training: Training, path: Path) -> None:
    """Continue ``training`` from a saved state on the same curve.

    Raises:
        InputError: another configuration, capture or network, or not a state. Settings of the third stage may
            differ before it begins.
    """
    saved = read_state(path)
    saved.refuse_other(training.config, networks_by_role(training.perceptual, training.consistency))
    header, teacher = saved.header, saved.part("teacher")
    if header.get("learned_from_sha256") != training.learned_from_sha256:
        raise InputError("--resume", expected="the images and poses it was started with", got="others", file=path)
    try:
        training.model.load_state_dict(saved.part("model"))
        training.lights.probes.load_state_dict(saved.part("probes"))
        if training.refinement is not None:
            training.refinement.load_state_dict(saved.part("poses"))
        if teacher:
            training.unseen = UnseenPoses(training.model, training.capture.body.skeleton, training.config)
            training.unseen.teacher.load_state_dict(teacher)
        for name, optimizer in training.optimizers.items():
            states: dict[int, dict[str, Tensor]] = {}
            for key, value in saved.part(name).items():
                index, what = key.split(".")
                states.setdefault(int(index), {})[what] = value
            optimizer.load_state_dict({**optimizer.state_dict(), "state": states})
        training.generator.set_state(saved.tensors["generator"])
        training.step_index, training.seconds = int(header["step"]), float(header["seconds"])
        training.bad_steps = int(header["bad_steps"])
        training.lit = bool(header["lit"])
    except (KeyError, RuntimeError, ValueError, TypeError) as error:
        raise InputError("not a training state", got=str(error).splitlines()[0], file=path) from error


def provenance(training: Training) -> dict[str, Any]:
    """Where the checkpoint comes from: data, lights, networks, steps, time and machine."""
    capture, device = training.capture, training.device
    lights = {view.frame.light for view in training.views if view.frame.light}
    return {
        "capture": capture.folder.resolve().name,
        "capture_sha256": sha256_of(capture.file),
        "motion": Path(capture.motion.source).name,
        "lights": {name: capture.light_sha256(name) for name in training.lights.names if name in lights},
        "body_license": capture.body.license,
        "step": training.step_index,
        "steps_planned": training.schedule.total,
        "lit": training.lit,
        "minutes": round(training.seconds / 60, 3),
        "threads": numba.get_num_threads(),
        "machine": machine(),
        "device": "cpu" if device.type == "cpu" else torch.cuda.get_device_name(device),
        "images": len(training.views),
        "spacing_m": float(training.model.spacing),
        "perceptual": None if training.perceptual is None else training.perceptual.backbone,
        "perceptual_sha256": networks_sha256(training.perceptual),
        "consistency": None if training.consistency is None else training.consistency.backbone,
        "consistency_sha256": networks_sha256(training.consistency),
    }
