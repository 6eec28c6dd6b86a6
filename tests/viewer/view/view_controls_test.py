"""The controls of rnd-view's page in Chromium, by mouse and by touch: size, views, paths, links, pictures."""

from __future__ import annotations

import json
import urllib.error
import urllib.request

import msgspec
import numpy as np
import pytest

from rnd_runtime.shading.files.load import load_light
from rnd_runtime.shading.light import brightest_direction
from rnd_viewer.inputs.cameras import file_path
from rnd_viewer.view.options import ViewOptions
from rnd_viewer.view.scene import Scene
from rnd_viewer.view.server import serve
from rnd_viewer.view.state import ViewState
from support.browser import CHROMIUM, Page, answering, chromium
from support.paths import ASSETS

pytestmark = [pytest.mark.slow, pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")]

DRAWN = "rnd.frame().then(() => 1)"
PANE = "(({ clientWidth, clientHeight }) => [clientWidth, clientHeight])(document.querySelector('.pane'))"
FINGER = 44  # px
CORNER = "[...document.getElementById('frame').getContext('2d').getImageData(2, 2, 1, 1).data].slice(0, 3)"
# mean column of what is as yellow as the sun of the small sphere, also seen through it
SUN_COLUMN = """(() => {
    const { width, height } = gizmo, { data } = gizmo.getContext("2d").getImageData(0, 0, width, height);
    let count = 0, sum = 0;
    for (let k = 0; k < width * height; k++)
        if (data[4 * k] > data[4 * k + 2] + 15) { count += 1; sum += k % width; }
    return sum / count;
})()"""
TARGETS = """[...document.querySelectorAll("button, select, input:not([type=file]):not([type=checkbox]), label.check")]
    .map((part) => [part.id, part.getBoundingClientRect()]).filter(([, { width }]) => width > 0)
    .map(([name, { width, height }]) => [name, Math.min(width, height)])"""


@pytest.fixture(scope="module")
def opened(tmp_path_factory):
    """The page, which may choose its size, and its address."""
    scene = Scene(ViewOptions(ASSETS / "avatar.onnx", ASSETS / "walk.npz", (ASSETS / "sky.exr",), raster="cpu"))
    with (
        serve(scene, "127.0.0.1", 0, "s3cret") as (server, url),
        answering(server),
        chromium(tmp_path_factory.mktemp("profile")) as browser,
    ):
        browser.open(url)
        browser.wait("window.rnd && rnd.scene()")
        yield browser, url
        assert browser.messages == []
    scene.close()


@pytest.fixture
def page(opened) -> Page:
    """The page on a desk, in its first view."""
    browser, url = opened
    _screen(browser, 700, 500)
    browser.open(url.split("?")[0] + "?desk")
    browser.wait("location.search === '?desk' && window.rnd && rnd.scene()")
    browser.run(DRAWN)
    return browser


def _screen(page: Page, width: int, height: int, ratio: float = 1, *, touch: bool = False) -> None:
    screen = {"width": width, "height": height, "deviceScaleFactor": ratio, "mobile": touch}
    page.call("Emulation.setDeviceMetricsOverride", **screen)
    page.call("Emulation.setTouchEmulationEnabled", enabled=touch, maxTouchPoints=5)


def _click(page: Page, selector: str) -> None:
    page.run(f"document.querySelector('{selector}').click(); {DRAWN}")


def _touch(page: Page, kind: str, *points: tuple[float, float]) -> None:
    fingers = [{"x": x, "y": y, "id": number} for number, (x, y) in enumerate(points)]
    page.call("Input.dispatchTouchEvent", type=kind, touchPoints=fingers)


def test_the_frame_fills_its_pane_and_is_coarse_only_while_it_moves(page):
    assert page.run("[rnd.state.width, rnd.state.height]") == page.run(PANE)
    _screen(page, 560, 420, 2)
    page.wait(f"rnd.state.width === 2 * {PANE}[0] && rnd.state.height === 2 * {PANE}[1]")
    width = page.run("rnd.state.width")
    assert page.run(f"{DRAWN}.then(() => document.getElementById('frame').width)") == width
    page.run("rnd.fit.scale = 0.5; rnd.fit.observe = () => {}")
    page.run("setInterval(() => { if (window.moving) rnd.redraw(); }, 10); window.moving = true")
    page.wait(f"document.getElementById('frame').width === {round(width / 2)}")
    page.run("window.moving = false")
    page.wait(f"document.getElementById('frame').width === {width}")
    page.run(
        "document.getElementById('size').value = 128; document.getElementById('size').dispatchEvent(new Event('input'))"
    )
    assert page.run("[rnd.state.height, document.getElementById('fit').checked]") == [128, False]


def test_slow_frames_take_fewer_pixels_and_fast_ones_more(page):
    scales = page.run("""[100, 100, 100, 5, 5, 5, 5, 5, 5].map((ms) => {
        rnd.fit.observe(ms);
        return rnd.fit.scale;
    })""")
    assert scales[0] < 1 and min(scales) == 0.5 and scales[-1] > scales[2]


def test_it_plays_from_the_start_over_a_ground_unless_a_link_or_less_motion_is_asked_for(opened, page):
    assert page.run("[rnd.state.time, rnd.state.background, rnd.state.ground]") == [0, "#808080", True]
    address = opened[1].split("?")[0]
    page.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-reduced-motion", "value": "no-preference"}])
    try:
        for link, plays in (("?plays", True), ("?still#time=0.4", False)):
            page.open(address + link)
            page.wait("location.href.endsWith('" + link + "') && window.rnd && rnd.scene()")
            page.run(DRAWN)
            assert page.run("document.getElementById('play').textContent") == ("❚❚" if plays else "▶")
    finally:
        page.call("Emulation.setEmulatedMedia", features=[])


def test_the_whole_screen_shows_the_image_alone_and_messages_outlast_frames(page):
    page.run("document.getElementById('full').click()")
    page.wait("document.fullscreenElement && document.querySelector('aside').clientWidth <= 1")
    page.wait(f"{PANE}[0] === innerWidth && rnd.state.width === innerWidth")
    page.press("KeyF")
    page.wait("!document.fullscreenElement && document.querySelector('aside').clientWidth > 1")
    page.run("Object.defineProperty(navigator, 'clipboard', { value: undefined, configurable: true })")
    _click(page, "#share")
    for _ in range(3):
        page.run(DRAWN)
    assert page.run("document.getElementById('message').textContent") == "this page's address now holds what you see"


def test_presets_and_undo(page):
    home = page.run("({ ...rnd.state })")
    _click(page, "[data-preset=back]")
    assert abs(page.run("rnd.state.azimuth") - home["azimuth"]) == pytest.approx(np.pi)
    _click(page, "[data-preset=face]")
    face = page.run("({ ...rnd.state })")
    head = page.run("rnd.frame().then(({ joints }) => joints[rnd.scene().head])")
    assert abs(head[0] - face["width"] / 2) < 2 and face["height"] / 2 < head[1] < 0.8 * face["height"]
    page.drag((200, 200), (60, 0))
    assert page.run("rnd.state.azimuth") != face["azimuth"]
    for expected in (face["azimuth"], home["azimuth"] + np.pi, home["azimuth"], home["azimuth"]):
        _click(page, "#undo")
        assert page.run("rnd.state.azimuth") == pytest.approx(expected)
    assert page.run("rnd.state.distance") == home["distance"]


def test_a_link_holds_what_is_seen(page):
    look = {"yaw": 1, "exposure": -0.5, "tone": "neutral", "background": "hdr", "time": 0.4, "azimuth": 2}
    page.run(f"Object.assign(rnd.state, {json.dumps(look)})")
    _click(page, "#share")
    state, address = page.run("({ ...rnd.state })"), page.run("location.href")
    page.open("about:blank")
    page.open(address)
    page.wait("window.rnd && rnd.scene()")
    for name, value in page.run("({ ...rnd.state })").items():
        wanted = state[name] if value is None or isinstance(value, str | bool) else pytest.approx(state[name], abs=1e-5)
        assert value == wanted, name
    page.open("about:blank")
    page.open(address.split("#")[0] + "#yaw=x&target=1,2&ground=2&time=NaN")  # of other types
    page.wait("window.rnd && rnd.scene()")
    assert page.run("[rnd.state.yaw, rnd.state.target.length]") == [0, 3]


def test_a_link_does_not_hold_the_token(opened):
    page, url = opened
    page.open(url + "&encoding=raw")
    page.wait("location.search.includes('token') && window.rnd && rnd.scene()")
    _click(page, "#share")
    address = page.run("location.href")
    assert "s3cret" in url and "s3cret" not in address and "?encoding=raw#" in address
    with pytest.raises(urllib.error.HTTPError, match="401"):
        urllib.request.urlopen(address.split("#")[0], timeout=10)


def test_a_path_through_keys_is_rnd_plays_camera(page, tmp_path):
    """At the keys it is the page's camera; between them it is near, also where the azimuth passes ±π."""
    states = []
    for time, azimuth, distance in ((0.0, 3.0, 3.0), (0.5, -3.0, 2.0), (1.0, -2.5, 2.5)):
        page.run(f"Object.assign(rnd.state, {{ time: {time}, azimuth: {azimuth}, distance: {distance} }})")
        states.append(msgspec.convert(page.run("({ ...rnd.state })"), ViewState))
        _click(page, "#key")
    page.run("URL.createObjectURL = (blob) => { window.saved = blob; return 'data:,'; }")
    _click(page, "#path")
    file = tmp_path / "camera.json"
    file.write_text(page.run("saved.text()"))
    fps, duration = page.run("[rnd.scene().motion.fps, rnd.scene().motion.duration]")
    path = file_path(str(file), None, range(round(duration * fps) + 1))
    for state in states:
        camera, expected = path(round(state.time * fps), state.time), state.camera()
        np.testing.assert_allclose(camera.K, expected.K)
        np.testing.assert_allclose(camera.world_to_camera, expected.world_to_camera, atol=1e-9)
    page.run("rnd.state.azimuth = 0; rnd.state.time = 0.5")
    _click(page, "#follow")
    page.wait("rnd.state.azimuth !== 0")
    np.testing.assert_allclose(page.run("[rnd.state.azimuth, rnd.state.distance]"), [-3.0 + 2 * np.pi, 2.0], atol=1e-9)
    page.drag((200, 200), (60, 0))  # which ends it
    page.run(DRAWN)
    assert page.run("rnd.state.azimuth") == pytest.approx(-3.0 + 2 * np.pi - 0.6)
    for _ in range(4):  # the drag, and the keys
        _click(page, "#undo")
    assert page.run("document.getElementById('message').textContent") == "the camera's path has no keys"
    positions = np.array([path(number, 0).position for number in range(round(fps) + 1)])
    assert np.linalg.norm(np.diff(positions, axis=0), axis=1).max() < 0.15  # the long way round would be 0.6


def test_pictures_have_the_kind_and_size_that_are_chosen(page):
    page.run("""(() => {
        window.saved = null;
        URL.createObjectURL = (blob) => { window.saved = blob; return "data:,"; };
        HTMLAnchorElement.prototype.click = function () { window.name = this.download; };
    })()""")
    for kind, times in (("png", 1), ("jpeg", 2), ("webp", 2)):
        page.run(f"document.getElementById('picture').value = '{kind} {times}'; window.saved = null")
        page.run("document.getElementById('screenshot').click()")
        page.wait("saved")
        size = page.run("createImageBitmap(saved).then(({ width, height }) => [width, height])")
        assert page.run("[saved.type, name.split('.').pop()]") == [f"image/{kind}", kind]
        assert size == page.run(f"[{times} * rnd.state.width, {times} * rnd.state.height]")


def test_a_phone_is_worked_by_thumb_and_finger(page, tmp_path):
    _screen(page, 390, 844, 2, touch=True)
    page.run(DRAWN)
    small = {name: side for name, side in page.run(TARGETS) if side < FINGER}
    assert not small, small
    assert page.run("document.getElementById('time').getBoundingClientRect().width") > 0.85 * 390
    before = page.run("({ ...rnd.state })")
    _touch(page, "touchStart", (150, 200), (250, 200))
    _touch(page, "touchMove", (100, 220), (300, 220))
    _touch(page, "touchEnd")
    page.run(DRAWN)
    after = page.run("({ ...rnd.state })")
    assert after["distance"] == pytest.approx(before["distance"] / 2, rel=0.05)
    assert after["target"][1] > before["target"][1] and after["azimuth"] == before["azimuth"]
    _touch(page, "touchStart", (150, 200))
    _touch(page, "touchMove", (200, 200))
    _touch(page, "touchEnd")
    assert page.run("rnd.state.azimuth") == pytest.approx(before["azimuth"] - 0.5)
    at = page.run("(({ left, top }) => [left + 9, top + 9])(document.getElementById('full').getBoundingClientRect())")
    _touch(page, "touchStart", at)  # a held finger is told what the control does
    page.wait("document.getElementById('message').textContent.startsWith('the image alone')")
    _touch(page, "touchCancel")


def test_the_sun_of_the_small_sphere_is_dragged(page):
    """It is where the light is brightest, follows the pointer on both sides of the sphere, and moves no camera."""
    sun = page.run("rnd.frame().then(({ sun }) => sun)")
    np.testing.assert_allclose(sun, brightest_direction(load_light(ASSETS / "sky.exr")), atol=1e-6)
    left, top, side = page.run("(({ left, top, width }) => [left, top, width])(gizmo.getBoundingClientRect())")
    for preset, sign in (("front", -1), ("back", 1)):  # the sun of the sky is in front of the body
        _click(page, f"[data-preset={preset}]")
        page.run(f"rnd.state.yaw = 0; {DRAWN}")
        before, view = page.run(SUN_COLUMN), page.run("[rnd.state.azimuth, rnd.state.distance]")
        page.drag((left + side / 2, top + side / 2), (10, 0))
        page.run(DRAWN)
        assert page.run("rnd.state.yaw") == pytest.approx(sign * 10 / (0.72 * side / 2))
        assert page.run(SUN_COLUMN) > before + 5 and page.run("[rnd.state.azimuth, rnd.state.distance]") == view
    _click(page, "#undo")
    assert page.run("rnd.state.yaw") == 0


def test_the_background_is_of_any_colour(page):
    change = """(id, value) => {
        document.getElementById(id).value = value;
        document.getElementById(id).dispatchEvent(new Event("input"));
    }"""
    chooser = "document.getElementById('colour').parentElement.hidden"
    assert page.run(chooser)
    page.run(f"({change})('background', 'colour'); ({change})('colour', '#336699'); {DRAWN}")
    assert page.run(CORNER) == [0x33, 0x66, 0x99] and not page.run(chooser)
    _click(page, "#share")
    address = page.run("location.href")
    page.open("about:blank")
    page.open(address)
    page.wait("window.rnd && rnd.scene()")
    page.run(DRAWN)
    assert page.run(CORNER) == [0x33, 0x66, 0x99] and not page.run(chooser)
    page.run(f"({change})('background', '#ffffff'); {DRAWN}")
    assert page.run(CORNER) == [255, 255, 255] and page.run(chooser)


def test_every_mode_says_what_it_is(page):
    modes = "[...document.querySelectorAll('#output button, .choices button, #shade option, #tone option')]"
    titles = page.run(f"{modes}.map(({{ title }}) => title)")
    assert len(titles) == 9 + 6 + 6 + 2 == len({*titles} - {""})
    page.run("rnd.state.shade = 'brute'; rnd.redraw()")
    page.wait("document.getElementById('shade').title.startsWith('every texel')")


def test_every_control_has_a_name(page):
    nameless = """[...document.querySelectorAll("button, select, input")]
        .filter((part) => !(part.matches("button") && part.textContent.trim()))
        .filter((part) => !part.ariaLabel && !part.labels?.length)
        .map(({ id }) => id)"""
    assert page.run(nameless) == []
