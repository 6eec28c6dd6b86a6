"""One small avatar for all rows, trained in seconds, and the table of what was measured."""

from __future__ import annotations

import pytest

from rnd_bench.stability.figures import amount
from support.stash import MEASURED

STEPS, GAUSSIANS, SIZE, FRAMES = 160, 1500, 64, 8


@pytest.fixture(scope="session")
def subject(tmp_path_factory):
    """An avatar of 1 500 Gaussians, trained on a filmed A-pose spin in sunlight."""
    import torch

    from rnd_bench.scenes.studio import write_studio
    from rnd_bench.scenes.subject import Subject
    from rnd_bench.stability.small import train_small
    from rnd_export.export import export
    from rnd_trainer.model.checkpoint import load_checkpoint
    from support.tiny import body

    work = tmp_path_factory.mktemp("stability")
    capture = write_studio(work / "capture", body(), size=SIZE, frames=FRAMES)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # the same avatar on every machine
    checkpoint = train_small(work / "run", capture, STEPS, GAUSSIANS)
    torch.set_num_threads(threads)
    avatar = work / "avatar.onnx"
    export(load_checkpoint(checkpoint), avatar)
    return Subject(avatar, checkpoint, capture, work, small=True, size=96)


def pytest_terminal_summary(terminalreporter, config):
    """Print what every row measured."""
    rows = config.stash.get(MEASURED, [])
    if rows:
        terminalreporter.section("stability: what was measured")
    for row, figure in rows:
        measured = amount(figure.measured, figure.unit)
        baseline = "" if figure.baseline is None else f"   ({figure.baseline_name}: {figure.baseline:.4g})"
        judged = "" if not figure.line else f" {figure.line} {'✓' if figure.passes else '✗'}"
        terminalreporter.line(f"{row:4} {figure.what}: {measured}{judged}{baseline}")
