"""rnd-view's page in Chromium: loads, plays, relights, compares, keeps; its pixels are rnd-play's."""

from __future__ import annotations

import base64
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from rnd_runtime.avatar.avatar import Avatar
from rnd_runtime.capture.capture import load_capture
from rnd_runtime.core.images import read_image
from rnd_runtime.motion.motion import load_motion, save_motion
from rnd_viewer.play.cli import main as play
from rnd_viewer.view.options import SIZES, ViewOptions
from rnd_viewer.view.scene import Scene
from rnd_viewer.view.server import serve
from support.axe import needs_axe, violations
from support.browser import CHROMIUM, Page, answering, chromium
from support.paths import ASSETS

pytestmark = [pytest.mark.slow, pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")]

SIZE = 240  # so large that rnd-play merges no Gaussians
FRAME = 20
MESSAGE = "document.getElementById('message').textContent"
OUTCOME = """Promise.race([
    rnd.frame(false).then(() => "drawn", (error) => error.message),
    new Promise((done) => setTimeout(() => done("nothing"), 30000)),
])"""


@pytest.fixture(scope="module")
def motion(tmp_path_factory) -> Path:
    """The walk's first second."""
    walk = load_motion(ASSETS / "walk.npz", Avatar.load(ASSETS / "avatar.onnx").skeleton)
    path = tmp_path_factory.mktemp("motion") / "walk.npz"
    save_motion(path, replace(walk, rotations=walk.rotations[:31], translations=walk.translations[:31]))
    return path


@pytest.fixture(scope="module")
def scene(motion):
    """The embedded avatar with its capture."""
    files = ASSETS / "avatar.onnx", motion, (ASSETS / "sky.exr",)
    scene = Scene(ViewOptions(*files, capture=ASSETS / "capture", size=(SIZE, None), raster="cpu"))
    yield scene
    scene.close()


@contextmanager
def _serving(scene: Scene) -> Iterator[str]:
    with serve(scene, "127.0.0.1", 0, "s3cret") as (server, url), answering(server):
        yield url


@pytest.fixture(scope="module")
def page(scene, tmp_path_factory):
    """The page open in a browser."""
    with _serving(scene) as url, chromium(tmp_path_factory.mktemp("profile")) as browser:
        browser.open(url)
        browser.wait("window.rnd && rnd.scene()")
        yield browser
        assert browser.messages == []


@pytest.fixture(scope="module")
def played(motion, tmp_path_factory) -> dict[str, Path]:
    """The same frame by rnd-play: as it is, and with the light turned."""
    folders = {}
    for name, yaw in (("straight", 0), ("turned", 90)):
        folder = folders[name] = tmp_path_factory.mktemp(name)
        inputs = [str(ASSETS / "avatar.onnx"), "--motion", str(motion), "--hdr", str(ASSETS / "sky.exr")]
        options = ["--size", str(SIZE), "--frames", f"{FRAME}:{FRAME + 1}", "--format", "png", "--raster", "cpu"]
        assert play([*inputs, *options, "--background", "#000000", "--hdr-yaw", str(yaw), "--out", str(folder)]) == 0
    return {name: folder / f"frames/{FRAME:06d}.png" for name, folder in folders.items()}


def _pixels(page: Page, canvas: str = "frame") -> np.ndarray:
    """[H, W, 3] of a canvas as it is now."""
    url = page.run(f"document.getElementById('{canvas}').toDataURL()")
    return np.asarray(Image.open(BytesIO(base64.b64decode(url.split(",")[1]))).convert("RGB"))


def _screenshot_name(page: Page) -> str:
    """The name under which the page's button offers a picture, which is not kept."""
    return page.run("""new Promise((done) => {
        const { click } = HTMLAnchorElement.prototype;
        HTMLAnchorElement.prototype.click = function () {
            HTMLAnchorElement.prototype.click = click;
            done(this.download);
        };
        document.getElementById("screenshot").click();
    })""")


def _frame(page: Page, changes: str = "") -> np.ndarray:
    page.run(f"Object.assign(rnd.state, {{{changes}}}); rnd.frame().then(() => 1)")
    return _pixels(page)


def _set(page: Page, control: str, value: str) -> None:
    element = f"document.getElementById('{control}')"
    events = "".join(f"{element}.dispatchEvent(new Event('{name}'));" for name in ("input", "change"))
    page.run(f"{element}.value = '{value}'; {events}")


def test_the_canvas_shows_rnd_plays_frame_and_relights(page, played):
    page.run("rnd.play(false)")
    fps = page.run("rnd.scene().motion.fps")
    assert (_frame(page, f"time: {FRAME} / {fps}, background: 'none'") == read_image(played["straight"])).all()
    _set(page, "yaw", "90")
    assert (_frame(page) == read_image(played["turned"])).all()
    # shift and drag turn the light too: 0.01 rad for each pixel
    page.drag((300, 300), (-100, 0), shift=True)
    assert page.run("rnd.state.yaw") == pytest.approx(np.pi / 2 - 1)
    _set(page, "yaw", "0")
    assert (_frame(page) == read_image(played["straight"])).all()


def test_it_plays_and_stops(page):
    page.run("rnd.state.time = 0; rnd.play(true)")
    page.wait("rnd.state.time > 0.3")
    first = _pixels(page)
    page.wait("rnd.state.time > 0.6 || rnd.state.time < 0.3")
    assert (_pixels(page) != first).any()
    page.wait("document.querySelectorAll('#times tr').length > 5 && rnd.rate() > 1")
    page.run("rnd.play(false)")
    stopped = page.run("rnd.state.time")
    _set(page, "time", "0.5")
    assert page.run("rnd.state.time") == pytest.approx(0.5, abs=0.02) != stopped
    assert (_frame(page) != first).any()


def test_drag_rotates_and_reset_restores_the_view(page):
    before = _frame(page)
    page.drag((300, 300), (80, 30))
    turned = _frame(page)
    assert (turned != before).any() and page.run("rnd.state.elevation") > 0.3
    page.run("Object.assign(rnd.state, { yaw: 1, exposure: 2 })")
    page.press("KeyR")
    assert (_frame(page) == before).all() and page.run("[rnd.state.yaw, rnd.state.exposure]") == [0, 0]


def test_outputs_sliders_and_skeleton(page):
    seen = {_frame(page).tobytes()}
    for name in ("light", "albedo", "normal", "roughness", "visibility", "lit"):
        page.run(f"document.querySelector('[data-value={name}]').click()")
        seen.add(_frame(page).tobytes())
    assert len(seen) == 6
    _set(page, "size", "256")
    sizes = "(({ min, max }) => [Number(min), Number(max)])(document.getElementById('size'))"
    assert page.run(sizes) == list(SIZES)
    _set(page, "gaussians", "20")
    assert page.run("rnd.frame().then(p => [p.width, p.height])") == [256, 256]
    assert page.run("rnd.state.gaussians") == round(page.run("rnd.scene().gaussians") / 5)
    page.run("document.getElementById('skeleton').click(); rnd.frame().then(() => 1)")
    assert _pixels(page, "overlay").any()
    page.run("document.getElementById('skeleton').click()")
    _set(page, "gaussians", "100")


def test_ground_truth_stands_beside(page):
    capture = load_capture(ASSETS / "capture")
    page.run("document.getElementById('truth-on').click()")
    index = len(capture.frames) // 2
    _set(page, "truth-index", str(index))
    page.wait(f"document.getElementById('truth').dataset.index === '{index}'")
    image = read_image(capture.folder / capture.frames[index].image)
    picture = _frame(page, f"width: {image.shape[1]}, height: {image.shape[0]}")
    assert picture.shape == image.shape
    assert (_pixels(page, "truth") == image).all()
    assert (_frame(page, "yaw: 2, exposure: 3") == picture).all()  # its light stays as it was
    for control in ("light", "yaw", "exposure"):
        assert page.run(f"document.getElementById('{control}').disabled"), control
    assert page.run("[document.getElementById('yaw').value, document.getElementById('exposure').value]") == ["0", "0"]
    before = page.run("rnd.state.azimuth += 0.1; ({ ...rnd.state })")
    page.drag((300, 300), (50, 0), shift=True)
    page.drag((300, 300), (50, 60))
    page.run("document.getElementById('stage').dispatchEvent(new WheelEvent('wheel', { deltaY: 500 }))")
    for key in ("Space", "Period", "KeyR"):
        page.press(key)
    assert page.run("({ ...rnd.state })") == page.run("rnd.frame().then(() => ({ ...rnd.state }))") == before
    for control in ("clip", "play", "time"):  # they would film or move something else
        assert page.run(f"document.getElementById('{control}').disabled"), control
    frame = capture.frames[index]
    seen = "(id) => document.getElementById(id).textContent"
    assert page.run(f"['clock', 'truth-name'].map({seen})") == [
        f"{frame.frame / capture.fps:.2f} s",
        page.run(f"rnd.scene().truths[{index}].label"),
    ]
    assert page.run("document.getElementById('hint').hidden")
    name = re.sub(r"[ ·]+", "_", page.run(f"rnd.scene().truths[{index}].label"))
    assert _screenshot_name(page) == f"avatar_{name}.png"
    # the avatar was trained on this capture: 20 dB over the whole picture is far from what another pose gives
    assert np.mean((picture.astype(float) - image) ** 2) < 255**2 / 10**2.0
    page.run("document.getElementById('truth-on').click()")
    assert page.run("document.getElementById('truth-pane').hidden")
    for control in ("clip", "play", "time", "exposure"):
        assert not page.run(f"document.getElementById('{control}').disabled"), control
    page.press("KeyR")
    assert not page.run("document.getElementById('hint').hidden")
    assert "of" in page.run("rnd.frame().then(() => document.getElementById('clock').textContent)")
    _set(page, "size", str(SIZE))


@needs_axe
def test_no_rule_of_accessibility_is_broken_on_a_desk_and_on_a_phone(page):
    for width, height in ((390, 844), (1100, 720)):
        screen = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < height}
        page.call("Emulation.setDeviceMetricsOverride", **screen)
        for _ in range(2):  # with the ground truth beside, and without
            page.run("document.getElementById('truth-on').click(); rnd.frame().then(() => 1)")
            assert violations(page) == []


def test_ground_truth_that_the_browser_cannot_decode_is_said_and_leaves_its_pane_blank(
    page, scene, tmp_path, monkeypatch
):
    Image.new("RGB", (8, 8), "white").save(tmp_path / "truth.tiff")
    page.run("document.getElementById('truth-on').click()")
    index = page.run("rnd.state.truth")
    page.wait(f"document.getElementById('truth').dataset.index === '{index}'")
    assert _pixels(page, "truth").any()
    with monkeypatch.context() as patch:
        patch.setattr(scene, "truth_file", lambda index: tmp_path / "truth.tiff")
        _set(page, "truth-index", str(index + 1))
        page.wait("document.getElementById('message').classList.contains('wrong')")
    label = page.run(f"rnd.scene().truths[{index + 1}].label")
    assert page.run(MESSAGE) == f"{label}: this browser cannot decode the image"
    assert not _pixels(page, "truth").any()
    _set(page, "truth-index", str(index))
    page.wait(f"document.getElementById('truth').dataset.index === '{index}'")
    assert _pixels(page, "truth").any() and page.run(MESSAGE) == ""
    page.run("document.getElementById('truth-on').click()")
    _set(page, "size", str(SIZE))


def test_screenshot_and_clip_are_downloads(page, tmp_path):
    page.call("Browser.setDownloadBehavior", behavior="allow", downloadPath=str(tmp_path))
    shown = _frame(page)
    time_s = page.run("rnd.state.time")
    page.run("document.getElementById('screenshot').click(); rnd.state.time += 0.1")
    _set(page, "size", "128")
    page.run("document.getElementById('clip').click()")
    page.wait("!document.getElementById('clip').disabled")
    for _ in range(100):
        files = {file.suffix: file for file in tmp_path.iterdir()}
        if {".png", ".mp4"} <= files.keys():
            break
        page.wait("new Promise(done => setTimeout(() => done(true), 50))")
    assert (read_image(files[".png"])[..., :3] == shown).all()
    assert files[".png"].name == f"avatar_{time_s:.2f}s.png"
    assert files[".mp4"].stat().st_size > 10_000


def test_with_a_token_and_in_jpeg(page, scene):
    exact = _frame(page, f"width: {SIZE}, height: {SIZE}, time: 0.5").astype(int)
    back = page.run("location.href")
    with _serving(scene) as url:
        page.open(f"{url}&encoding=jpeg")
        page.wait("location.search.includes('s3cret') && window.rnd && rnd.scene()")
        page.run("Object.assign(rnd.state, {time: 0.5, background: 'none'}); rnd.frame(false).then(() => 1)")
        error = np.abs(_pixels(page) - exact)
        assert 0 < error.mean() < 2  # halved chroma at the edges
        assert (_frame(page) == exact).all()  # a screenshot is exact all the same
        page.open(url.split("?")[0])  # the cookie is enough
        page.wait("!location.search && window.rnd && rnd.scene()")
    page.open(back)
    page.wait("window.rnd && rnd.scene()")


def test_what_is_asked_of_a_viewer_that_is_gone_fails_at_once(page, scene):
    back = page.run("location.href")
    page.run("""
        const { send: sendOn } = WebSocket.prototype;
        WebSocket.prototype.send = function (text) { window.socket = this; sendOn.call(this, text); };
        rnd.frame().then(() => new Promise((done) => {
            socket.addEventListener("close", done);
            socket.close();
        })).then(() => 1);
    """)
    gone = "rnd-view does not answer; is it still running?"
    assert page.run(OUTCOME) == gone
    page.run("document.getElementById('clip').click()")
    assert page.run(MESSAGE) == gone and not page.run("document.getElementById('clip').disabled")
    shown = "new Promise((done) => setTimeout(done, 300)).then(() => document.getElementById('play').textContent)"
    assert page.run(f"rnd.play(true); {shown}") == "▶"  # and not said once more for every picture
    page.open(back)
    page.wait("!window.socket && window.rnd && rnd.scene()")
