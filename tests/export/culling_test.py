"""What a file advises its players to leave out, how that is found, and that they follow it."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import onnx
import pytest

from rnd_export.cli import main
from rnd_export.export import export
from rnd_export.parity import random_motion
from rnd_export.reduce.culling import COSINES, MAX_DIFFERENCE, SIZE, add_advice, find_cull
from rnd_export.reduce.views import views_around
from rnd_runtime.avatar.avatar import Avatar
from rnd_runtime.avatar.file import ADVICE_KEY, PlayerAdvice
from rnd_runtime.core.camera import Camera
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.kernels import COMPILING
from rnd_runtime.motion.motion import load_motion
from rnd_runtime.playback.aov import CHANNELS, GIVEN
from rnd_runtime.playback.frame import FrameRenderer
from rnd_runtime.shading.light import Light
from rnd_trainer.model.checkpoint import load_checkpoint
from support.paths import ASSETS

CULL = -0.3


@pytest.fixture(scope="module")
def advised(tmp_path_factory) -> Path:
    """The embedded avatar, whose file is of before there was advice, with some."""
    file = tmp_path_factory.mktemp("advised") / "avatar.onnx"
    return _with(file, lambda model: add_advice(model, CULL))


def _with(file: Path, change) -> Path:
    model = onnx.load(ASSETS / "avatar.onnx")
    change(model)
    onnx.save_model(model, str(file))
    return file


class _SeenThrough(Avatar):
    """Its Gaussians let through most of what is behind them."""

    def __init__(self, networks):
        super().__init__(networks)
        self._opacities = np.float32(0.2) * self._opacities


@pytest.mark.slow
def test_the_most_is_left_out_that_does_not_show() -> None:
    avatar = Avatar.load(ASSETS / "avatar.onnx")
    motion = random_motion(avatar.skeleton, frames=30, seed=1)
    found = find_cull(avatar, motion)
    assert found in COSINES[1:-1]
    light = Light(avatar.trained_light)
    around = views_around(motion, (SIZE, SIZE), lambda time: avatar.pose(motion, time))

    def coded(cull: float) -> np.ndarray:
        """8-bit images."""
        views = [*around.search, *around.held_out]
        frames = (FrameRenderer(avatar, light, s.camera, cull=cull).render(motion, s.time) for s in views)
        return np.array([frame.srgb for frame in frames]) / 255.0

    whole, nearer = coded(-1), COSINES[COSINES.index(found) - 1]
    off = [np.sqrt(np.mean((coded(cull) - whole) ** 2)) for cull in (found, nearer)]
    # rounding to 8 bits hides or adds a part of what the exporter sees
    assert off[0] < 1.05 * MAX_DIFFERENCE < 1.15 * off[1]


def test_of_what_is_seen_through_nothing_is_left_out(monkeypatch) -> None:
    monkeypatch.setattr("rnd_export.reduce.culling.SIZE", 128)
    avatar = _SeenThrough.load(ASSETS / "avatar.onnx")
    assert find_cull(avatar, random_motion(avatar.skeleton, frames=10, seed=1)) is None


@pytest.mark.parametrize(("cull", "said"), [(None, COSINES), (-0.25, (-0.25,)), (-1, (None,))])
def test_the_exporter_writes_found_or_given_advice(tiny_checkpoint, tmp_path, cull, said) -> None:
    export(load_checkpoint(tiny_checkpoint), tmp_path / "a.onnx", cull=cull)
    advice = Avatar.load(tmp_path / "a.onnx").advice
    assert advice.cull in said or (cull is None and advice.cull is None)
    keys = [entry.key for entry in onnx.load(tmp_path / "a.onnx").metadata_props]
    assert (ADVICE_KEY in keys) == (advice.cull is not None)


def test_the_command_reports_its_advice_and_compilation(tiny_checkpoint, tmp_path, monkeypatch, capsys) -> None:
    out = tmp_path / "a.onnx"
    monkeypatch.setattr("rnd_runtime.core.kernels.kernels_are_cold", lambda: True)
    words = [str(tiny_checkpoint), "--out", str(out), "--frames", "2", "--cull", "-0.3"]
    assert main(words) == 0
    said = capsys.readouterr()
    assert Avatar.load(out).advice.cull == -0.3
    assert "players leave out what faces away (n·v < -0.3)" in said.out
    assert said.err.splitlines() == [f"rnd-export: {COMPILING}"]


def test_players_follow_it_by_default(advised) -> None:
    plain, own = Avatar.load(ASSETS / "avatar.onnx"), Avatar.load(advised)
    assert plain.advice == PlayerAdvice() and own.advice == PlayerAdvice(CULL)
    motion, light = load_motion(ASSETS / "walk.npz", plain.skeleton), Light(plain.trained_light)
    camera = Camera.look_at([0.5, 1.2, 3], [0, 0.9, 0], width=96, height=96, fov_y=0.7)

    def frame(avatar: Avatar, cull: float | None, aovs: tuple[str, ...] = ()) -> bytes:
        renderer = FrameRenderer(avatar, light, camera, cull=cull)
        return renderer.render(motion, 0.4, aovs=aovs).radiance.tobytes()

    for aovs in ((), tuple(name for name in CHANNELS if name not in GIVEN)):
        whole, culled = frame(plain, None, aovs), frame(plain, CULL, aovs)
        assert whole != culled
        assert frame(own, None, aovs) == culled and frame(own, -1, aovs) == whole


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ('{"cull": 2}', "Expected `float` <= 1.0"),
        ('{"cull": "much"}', "Expected `float | null`"),
        ('{"cull"', "Input data was truncated"),
        ("[1]", "Expected `object`"),
    ],
)
def test_advice_that_is_none_is_refused(tmp_path, text, line) -> None:
    file = tmp_path / "odd.onnx"
    _with(file, lambda model: model.metadata_props.add(key=ADVICE_KEY, value=text))
    with pytest.raises(InputError, match="rnd_player") as caught:
        Avatar.load(file)
    assert line in str(caught.value) and "odd.onnx" in str(caught.value)


def test_advice_of_later_versions_is_left_alone(tmp_path) -> None:
    later = msgspec.json.encode({"cull": CULL, "shade_every": 2}).decode()
    file = tmp_path / "later.onnx"
    _with(file, lambda model: model.metadata_props.add(key=ADVICE_KEY, value=later))
    assert Avatar.load(file).advice.cull == CULL
