"""Avatars to measure: a trained one, or a seeded, untrained one of any size at the same cost.

A seeded avatar has random networks with outputs scaled as in trained ones, and an albedo by formula. Its errors by
shading and rasteriser equal a trained avatar's; by encoder they are less (static: 1 mm, the trained dancer 17 mm).
"""

from __future__ import annotations

import dataclasses
import hashlib
import importlib.util
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rnd_runtime import __version__
from rnd_runtime.capture.body import Body
from rnd_runtime.core.errors import InputError
from rnd_trainer.config import TrainConfig, resized

SEED = 7
# output layers of the networks, as multiples of their initialisation
LOGITS, OFFSETS, VISIBILITY = 4.0, 0.6, 1.2
OPACITY = 2.5  # raw: 0.99 after the sigmoid, as of trained avatars
STORED = ("seeded_*.ckpt", "exported_*.onnx", "reference_*.npz", "squat_*.npz", "sun_*.exr")
"""files stored between runs; each name contains the ``content_key`` of its inputs"""


@dataclass(frozen=True)
class Encoders:
    """Options of ``rnd-export``."""

    encoder: str = "full"
    precision: str = "f32"
    window: int | None = None

    def words(self) -> list[str]:
        words = ["--encoder", self.encoder, "--precision", self.precision]
        return words + (["--window-poses", str(self.window)] if self.window is not None else [])


def content_key(*parts: Path | str) -> str:
    """Digest of files' contents, of strings, their order and the package's version: 16 hexadecimal digits."""
    digest = hashlib.sha256(__version__.encode())
    for part in parts:
        content = part.read_bytes() if isinstance(part, Path) else part.encode()
        digest.update(hashlib.sha256(content).digest())
    return digest.hexdigest()[:16]


def forget(folder: Path) -> None:
    """Delete the files stored in ``folder``, and no others."""
    for pattern in STORED:
        for file in folder.glob(pattern):
            file.unlink()


def exported(checkpoint: Path, encoders: Encoders, folder: Path) -> Path:
    """The avatar.onnx of ``checkpoint`` in ``folder``, by ``rnd-export`` unless it exists."""
    key = content_key(checkpoint, *sources("rnd_export"))
    words = encoders.words()
    name = "_".join(["exported", key, *(w for w in words if not w.startswith("--"))])
    out = folder / f"{name}.onnx"
    if not out.exists():
        code = "from rnd_export.cli import main; raise SystemExit(main())"
        line = [sys.executable, "-c", code, str(checkpoint), "--out", str(out), "--frames", "2", "--cull", "-1", *words]
        done = subprocess.run(line, capture_output=True, text=True, check=False)
        if done.returncode:
            raise InputError("rnd-export", got=(done.stderr.strip().splitlines() or ["failed"])[-1])
    return out


def checkpoint_model(checkpoint: Path) -> dict[str, Any]:
    """The fields of its ``ModelConfig``."""
    from rnd_trainer.model.checkpoint import SCHEMA, read_tensors

    model: dict[str, Any] = read_tensors(checkpoint, SCHEMA)[1]["config"]["model"]
    return model


def sources(package: str) -> list[Path]:
    """Source files of ``package``, found without importing it."""
    found = importlib.util.find_spec(package)
    folders = () if found is None else found.submodule_search_locations or ()
    return sorted(file for folder in folders for file in Path(folder).rglob("*.py"))


def seeded_checkpoint(count: int, body_file: Path, folder: Path) -> Path:
    """avatar.ckpt of a seeded avatar of ``count`` Gaussians on the body of ``body_file``, made once."""
    config = resized(TrainConfig(), count, None)
    out = folder / f"seeded_{count}_{content_key(body_file, repr(config.model))}.ckpt"
    if out.exists():
        return out
    import torch

    from rnd_trainer.model.checkpoint import UNKNOWN_LIGHT, save_checkpoint
    from rnd_trainer.model.model import AvatarModel
    from rnd_trainer.model.template import sample_template

    body = Body.load(body_file)
    torch.manual_seed(SEED)
    model = AvatarModel(config.model, sample_template(body, count, config.model.nodes, seed=SEED))
    with torch.no_grad():
        _activate(model)
        appearance = model.appearance_residual
        appearance[:, 3:6] = torch.from_numpy(_albedo(model.points.numpy()))
        model.geometry_residual[:, 0] = OPACITY
    light = torch.ones(32, 64, 3)
    info = {"body_license": body.license, "made": "rnd-bench, untrained"}
    save_checkpoint(out, model, {UNKNOWN_LIGHT: light}, body.skeleton, dataclasses.replace(config, seed=SEED), info)
    return out


def _activate(model: object) -> None:
    """Random output layers for the networks whose output is initially zero."""
    import torch

    frequencies = model.config.frequencies  # type: ignore[attr-defined]
    damping = torch.ones(3 + 6 * frequencies)
    for band in range(frequencies):
        for start in (3, 3 + 3 * frequencies):
            damping[start + 3 * band : start + 3 * band + 3] = 0.5**band
    for name, strength in (("skinning", LOGITS), ("offsets", OFFSETS), ("visibility", VISIBILITY)):
        network = getattr(model, name)
        network.position.hidden.weight.mul_(damping)
        last = network.logits if name == "skinning" else network.out
        last.weight.copy_(strength * torch.randn_like(last.weight) / last.weight.shape[1])


def _albedo(points: np.ndarray) -> np.ndarray:
    """Raw albedo [N, 3] before the sigmoid: a striped shirt, plain trousers, light skin."""
    height, side = points[:, 1:2], points[:, :1]
    stripes = np.tanh(8 * np.sin(70 * height))
    shirt = np.array([[0.9, -0.4, -0.9]]) + stripes * np.array([[0.3, 0.9, 0.8]])
    trousers = np.array([[-1.2, -0.8, 0.4]]) + 0.4 * np.sin(40 * side)
    skin = np.array([[1.8, 1.0, 0.5]]) + 0.2 * np.sin(90 * height) * np.sin(90 * side)
    covered = np.where(height > 0.95, shirt, trousers)
    bare = (height > 1.42) | (np.abs(side) > 0.45) | (height < 0.1)
    return np.where(bare, skin, covered).astype(np.float32)
