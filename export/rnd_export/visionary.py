"""``--target visionary``: one motion and one light baked into a clip for Visionary's WebGPU renderer."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

from rnd_export.reduce.variant import Variant
from rnd_runtime.avatar.file import read_metadata
from rnd_runtime.avatar.onnx_parts import OnnxFile
from rnd_runtime.core.files import atomic_path
from rnd_runtime.motion.motion import Motion
from rnd_runtime.shading.light import Up
from rnd_trainer.model.checkpoint import Checkpoint
from rnd_viewer.convert.cli import SplatOptions
from rnd_viewer.convert.convert import convert
from rnd_viewer.convert.visionary import check_clip

from .export import export

PART = "rnd-convert splats --format visionary --frames takes a part of it"


def export_visionary(
    checkpoint: Checkpoint,
    out: Path,
    motion: Motion,
    motion_file: Path,
    variant: Variant,
    hdr: Path | None = None,
    hdr_up: Up = "y",
) -> Iterator[str]:
    """Write what ``rnd-convert splats --format visionary`` makes of the exported avatar; yields notes for the user.

    Args:
        checkpoint: the avatar. out: the .onnx to write, in ``rnd_viewer.convert.visionary``'s contract.
        motion: what ``motion_file`` holds, on the avatar's skeleton; every frame of it becomes one of the clip.
        variant: what the avatar leaves out. hdr, hdr_up: the light, by default the learned one.

    Raises:
        InputError: for a light that cannot be used, or a clip that no WebGPU buffer holds.
    """
    with tempfile.TemporaryDirectory() as folder:
        avatar = Path(folder) / "avatar.onnx"
        export(checkpoint, avatar, motion, variant, cull=-1)
        gaussians = read_metadata(OnnxFile(avatar.read_bytes())).gaussians
        check_clip(motion.frame_count, gaussians, "frames of --motion", PART)
        inputs = {"avatar": avatar, "motion": motion_file, "hdr": hdr, "hdr_up": hdr_up}
        options = SplatOptions(out=Path(folder), format="visionary", frames=":", **inputs)  # type: ignore[arg-type]
        *notes, _ = convert(options)
        with atomic_path(out) as temporary:
            shutil.copyfile(Path(folder) / "visionary.onnx", temporary)
    yield from notes
    yield f"{out}: {motion.frame_count} frames, {out.stat().st_size / 1e6:.2f} MB"
