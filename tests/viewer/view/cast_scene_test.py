"""rnd-view SCENE.toml: a scene of one is the avatar, several are rnd-play's, and the page shows them all."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest
from msgspec.structs import replace

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.images import read_image
from rnd_viewer.play.cli import main as play
from rnd_viewer.view.cast_scene import CastScene
from rnd_viewer.view.options import ViewOptions
from rnd_viewer.view.scene import Scene
from rnd_viewer.view.server import serve
from rnd_viewer.view.state import ViewState
from support.axe import AXE, violations
from support.browser import CHROMIUM, answering, chromium
from support.paths import ASSETS

SIZE, FRAME, FPS = 288, 12, 30  # so large that nobody has fewer Gaussians: how many depends on earlier frames
WALK, SKY = ASSETS / "walk.npz", ASSETS / "sky.exr"
PERSON = f'[[person]]\navatar = "{ASSETS / "avatar.onnx"}"\nmotion = "{WALK}"\n'
OTHER = PERSON + "position = [1.1, -0.4]\nheading = -50\nstart = 0.2\n"


def _scene(folder: Path, text: str) -> CastScene:
    file = folder / "scene.toml"
    file.write_text(text, encoding="utf-8")
    return CastScene(ViewOptions(file, hdr=(SKY,), size=(SIZE, None), raster="cpu"))


def _state(scene: Scene) -> ViewState:
    """The first view under the sky, on the ground."""
    look = {"width": SIZE, "height": SIZE, "time": FRAME / FPS, "light": 1, "background": "hdr", "ground": True}
    return msgspec.convert(look | scene.description()["view"], ViewState)


def test_a_scene_of_one_is_the_avatar(tmp_path):
    alone = Scene(ViewOptions(ASSETS / "avatar.onnx", WALK, (SKY,), size=(SIZE, None), raster="cpu"))
    cast = _scene(tmp_path, PERSON)
    ours, theirs = cast.description(), alone.description()
    for name in ("gaussians", "parents", "lights", "head", "size", "truths", "notes"):
        assert ours[name] == theirs[name], name
    assert ours["motion"] == theirs["motion"] | {"name": "1 person"}
    state = _state(alone)
    for changes in (
        {},
        {"yaw": 1.0, "tone": "neutral", "exposure": 0.5, "background": "#808080"},
        {"output": "light", "azimuth": 2.0},
        {"output": "normal"},
        {"output": "albedo", "gaussians": 5000},
        {"gaussians": 3000, "shade": "table", "time": 0.0},
        {"distance": 9.0},  # of merged Gaussians
        {"distance": 9.0, "output": "albedo", "time": 0.3},
        {},
    ):
        ours, theirs = (scene.render(replace(state, **changes)) for scene in (cast, alone))
        error = np.abs(ours.srgb.astype(int) - theirs.srgb)
        assert (error > 1).mean() < 1e-3 and theirs.srgb.any(), (changes, error.max())  # one order of equal depths
        np.testing.assert_allclose(ours.joints, theirs.joints, atol=1e-2)
    alone.close()
    cast.close()


def test_two_people_have_rnd_plays_pixels(tmp_path):
    scene = _scene(tmp_path, PERSON + OTHER)
    words = [str(tmp_path / "scene.toml"), "--hdr", str(SKY), "--size", str(SIZE), "--raster", "cpu"]
    words += ["--background", "hdr", "--ground", "auto", "--format", "png", "--frames", f"{FRAME}:{FRAME + 1}"]
    assert play([*words, "--out", str(tmp_path / "out")]) == 0
    expected = read_image(tmp_path / f"out/frames/{FRAME:06d}.png")[..., :3].astype(int)
    state = _state(scene)
    view = scene.render(state)
    assert (np.abs(view.srgb - expected) > 1).mean() < 1e-3
    early = scene.render(replace(state, time=0.0)).srgb
    assert (np.abs(early - expected) > 1).mean() > 0.02  # another time is another image
    (first, second), joints = (person.avatar.skeleton for person in scene.people), view.joints
    assert len(joints) == len(first) + len(second) == len(scene.description()["parents"])
    assert joints[len(first), 0] - joints[0, 0] > SIZE / 8  # the other stands to the right
    assert scene.duration == pytest.approx(scene.motion.duration + 0.2)
    assert scene.frames_at(FPS) == scene.motion.frames_at(FPS) + 6
    scene.close()


def test_a_scene_brings_its_motions(tmp_path):
    for name, file in (("motion", WALK), ("capture", ASSETS / "capture")):
        with pytest.raises(InputError, match=f"--{name}: .*the scene has its motions"):
            ViewOptions(tmp_path / "scene.toml", **{name: file})
    with pytest.raises(InputError, match="line 1: light: "):
        _scene(tmp_path, "[light]\nx = 1\n" + PERSON)


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")
def test_the_page_shows_everybody_under_the_controls_of_one(tmp_path):
    scene = _scene(tmp_path, PERSON + OTHER)
    with (
        serve(scene, "127.0.0.1", 0, "s3cret") as (server, url),
        answering(server),
        chromium(tmp_path / "profile") as page,
    ):
        page.open(url)
        page.wait("window.rnd && rnd.scene()")
        assert "2 people" in page.run("document.getElementById('subtitle').textContent")
        home = page.run("rnd.state.azimuth")
        page.run("document.querySelector('[data-preset=side]').click(); document.getElementById('skeleton').click()")
        assert page.run("rnd.frame().then(({ joints }) => joints.length)") == len(scene.parents())
        assert page.run("rnd.state.azimuth") == pytest.approx(home + np.pi / 2)
        page.run("rnd.play(true)")
        page.wait("rnd.state.time > 0.2")
        page.run("rnd.play(false)")
        assert not AXE.is_file() or violations(page) == []
        assert page.messages == []
    scene.close()
