"""The page for static hosts in Chromium: dropped files play, relight, and match the Python player's pixels."""

from __future__ import annotations

import base64
import http.server
import json
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any
from urllib.parse import quote

import msgspec
import numpy as np
import onnx
import OpenImageIO as oiio
import pytest
from onnx import numpy_helper
from PIL import Image

from rnd_runtime.avatar.avatar import Avatar
from rnd_runtime.avatar.file import CONSTANT_OUTPUTS, POSED_OUTPUTS
from rnd_runtime.core.images import read_image, write_image
from rnd_runtime.core.rotations import axis_angle_to_matrix
from rnd_runtime.motion.motion import load_motion, save_motion
from rnd_runtime.shading.files.load import load_light
from rnd_runtime.shading.light import brightest_direction
from rnd_viewer.play.cli import main as play
from rnd_viewer.view.options import ViewOptions
from rnd_viewer.view.scene import Scene
from rnd_viewer.view.state import ViewState
from support.axe import needs_axe, violations
from support.browser import CHROMIUM, PATIENCE, Page, chromium
from support.paths import ASSETS, ROOT

DIST = ROOT / "viewer/web/dist"
SIZE, FRAME = 240, 20  # so large that rnd-play merges no Gaussians

TOLERANCE = 3  # of 255
MEAN_TOLERANCE = 1e-3  # of 255; measured 1e-4

# Pixels of a frame that may miss it: float32 and float64 order a few pairs of Gaussians at one depth differently.
MAX_FLIPPED = 10

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium"),
    pytest.mark.skipif(not (DIST / "worker.js").is_file(), reason="needs npm ci && npm run build in viewer/web"),
]


class _Quiet(http.server.SimpleHTTPRequestHandler):
    """A static host that keeps a list of what it was asked for."""

    asked: list[str] = []  # noqa: RUF012

    def log_message(self, format: str, *arguments: Any) -> None:
        self.asked.append(self.path)


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    """The built page with files to load beside it."""
    folder = tmp_path_factory.mktemp("site")
    for entry in DIST.iterdir():
        (folder / entry.name).symlink_to(entry)
    avatar = Avatar.load(ASSETS / "avatar.onnx")
    (folder / "avatar.onnx").symlink_to(ASSETS / "avatar.onnx")
    (folder / "sky.exr").symlink_to(ASSETS / "sky.exr")
    walk = load_motion(ASSETS / "walk.npz", avatar.skeleton)
    first = replace(walk, rotations=walk.rotations[:31], translations=walk.translations[:31])
    save_motion(folder / "walk.npz", first)
    save_motion(folder / "whole.npz", walk)
    save_motion(folder / "a #1, 50%.npz", first)
    rng = np.random.default_rng(3)
    # AMASS' SMPL-H: Z up, joints by number, fingers beside
    poses = np.zeros((8, 52, 3))
    poses[:, 0] = [1.4, 0.2, 0.1]
    poses[:, 1:] = rng.normal(0, 0.15, (8, 51, 3)).cumsum(0) * 0.4
    np.savez(
        folder / "amass.npz",
        poses=poses.reshape(8, 156).astype(np.float32),
        trans=rng.normal(0.3, 0.05, (8, 3)),
        betas=np.zeros(16),
        gender="neutral",
        mocap_framerate=24.0,
    )
    window = rng.uniform(0.05, 0.3, (64, 128, 3)).astype(np.float32)
    window[20:24, 30:35] = [90, 70, 40]
    window[10, 7:60] = 0.2  # runs, for the run-length coder
    _write_hdr(folder / "window.hdr", window)
    broken = window.copy()
    broken[40, 3:6, 1] = np.nan
    broken[41, 4] = -1
    write_image(folder / "broken.exr", broken)
    (folder / "torn.hdr").write_bytes((folder / "window.hdr").read_bytes()[:4000])
    (folder / "torn.onnx").write_bytes((ASSETS / "avatar.onnx").read_bytes()[:100_000])
    _write_advice(folder / "advised.onnx", '{"cull": -0.2}')
    _write_advice(folder / "misled.onnx", '{"cull": 3}')
    _write_avatar(folder / "other.onnx", _raise_and_dim)
    _write_avatar(folder / "stranger.onnx", _rename)
    _write_avatar(folder / "later.onnx", lambda about: about.update(schema="rnd-avatar/9"))
    _write_broken_avatar(folder / "holes.onnx")
    _write_avatar_of_a_graph(folder / "graph.onnx")
    ends = {"left_elbow": 1.6, "right_wrist": -1.9}  # radians about what is nearly the forearm's axis
    twisted = first.rotations.copy()
    for joint, angle in ends.items():
        twisted[:, avatar.skeleton.names.index(joint)] @= axis_angle_to_matrix([angle, 0, 0])
    save_motion(folder / "twisted.npz", replace(first, rotations=twisted))
    broken_trans = first.translations.copy()
    broken_trans[7, 1] = np.nan
    np.savez(folder / "nan.npz", poses=np.zeros((31, 72)), trans=broken_trans)
    np.savez(folder / "nobodys.npz", poses=np.zeros((2, 9)), joint_names=["a", "b", "c"], fps=30)
    _count_sessions(folder / "counted")
    return folder


def _write_avatar(path: Path, change: Callable[[dict[str, Any]], None]) -> None:
    """The embedded avatar with its metadata changed."""
    model = onnx.load(ASSETS / "avatar.onnx")
    entry = next(entry for entry in model.metadata_props if entry.key == "rnd_avatar")
    about = json.loads(entry.value)
    change(about)
    entry.value = json.dumps(about)
    onnx.save(model, path)


def _write_advice(path: Path, text: str) -> None:
    """The embedded avatar, whose file tells players what to leave out."""
    model = onnx.load(ASSETS / "avatar.onnx")
    model.metadata_props.add(key="rnd_player", value=text)
    onnx.save(model, path)


def _write_broken_avatar(path: Path) -> None:
    """The embedded avatar, a sixth of its Gaussians of no use: each has one number that is not finite, or no extent."""
    model = onnx.load(ASSETS / "avatar.onnx")
    arrays = {entry.name: numpy_helper.to_array(entry).copy() for entry in model.graph.initializer}
    arrays["rest/rest_points"][0::36, 1] = np.nan
    arrays["rest/rest_points"][6::36] = np.inf
    arrays["rest/rest_factors"][12::36, 4] = np.nan
    arrays["rest/rest_factors"][18::36] = 0
    for floor in (arrays["pose_gaussians/floor"], arrays["rest/posing_limits"][1:2]):
        floor[:] = 0  # which would be an extent
    arrays["rest/opacities"][24::36] = np.inf
    arrays["rest/albedo"][30::36, 2] = np.nan
    for entry in model.graph.initializer:
        entry.CopyFrom(numpy_helper.from_array(arrays[entry.name], entry.name))
    onnx.save(model, path)


def _write_avatar_of_a_graph(path: Path) -> None:
    """The embedded avatar without the outputs that let a player pose by itself."""
    model = onnx.load(ASSETS / "avatar.onnx")
    names = (*POSED_OUTPUTS, *CONSTANT_OUTPUTS, "skinning_weights")
    promised = [output for output in model.graph.output if output.name in names]
    del model.graph.output[:]
    model.graph.output.extend(promised)
    onnx.save(model, path)


def _raise_and_dim(about: dict[str, Any]) -> None:
    skeleton = about["skeleton"]
    skeleton["rest_joints"] = np.add(skeleton["rest_joints"], [0, 0.2, 0]).tolist()
    light = np.frombuffer(base64.b64decode(about["trained_light"]), "<f4") / 4
    about["trained_light"] = base64.b64encode(light.tobytes()).decode()


def _rename(about: dict[str, Any]) -> None:
    about["skeleton"]["names"] = [f"bone{k}" for k in range(len(about["skeleton"]["names"]))]


def _count_sessions(folder: Path) -> None:
    """The page again, telling on a channel when onnxruntime opens and releases a session."""
    (folder / "ort").mkdir(parents=True)
    for entry in [entry for entry in DIST.iterdir() if entry.name != "ort"]:
        (folder / entry.name).symlink_to(entry)
    for entry in (DIST / "ort").iterdir():
        name = "real.mjs" if entry.name == "ort.wasm.min.mjs" else entry.name
        (folder / "ort" / name).symlink_to(entry)
    (folder / "ort/ort.wasm.min.mjs").write_text("""
        import * as ort from "./real.mjs";
        export * from "./real.mjs";
        const channel = new BroadcastChannel("sessions");
        export const InferenceSession = {
            async create(...inputs) {
                const session = await ort.InferenceSession.create(...inputs), release = session.release.bind(session);
                session.release = () => release().then(() => channel.postMessage("released"));
                channel.postMessage("opened");
                return session;
            },
        };
    """)


def _write_hdr(path: Path, radiance: np.ndarray) -> None:
    target = oiio.ImageOutput.create(str(path))
    assert target.open(str(path), oiio.ImageSpec(radiance.shape[1], radiance.shape[0], 3, "float"))
    assert target.write_image(radiance) and target.close()


@pytest.fixture(scope="module")
def address(site):
    """Where a static host serves the site."""
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), partial(_Quiet, directory=str(site))) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}/"
        server.shutdown()
        thread.join()


def _open(browser: Page, address: str) -> None:
    browser.open(address)
    browser.wait(
        "window.rnd && !document.getElementById('zone').hidden && !document.getElementById('message').textContent"
    )


@pytest.fixture(scope="module")
def page(address, tmp_path_factory):
    """The page in a browser, nothing loaded."""
    with chromium(tmp_path_factory.mktemp("profile"), webgl=True) as browser:
        _open(browser, address)
        yield browser
        assert browser.messages == []


@pytest.fixture
def fresh(address, tmp_path):
    """The page in a browser of its own, nothing loaded; ``sessions`` counts onnxruntime's."""
    with chromium(tmp_path, webgl=True) as browser:
        _open(browser, address + "counted/")
        browser.run("""
            window.sessions = { opened: 0, released: 0 };
            new BroadcastChannel("sessions").onmessage = ({ data }) => { sessions[data] += 1; };
        """)
        yield browser
        assert browser.messages == []


def _drop(page: Page, *names: str) -> str:
    """Drop files of the site on the page, and wait until they are in ("") or what it says of them."""
    page.run("window.before = rnd.scene()")
    asked = _let_go(page, *names)  # "reading …"
    page.run(f"""(async () => {{
        const message = document.getElementById("message");
        const unanswered = ["", {json.dumps(asked)}];  // the scene takes it away
        while (rnd.scene() === before && unanswered.includes(message.textContent))
            await new Promise((done) => setTimeout(done, 20));
    }})()""")
    return page.run("rnd.scene() === before ? document.getElementById('message').textContent : ''")


def _let_go(page: Page, *names: str) -> str:
    """Drop files of the site on the page, as from a folder; what it says at once."""
    return page.run(f"""(async () => {{
        const data = new DataTransfer();
        for (const name of {json.dumps(names)})
            data.items.add(new File([await (await fetch(`/${{name}}`)).blob()], name));
        document.getElementById("stage").dispatchEvent(new DragEvent("drop", {{ dataTransfer: data, bubbles: true }}));
        return document.getElementById("message").textContent;
    }})()""")


def _is_refusal(page: Page) -> bool:
    return page.run("document.getElementById('message').classList.contains('wrong')")


def _frame(page: Page, **changes: Any) -> np.ndarray:
    """[H, W, 3] of the state with ``changes``."""
    page.run(f"""(async () => {{
        Object.assign(rnd.state, {json.dumps(changes)});
        const shown = async () => (await rnd.frame()).gaussians;
        for (let before = null, now = await shown(); now !== before; [before, now] = [now, await shown()]);
    }})()""")  # far bodies have fewer and fewer Gaussians, as levels of detail are made
    url = page.run("document.getElementById('frame').toDataURL()")
    return np.asarray(Image.open(BytesIO(base64.b64decode(url.split(",")[1]))).convert("RGB"))


@pytest.fixture(scope="module")
def loaded(page, site) -> Page:
    """The page with avatar, walk and two lights dropped on it."""
    _drop(page, "walk.npz", "avatar.onnx", "sky.exr", "window.hdr")
    page.run("rnd.play(false)")
    return page


def _assert_close(got: np.ndarray, expected: np.ndarray) -> None:
    assert got.shape == expected.shape
    error = np.abs(got.astype(int) - expected)
    flipped = int((error.max(-1) > TOLERANCE).sum())
    assert flipped <= MAX_FLIPPED and error.mean() < MEAN_TOLERANCE, (flipped, error.max(), error.mean())


def _scene(site: Path, motion: str = "walk.npz", avatar: str = "avatar.onnx") -> Scene:
    lights = (site / "sky.exr", site / "window.hdr", site / "broken.exr")
    return Scene(ViewOptions(site / avatar, site / motion, lights, size=(SIZE, None), raster="cpu"))


def _python_frame(page: Page, scene: Scene) -> np.ndarray:
    """What rnd-view draws of the page's state."""
    return scene.render(msgspec.convert(page.run("rnd.state"), ViewState)).srgb


def _assert_agreed(page: Page, got: np.ndarray, scene: Scene) -> None:
    """The page's image ``got`` is rnd-view's."""
    _assert_close(got, _python_frame(page, scene))


def test_the_pixels_are_rnd_plays(loaded, site, tmp_path):
    inputs = [str(site / "avatar.onnx"), "--motion", str(site / "walk.npz"), "--hdr", str(site / "sky.exr")]
    options = ["--size", str(SIZE), "--frames", f"{FRAME}:{FRAME + 1}", "--format", "png", "--raster", "cpu"]
    light = ["--background", "hdr", "--hdr-yaw", "40", "--exposure", "0.5"]
    assert play([*inputs, *options, *light, "--out", str(tmp_path)]) == 0
    state = {"width": SIZE, "height": SIZE, "time": FRAME / 30, "light": 1, "ground": False}
    got = _frame(loaded, **state, background="hdr", yaw=np.radians(40), exposure=0.5)
    expected = read_image(tmp_path / f"frames/{FRAME:06d}.png")
    _assert_close(got, expected)
    # were the light not turned, or the frame its neighbour, hundreds of pixels would be off
    assert (np.abs(_frame(loaded, yaw=0).astype(int) - expected).max(-1) > TOLERANCE).sum() > 1000


def test_a_far_body_has_as_few_gaussians_as_in_rnd_play(loaded, site, tmp_path):
    side, avatar = 96, Avatar.load(site / "avatar.onnx")
    straight = {"yaw": 0, "exposure": 0, "shade": "table+sun", "output": "lit", "tone": "srgb", "ground": False}
    state = {"width": side, "height": side, "time": FRAME / 30, "light": 1, "background": "hdr", "distance": 7.0}
    got = _frame(loaded, **straight, **state)
    fewer, whole, again = loaded.run("""(async () => {
        const count = async (changes) => (Object.assign(rnd.state, changes), (await rnd.frame()).gaussians);
        return [await count({}), await count({ distance: 0.9 }), await count({ distance: 7 })];
    })()""")
    assert fewer == again < 0.5 * whole and whole == avatar.gaussians
    camera = msgspec.convert(loaded.run("rnd.state"), ViewState).camera()
    path = {"width": side, "height": side, "K": camera.K.tolist(), "world_to_camera": camera.world_to_camera.tolist()}
    (tmp_path / "camera.json").write_text(json.dumps(path))
    inputs = [str(site / "avatar.onnx"), "--motion", str(site / "walk.npz"), "--hdr", str(site / "sky.exr")]
    options = ["--camera", str(tmp_path / "camera.json"), "--frames", f"{FRAME}:{FRAME + 1}", "--raster", "cpu"]
    assert play([*inputs, *options, "--format", "png", "--background", "hdr", "--out", str(tmp_path / "out")]) == 0
    _assert_close(got, read_image(tmp_path / f"out/frames/{FRAME:06d}.png"))


def test_every_state_has_rnd_views_pixels(loaded, site):
    scene = _scene(site)
    straight = {
        "light": 1,
        "yaw": 0.0,
        "exposure": 0.0,
        "output": "lit",
        "shade": "table+sun",
        "background": "none",
        "tone": "srgb",
        "ground": False,
        "gaussians": None,
        "width": SIZE,
        "height": SIZE,
        "target": loaded.run("rnd.state.target"),
    }
    states: list[dict[str, Any]] = [
        {"shade": "table", "time": 0.21},
        {"light": 2, "yaw": 2.5, "background": "#c08040", "time": 0.9},
        {"light": 0, "exposure": -1.3, "shade": "table"},
        {"exposure": 2.0, "tone": "neutral", "background": "hdr"},
        {"exposure": 1.0, "tone": "neutral", "background": "#ffd080"},
        {"output": "albedo", "tone": "neutral", "azimuth": 0.4},
        # on the ground: shadows of a sun and of the sky, seen from above, from afar and from below
        {"background": "#808080", "ground": True, "yaw": 0.7, "elevation": 0.6, "time": 0.3},
        {"background": "hdr", "ground": True, "light": 2, "yaw": -1.2, "distance": 9.0, "tone": "neutral"},
        {"background": "#c08040", "ground": True, "light": 0, "output": "light", "gaussians": 3000},
        {"background": "#ffffff", "ground": True, "elevation": -0.4},
        {"azimuth": 2.0, "elevation": 0.5, "distance": 1.9, "fov": 0.9},
        *({"output": name} for name in ("light", "albedo", "normal", "roughness", "visibility")),
        {"gaussians": 3000, "azimuth": -1.0},
        {"time": 0.5, "yaw": 3.0, "azimuth": 0.8},
        {"light": 2, "shade": "ao", "yaw": -1.0},
        {"shade": "lights:16", "background": "hdr", "width": 2 * SIZE},
        {"light": 0, "shade": "lights:128"},
        {"shade": "brute", "exposure": 1.0},
        {"distance": 0.9, "elevation": 0.3, "shade": "table"},  # the body exceeds the image
        *({"distance": metres, "light": 1} for metres in (12.0, 30.0, 90.0)),  # of few pixels: on a finer grid
        {"distance": 40.0, "target": [0.6, 1.0, 7.0], "output": "normal"},
        # rounding puts the outermost Gaussian of the sun's map on a texel's centre
        {"light": 0, "yaw": -3.136260264236736, "time": 0.8695288902257207, "fov": 0.7, "distance": 3.6},
    ]
    seen = set()
    for changes in states:
        got = _frame(loaded, **(straight | changes))
        _assert_agreed(loaded, got, scene)
        seen.add(got.tobytes())
    assert len(seen) == len(states)
    grey = straight | {"background": "#808080"}
    bare, shadowed = (_frame(loaded, **(grey | {"ground": on})) for on in (False, True))
    assert (shadowed < bare).all(-1).mean() > 0.03
    scene.close()


def test_gaussians_that_are_not_finite_are_neither_rendered_nor_shadowed(fresh, site):
    _drop(fresh, "holes.onnx", "walk.npz", "sky.exr")
    avatar, sky = site / "holes.onnx", site / "sky.exr"
    scene = Scene(ViewOptions(avatar, site / "walk.npz", (sky,), size=(SIZE, None), raster="cpu"))
    straight = {"time": 0.4, "light": 1, "shade": "table+sun", "output": "light", "gaussians": None}
    straight |= {"width": SIZE, "height": SIZE}
    states: list[dict[str, Any]] = [
        {},  # of one albedo: the suns' shadows alone
        {"yaw": 2.0, "azimuth": 0.8},
        {"gaussians": 5000},
        {"shade": "lights:16", "output": "lit"},
        {"output": "albedo"},
    ]
    for changes in states:
        got = _frame(fresh, **(straight | changes))
        assert got.any()
        _assert_agreed(fresh, got, scene)
    scene.close()


def test_what_the_file_advises_to_leave_out_is_left_out_as_in_rnd_view(fresh, site):
    _drop(fresh, "avatar.onnx", "walk.npz", "sky.exr")
    state: dict[str, Any] = {"width": SIZE, "height": SIZE, "time": 0.4, "azimuth": 1.1}
    whole = {output: _frame(fresh, **state, output=output) for output in ("lit", "normal")}
    _drop(fresh, "advised.onnx")
    scene = _scene(site, avatar="advised.onnx")
    for output, everything in whole.items():
        got = _frame(fresh, **state, output=output)
        _assert_agreed(fresh, got, scene)
        assert (np.abs(got.astype(int) - everything).max(-1) > TOLERANCE).sum() > 100
    scene.close()


def test_a_file_that_only_its_graph_can_pose_is_posed_by_it(fresh, site):
    _drop(fresh, "graph.onnx", "walk.npz", "sky.exr")
    scene = Scene(ViewOptions(site / "graph.onnx", site / "walk.npz", size=(SIZE, None), raster="cpu"))
    got = _frame(fresh, width=SIZE, height=SIZE, light=0, shade="table", time=0.4)
    assert got.any()
    _assert_agreed(fresh, got, scene)
    scene.close()


def test_it_plays_and_relights_by_hand(loaded):
    loaded.run("rnd.state.time = 0; rnd.play(true)")
    loaded.wait("rnd.state.time > 0.3")
    loaded.wait("rnd.rate() > 1 && document.querySelectorAll('#times tr').length > 4")
    loaded.run("rnd.play(false)")
    before = _frame(loaded, time=0.5, output="lit")
    loaded.drag((300, 300), (-100, 0), shift=True)
    assert (_frame(loaded) != before).mean() > 0.02


def test_a_motion_of_another_family_and_a_broken_light(loaded, site):
    _drop(loaded, "amass.npz")
    assert loaded.run("rnd.scene().motion") == pytest.approx({"name": "amass.npz", "duration": 7 / 24, "fps": 24})
    _drop(loaded, "broken.exr")
    loaded.wait("document.getElementById('notes').textContent.includes('4 texels of the light were NaN')")
    assert load_light(site / "broken.exr").repaired == 4
    assert loaded.run("rnd.state.light") == 3
    scene = _scene(site, "amass.npz")
    view = loaded.run("rnd.scene().view")
    for name, value in scene.description()["view"].items():
        assert view[name] == pytest.approx(value, abs=1e-9), name
    got = _frame(loaded, time=0.1, yaw=1.0)
    assert got.any()
    _assert_agreed(loaded, got, scene)
    scene.close()
    _drop(loaded, "walk.npz")


def test_twisted_forearms(fresh, site):
    _drop(fresh, "avatar.onnx", "twisted.npz", "sky.exr")
    scene = _scene(site, "twisted.npz")
    _assert_agreed(fresh, _frame(fresh, time=0.4, azimuth=0.5), scene)
    scene.close()


def test_the_time_slider_reaches_the_last_frame_and_is_off_without_a_motion(fresh):
    """Of 131 steps of 1/30 s, which rounding makes longer than 131/30 s."""
    _drop(fresh, "avatar.onnx")
    assert fresh.run("document.getElementById('time').disabled")
    _drop(fresh, "whole.npz")
    fresh.run("""
        const slider = document.getElementById("time");
        slider.value = 1e9;
        slider.dispatchEvent(new Event("input"));
    """)
    assert fresh.run("rnd.state.time") == pytest.approx(131 / 30, abs=1e-6)
    assert not fresh.run("slider.disabled")


@needs_axe
def test_no_rule_of_accessibility_is_broken_before_and_after_files_come(fresh):
    assert violations(fresh) == []
    _drop(fresh, "avatar.onnx", "whole.npz", "sky.exr")
    assert violations(fresh) == []


def test_addresses_name_files_of_any_name(address, tmp_path):
    with chromium(tmp_path, webgl=True) as browser:
        browser.open(f"{address}?avatar=avatar.onnx&motion={quote('a #1, 50%.npz')}&hdr=sky.exr,window.hdr")
        browser.wait("window.rnd && rnd.scene()")
        assert browser.run("rnd.scene().motion.name") == "a #1, 50%.npz"
        assert browser.run("rnd.scene().lights") == ["the avatar's own", "sky.exr", "window.hdr"]
        assert browser.run("rnd.state.light") == 1  # the first that is named, as in rnd-view
        named = browser.run("location.search")
        browser.run("document.getElementById('share').click()")
        assert browser.run("location.hash.length") > 100 and browser.run("location.search") == named


def test_an_address_with_missing_files_names_each_and_the_example_opens(address, tmp_path):
    with chromium(tmp_path, webgl=True) as browser:
        browser.open(f"{address}?avatar=nobody.onnx&motion=walk.npz&hdr=sky.exr,night.hdr")
        browser.wait("document.querySelector('#message.wrong')")
        said = browser.run("[...document.querySelectorAll('#absent li')].map(({ textContent }) => textContent)")
        assert [reason.split(":")[0] for reason in said] == ["nobody.onnx", "night.hdr"] and "404" in said[0]
        assert browser.run("document.getElementById('message').textContent").startswith("2 of the address's files")
        browser.messages.clear()  # Chromium logs the missing files too
        at = "(({ left, top, width, height }) => [left + width / 2, top + height / 2])"
        browser.drag(browser.run(f"{at}(document.querySelector('#zone a').getBoundingClientRect())"), (0, 0))
        browser.wait("window.rnd && rnd.scene()")
        sun = browser.run("rnd.frame().then(({ sun }) => sun)")
        np.testing.assert_allclose(sun, brightest_direction(load_light(ASSETS / "sky.exr")), atol=1e-5)
        assert browser.run("[rnd.state.width, rnd.state.height]") == browser.run(
            "(({ clientWidth, clientHeight }) => [clientWidth, clientHeight])(document.querySelector('.pane'))"
        )
        assert browser.messages == []


def test_without_webgl_the_reason_stays(address, site, tmp_path):
    (site / "without").mkdir()
    for entry in DIST.iterdir():
        if entry.name != "worker.js":
            (site / "without" / entry.name).symlink_to(entry)
    none = "OffscreenCanvas.prototype.getContext = () => null;"
    (site / "without/worker.js").write_text(none + (DIST / "worker.js").read_text())
    with chromium(tmp_path, webgl=True) as browser:
        browser.open(address + "without/")
        browser.wait("window.rnd && document.getElementById('message').textContent.includes('WebGL')")
        said = _drop(browser, "avatar.onnx")
        assert "WebGL2" in said and _is_refusal(browser)


def test_a_lost_context_is_asked_for_again(address, site, tmp_path):
    """As after a reset of the driver: a canvas whose context is lost gives blank images."""
    (site / "lost").mkdir()
    for entry in DIST.iterdir():
        if entry.name != "worker.js":
            (site / "lost" / entry.name).symlink_to(entry)
    told = """{
        const { getContext } = OffscreenCanvas.prototype;
        OffscreenCanvas.prototype.getContext = function (...words) {
            return self.context = getContext.apply(this, words);
        };
        new BroadcastChannel("lose").onmessage = () => {
            self.context.getExtension("WEBGL_lose_context").loseContext();
            new BroadcastChannel("gone").postMessage(self.context.isContextLost());
        };
    }"""
    (site / "lost/worker.js").write_text(told + (DIST / "worker.js").read_text())
    with chromium(tmp_path, webgl=True) as browser:
        _open(browser, address + "lost/")
        assert _drop(browser, "avatar.onnx", "walk.npz", "window.hdr") == ""
        asked = {"width": 96, "height": 96, "background": "hdr"}
        before = _frame(browser, **asked)
        assert browser.run("""new Promise((done) => {
            new BroadcastChannel("gone").onmessage = ({ data }) => done(data);
            new BroadcastChannel("lose").postMessage(1);
        })""")
        assert before.any() and (_frame(browser, **asked) == before).all()


def _clip(page: Page, folder: Path, size: int) -> Path:
    """The clip of ``size``² pixels that the page offers as a download to ``folder``."""
    page.call("Browser.setDownloadBehavior", behavior="allow", downloadPath=str(folder))
    page.run(f"Object.assign(rnd.state, {{ width: {size}, height: {size} }})")
    page.run("document.getElementById('clip').click()")
    page.wait("!document.getElementById('clip').disabled")
    until = time.monotonic() + PATIENCE
    while not (files := [file for file in folder.iterdir() if file.stem == "clip"]):
        assert time.monotonic() < until, page.run("document.getElementById('message').textContent")
        time.sleep(0.05)
    return files[0]


def test_a_picture_has_twice_the_pixels_or_the_most(loaded):
    loaded.run("""(() => {
        window.makeUrl = URL.createObjectURL;
        URL.createObjectURL = (blob) => { window.saved = blob; return "data:,"; };
        document.getElementById("picture").value = "png 2";
    })()""")
    for width, height, size in ((600, 500, [1200, 1000]), (1024, 64, [2048, 128]), (2048, 64, [2048, 64])):
        loaded.run(f"Object.assign(rnd.state, {{ width: {width}, height: {height} }}); window.saved = null")
        loaded.run("document.getElementById('screenshot').click()")
        loaded.wait("saved")
        assert loaded.run("createImageBitmap(saved).then(({ width, height }) => [width, height])") == size
    assert loaded.run("document.getElementById('message').textContent").startswith("saved with 2048 × 64 pixels")
    loaded.run("URL.createObjectURL = makeUrl; 1")


def test_the_clip_is_a_download(loaded, tmp_path):
    file = _clip(loaded, tmp_path, 128)
    assert file.suffix in (".webm", ".mp4") and file.stat().st_size > 5_000


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("torn.onnx", "torn.onnx: the .onnx file is cut short"),
        ("later.onnx", "later.onnx: schema rnd-avatar/9"),
        ("misled.onnx", "metadata 'rnd_player': expected an object whose cull is -1 to 1, got {"),
        ("torn.hdr", "torn.hdr: the .hdr file is cut short"),
        ("nan.npz", "nan.npz: frame 7: trans: expected finite numbers, got nan"),
        ("nobodys.npz", "expected some of the avatar's"),
        ("index.html", "index.html: kind of file: expected .onnx, .npz, .hdr or .exr, got .html"),
    ],
)
def test_a_file_that_is_none_of_ours_is_refused_in_one_line(loaded, name, reason):
    message = _drop(loaded, "window.hdr", name)  # of several files it is named
    assert reason in message and "\n" not in message and _is_refusal(loaded)
    assert _frame(loaded).any()  # what was there still plays


def test_what_is_no_file_is_refused_in_one_line(loaded, tmp_path):
    folder = tmp_path / "probes"
    folder.mkdir()
    loaded.drop(folder)
    loaded.wait("document.getElementById('message').textContent.startsWith('probes: expected a file, got a folder')")
    assert _is_refusal(loaded)
    loaded.run("""document.dispatchEvent(new DragEvent("drop", { dataTransfer: new DataTransfer(), bubbles: true }))""")
    assert loaded.run("document.getElementById('message').textContent") == "expected files, got something else"


def test_a_refused_drop_changes_nothing(fresh):
    _drop(fresh, "avatar.onnx", "walk.npz")
    scene = fresh.run("rnd.scene()")
    state = {"width": SIZE, "height": SIZE, "light": 0, "time": 0.3}
    before = _frame(fresh, **state)
    for names, reason in [
        (("other.onnx", "nan.npz"), "expected finite numbers"),
        (("window.hdr", "other.onnx", "torn.onnx"), "cut short"),
        (("stranger.onnx",), "expected some of the avatar's"),
        (("amass.npz", "index.html"), "expected .onnx, .npz, .hdr or .exr"),
    ]:
        assert reason in _drop(fresh, *names) and _is_refusal(fresh), names
        assert (_frame(fresh, time=0.1) != before).any()  # not a cached image
        assert (_frame(fresh, **state) == before).all(), names
    fresh.wait("sessions.opened === sessions.released + 1")
    assert _drop(fresh, "walk.npz") == ""
    assert fresh.run("rnd.scene()") == scene


def test_the_drop_zone_names_what_it_has_until_there_is_an_avatar(fresh):
    held = "[...document.querySelectorAll('#held li')].map(({ textContent }) => textContent)"
    assert [line.split(" ")[:2] for line in fresh.run(held)] == [["no", "avatar"], ["no", "motion"], ["no", "light"]]
    assert _drop(fresh, "walk.npz", "sky.exr", "window.hdr") == "an avatar (.onnx) is still missing"
    assert fresh.run(held) == ["no avatar (.onnx) yet", "✓ walk.npz", "✓ sky.exr, window.hdr"]
    assert _drop(fresh, "avatar.onnx") == "" and fresh.run("document.getElementById('zone').hidden")
    assert fresh.run("[rnd.scene().motion.name, rnd.scene().lights.length]") == ["walk.npz", 3]


def test_another_avatar_has_its_own_motion_and_light_and_the_old_one_is_released(fresh, site):
    _drop(fresh, "avatar.onnx", "amass.npz")
    _drop(fresh, "other.onnx")
    fresh.wait("sessions.opened === 6 && sessions.released === 5")
    assert fresh.run("[rnd.scene().avatar, rnd.scene().motion.name]") == ["other.onnx", "amass.npz"]
    scene = Scene(ViewOptions(site / "other.onnx", site / "amass.npz", size=(SIZE, None), raster="cpu"))
    got = _frame(fresh, width=SIZE, height=SIZE, light=0, time=0.1)
    _assert_agreed(fresh, got, scene)
    scene.close()
    _drop(fresh, "avatar.onnx", "other.onnx", "stranger.onnx", "nobodys.npz", "avatar.onnx")  # the last one counts
    fresh.wait("sessions.opened > 6 && sessions.opened === sessions.released + 1")
