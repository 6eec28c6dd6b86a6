"""rnd-view's server: what it answers, whom it refuses, and that its frames are rnd-play's."""

from __future__ import annotations

import errno
import http.client
import json
import os
import re
import socket
import sys
import threading
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from time import perf_counter, sleep
from typing import Any
from urllib.parse import urlsplit

import av
import numba
import numpy as np
import pytest
from PIL import Image
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

import rnd_viewer.view.cli
import rnd_viewer.view.scene
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.images import write_image
from rnd_runtime.core.kernels import COMPILING
from rnd_runtime.ground.standing import ground_of
from rnd_runtime.motion.edit import MotionEdits, edit_motion
from rnd_runtime.motion.motion import load_motion, save_motion
from rnd_runtime.playback.frame import FrameRenderer
from rnd_runtime.playback.framing import CameraOptions, frame_motion, front_path
from rnd_runtime.shading.files.load import load_light
from rnd_viewer.inputs.background import Background
from rnd_viewer.inputs.options import MotionOptions
from rnd_viewer.view.access import is_loopback
from rnd_viewer.view.cli import main
from rnd_viewer.view.options import ViewOptions
from rnd_viewer.view.scene import Scene
from rnd_viewer.view.server import serve
from support.play_fakes import FakeAvatar, fake_motion
from support.tiny import ASSETS
from support.view_process import running

TOKEN = "s3cret"
SIZE = 64
FRAMES = 6
STALLING = 1536  # pixels square: two such pictures are more than the system's buffers hold
LONGEST_END_S = 8  # on a busy machine; websockets gives a page ten seconds to ask for something
# JPEG of quality 90 halves the chroma: dark and light neighbours of different colours differ by this many levels.
JPEG_MEAN_ERROR = 4


class CountedAvatar(FakeAvatar):
    """A fake that says how large it is."""

    gaussians = 24 * 120


def has_ipv6_loopback() -> bool:
    try:
        with socket.socket(socket.AF_INET6) as listener:
            listener.bind(("::1", 0))
    except OSError:
        return False
    return True


@pytest.fixture
def options(tmp_path, monkeypatch) -> ViewOptions:
    monkeypatch.setattr(rnd_viewer.view.scene.Avatar, "load", lambda path, **_: CountedAvatar())
    save_motion(tmp_path / "walk.npz", fake_motion(FRAMES))
    sky = np.random.default_rng(0).uniform(0.2, 1, (16, 32, 3)).astype(np.float32)
    sky[5, 9] = 200  # a sun
    write_image(tmp_path / "sky.exr", sky)
    return ViewOptions(
        Path("avatar.onnx"), tmp_path / "walk.npz", (tmp_path / "sky.exr",), size=(SIZE, None), raster="cpu"
    )


@contextmanager
def _running(shown: Scene, fps_floor: float | None = None) -> Iterator[int]:
    with serve(shown, "127.0.0.1", 0, TOKEN, fps_floor) as (server, _):
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield server.port
        finally:
            server.shutdown()
            thread.join()


@contextmanager
def _serving(options: ViewOptions) -> Iterator[tuple[int, Scene]]:
    scene = Scene(options)
    with _running(scene) as port:
        yield port, scene
    scene.close()


class Visitor:
    """A page without a browser."""

    def __init__(self, socket: Any) -> None:
        self.socket = socket
        self.scene = json.loads(socket.recv())["scene"]

    def state(self, **changes: Any) -> dict[str, Any]:
        return {"time": 0.0, "width": SIZE, "height": SIZE, "light": 1} | self.scene["view"] | changes

    def ask(self, **request: Any) -> dict[str, Any]:
        self.socket.send(json.dumps(request))
        return json.loads(self.socket.recv())

    def frame(self, **changes: Any) -> np.ndarray:
        """[H, W, 3] of the state with ``changes``."""
        header = self.ask(ask="render", number=7, state=self.state(**changes))
        assert header["kind"] == "frame" and header["number"] == 7, header
        data = self.socket.recv()
        if header["encoding"] == "jpeg":
            return np.asarray(Image.open(BytesIO(data)))
        rgba = np.frombuffer(data, np.uint8).reshape(header["height"], header["width"], 4)
        assert (rgba[..., 3] == 255).all()
        return rgba[..., :3]


@contextmanager
def _visiting(port: int, token: str = TOKEN, **headers: Any) -> Iterator[Visitor]:
    url = f"ws://127.0.0.1:{port}/socket?token={token}"
    with connect(url, max_size=None, compression=None, **headers) as socket:
        yield Visitor(socket)


def _played(options: ViewOptions, time: float, **changes: Any) -> np.ndarray:
    """What rnd-play draws in its first view."""
    avatar = FakeAvatar()
    motion = load_motion(options.motion, avatar.skeleton)
    turn = {"yaw": changes.pop("yaw", 0.0), "exposure": changes.pop("exposure", 0.0)}
    light = load_light(options.hdr[0], up=options.hdr_up, **turn)
    shade = changes.pop("shade", "table+sun")
    view = CameraOptions(SIZE, SIZE, np.radians(35), np.radians(5))
    camera = front_path(frame_motion(avatar.skeleton, motion), view)(0, time)
    renderer = FrameRenderer(avatar, light, shade=shade, tone=changes.pop("tone", "srgb"))
    renderer.ground = ground_of(avatar, motion) if changes.pop("ground", False) else None
    frame = renderer.render(motion, time, camera)
    background = changes.pop("background", None)
    return (frame if background is None else replace(frame, background=background.radiance(camera, light))).srgb


def test_the_first_view_is_rnd_plays_to_the_bit(options):
    with _serving(options) as (port, _), _visiting(port) as visitor:
        for time in (0.0, 0.1):
            assert (visitor.frame(time=time) == _played(options, time)).all()
        hdr = visitor.frame(background="hdr", yaw=0.7, shade="table")
        expected = _played(options, 0.0, yaw=0.7, shade="table", background=Background("hdr"))
        assert (hdr == expected).all()
        bright = visitor.frame(exposure=1.3)
        # the light is scaled before or after shading: float32 rounds differently
        assert np.abs(bright.astype(int) - _played(options, 0.0, exposure=1.3)).max() <= 1
        assert np.abs(bright.astype(int) - visitor.frame()).max() > 20
        assert (visitor.frame(tone="neutral") == _played(options, 0.0, tone="neutral")).all()


def test_the_ground_has_rnd_plays_shadow(options):
    with _serving(options) as (port, _), _visiting(port) as visitor:
        assert visitor.scene["ground"]
        look = {"background": "hdr", "yaw": 0.7, "shade": "table"}
        clear, shadowed = (visitor.frame(**look, ground=ground) for ground in (False, True))
        expected = _played(options, 0.0, ground=True, yaw=0.7, shade="table", background=Background("hdr"))
        assert (shadowed == expected).all() and (shadowed <= clear).all() and (shadowed < clear).mean() > 0.02
        assert (visitor.frame(ground=True) == visitor.frame()).all()  # on black


def test_a_probe_made_for_a_z_up_world_lights_as_rnd_play_has_it(options):
    turned = replace(options, hdr_up="z")
    with _serving(turned) as (port, _), _visiting(port) as visitor:
        assert (visitor.frame() == _played(turned, 0.0)).all()
    assert (_played(turned, 0.0) != _played(options, 0.0)).any()
    with pytest.raises(InputError, match=r"--hdr-up: .* \(needs --hdr\)"):
        replace(turned, hdr=())


def test_every_output_fewer_gaussians_and_jpeg(options):
    with _serving(options) as (port, scene), _visiting(port) as visitor:
        pictures = {
            name: visitor.frame(output=name) for name in ("lit", "light", "albedo", "normal", "roughness", "visibility")
        }
        body = pictures["normal"].any(-1)
        assert 0.1 < body.mean() < 0.6
        assert np.isin(pictures["roughness"][body], (127, 128)).all()  # 0.5, over the whole body
        assert (pictures["visibility"][body] == 255).all()
        assert len({picture.tobytes() for picture in pictures.values()}) == 6
        for channel, albedo in enumerate((0.6, 0.4, 0.2)):
            srgb = round(255 * (1.055 * albedo ** (1 / 2.4) - 0.055))
            assert abs(int(pictures["albedo"][..., channel].max()) - srgb) <= 1
        half = visitor.frame(gaussians=scene.avatar.gaussians // 2)
        assert half.any() and (half != pictures["lit"]).any()
        smooth = visitor.frame(encoding="jpeg")
        assert np.abs(smooth.astype(int) - pictures["lit"]).mean() < JPEG_MEAN_ERROR


def test_the_clip_has_every_frame(options):
    with _serving(options) as (port, scene), _visiting(port) as visitor:
        header = visitor.ask(ask="clip", state=visitor.state(), fps=30, turn=6.28)
        seen = 0
        while header["kind"] == "progress":
            seen, header = header["done"], json.loads(visitor.socket.recv())
        assert header["kind"] == "clip" and seen == scene.motion.frames_at(30) == FRAMES
        with av.open(BytesIO(visitor.socket.recv())) as container:
            frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
        assert len(frames) == FRAMES and frames[0].shape == (SIZE, SIZE, 3)
        assert np.abs(frames[0].astype(int) - frames[3]).max() > 50  # the camera has turned


def test_a_clip_that_the_disk_has_no_space_for_is_one_line(options, monkeypatch):
    def full(file, fps):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(file))

    monkeypatch.setattr(rnd_viewer.view.server, "clip_writer", full)
    with _serving(options) as (port, _), _visiting(port) as visitor:
        answer = visitor.ask(ask="clip", state=visitor.state(), fps=30)
        assert answer["kind"] == "error" and answer["message"].endswith("clip.mp4: No space left on device")
        assert visitor.frame().any()  # and the connection lives


def test_however_much_is_asked_meanwhile_the_page_is_not_taken_for_gone(options, monkeypatch):
    """What the server does not hear behind other messages, the answers to its own pings too."""
    drawn, original = threading.Event(), Scene.render
    monkeypatch.setattr(Scene, "render", lambda scene, state: drawn.wait() and original(scene, state))
    with _serving(options) as (port, _), _visiting(port) as visitor:
        visitor.socket.send(json.dumps({"ask": "render", "number": 1, "state": visitor.state()}))
        for _ in range(40):
            visitor.socket.send(json.dumps({"ask": "truth", "index": 0}))
        sleep(0.3)  # or the ping comes in one piece with them
        heard = visitor.socket.ping().wait(timeout=5)
        drawn.set()
        for _ in range(42):
            visitor.socket.recv()
        assert heard


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"width": 10**6}, "width"),
        ({"light": 9}, "light: expected 0 to 1, got 9"),
        ({"shade": "magic"}, "shading mode"),
        ({"truth": 0}, "--capture"),
        ({"background": "#12"}, "--background"),
        ({"distance": -1}, "distance"),
        ({"speed": 1}, "speed"),
        ({"target": [0, float("nan"), 0]}, "malformed"),
    ],
)
def test_a_request_that_makes_no_sense_is_answered_with_one_line(options, changes, reason):
    with _serving(options) as (port, _), _visiting(port) as visitor:
        answer = visitor.ask(ask="render", number=1, state=visitor.state(**changes))
        assert answer["kind"] == "error" and reason in answer["message"] and "\n" not in answer["message"]
        assert visitor.frame().any()  # and the connection lives


def _knock(port: int, **headers: Any) -> None:
    with _visiting(port, **headers):
        pass


def _get(port: int, path: str, token: str = TOKEN, **headers: str) -> tuple[int, bytes, dict[str, str]]:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    connection.request("GET", path, headers={"Cookie": f"rnd_view_token_{port}={token}"} | headers)
    response = connection.getresponse()
    result = response.status, response.read(), dict(response.getheaders())
    connection.close()
    return result


def test_static_files_and_nothing_else(options):
    with _serving(options) as (port, _):
        status, body, headers = _get(port, "/")
        assert status == 200 and b'src="app.js"' in body and headers["Content-Type"].startswith("text/html")
        assert "default-src 'self'" in headers["Content-Security-Policy"]
        assert _get(port, "/app.js")[0] == 200
        for path in ("/../view_server.py", "/%2e%2e/view_server.py", "/etc/passwd", "/page", "/nothing.js"):
            assert _get(port, path)[0] == 404, path


def test_on_loopback_other_names_and_other_sites_are_refused(options):
    with _serving(options) as (port, _):
        assert _get(port, "/", Host=f"localhost:{port}")[0] == 200
        for host in ("evil.example", f"evil.example:{port}", "127.0.0.1", ""):  # DNS rebinding
            assert _get(port, "/", Host=host)[0] == 403, host
        with _visiting(port, origin=f"http://127.0.0.1:{port}") as visitor:
            assert visitor.scene["gaussians"] == CountedAvatar.gaussians
        for origin in ("http://evil.example", "http://127.0.0.1:1", "null"):
            with pytest.raises(InvalidStatus, match="403"):
                _knock(port, origin=origin)


def test_what_is_no_request_is_answered_as_such(options):
    with _serving(options) as (port, _):
        assert _get(port, "//[")[0] == 400
        assert _get(port, "/", Origin="http://[")[0] == 400
        with socket.create_connection(("127.0.0.1", port), timeout=10) as knocking:
            knocking.sendall(b"GET / HTTP/1.1\r\nHost: a\r\nHost: b\r\n\r\n")
            assert knocking.recv(1000).startswith(b"HTTP/1.1 400 ")


def test_what_fails_before_anything_is_served_ends_it(options):
    """As a pipe that nobody reads does to the line with the address."""
    ended = []

    def failing() -> None:
        with pytest.raises(BrokenPipeError), serve(Scene(options), "127.0.0.1", 0, TOKEN):
            raise BrokenPipeError
        ended.append(True)

    thread = threading.Thread(target=failing, daemon=True)
    thread.start()
    thread.join(timeout=30)
    assert ended


def test_ctrl_c_ends_it_though_a_page_reads_no_more_and_another_never_asked():
    with ExitStack() as pages:
        with running(str(ASSETS / "avatar.onnx"), "--size", "64") as address:
            place = urlsplit(address)
            pages.enter_context(socket.create_connection((place.hostname, place.port)))
            url = place._replace(scheme="ws", path="/socket").geturl()
            frozen = pages.enter_context(connect(url, max_size=None, max_queue=1, close_timeout=1))
            state = Visitor(frozen).state(light=0, width=STALLING, height=STALLING, output="albedo")
            for number in range(4):
                frozen.send(json.dumps({"ask": "render", "number": number, "state": state}))
            sleep(3)  # until the buffers in between are full
            asked = perf_counter()
        assert perf_counter() - asked < LONGEST_END_S


@pytest.mark.skipif(not has_ipv6_loopback(), reason="this machine has no ::1")
def test_an_ipv6_address_serves(options):
    with serve(Scene(options), "::1", 0, TOKEN) as (server, url):
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            assert url.startswith("http://[::1]:")
            with urllib.request.urlopen(url, timeout=10) as page:
                assert page.status == 200
        finally:
            server.shutdown()
            thread.join()


def test_threads_hold_for_every_visitor(options, monkeypatch):
    counts = []
    original = Scene.render
    monkeypatch.setattr(
        Scene, "render", lambda scene, state: counts.append(numba.get_num_threads()) or original(scene, state)
    )
    with _serving(replace(options, threads=1)) as (port, _):
        for _ in range(2):
            with _visiting(port) as visitor:
                visitor.frame()
    assert counts == [1, 1]


def test_a_token_is_asked_for_everywhere(options):
    with _serving(options) as (port, _):
        for path in ("/", "/app.js", "/?token=wrong", "/?token=", "/socket"):
            assert _get(port, path, token="")[0] == 401, path
        with pytest.raises(InvalidStatus, match="401"):
            _knock(port, token="wrong")
        status, _, headers = _get(port, f"/?token={TOKEN}", token="")
        cookie = headers["Set-Cookie"]
        assert status == 200 and "HttpOnly" in cookie and "SameSite=Strict" in cookie
        given = {"Cookie": f'a b=1; json={{"x": [1]}}; {cookie.split(";")[0]}; other=2'}  # beside other programs'
        assert _get(port, "/app.js", **given)[0] == 200
        with _visiting(port, token="", additional_headers=given) as visitor:
            assert visitor.frame().any()
        with pytest.raises(InvalidStatus, match="403"):
            _knock(port, additional_headers=given, origin="http://evil.example")


@pytest.mark.parametrize("host", ["127.0.0.1", "0.0.0.0"])
def test_the_address_that_is_printed_holds_the_token(host):
    with running(str(ASSETS / "avatar.onnx"), "--host", host, "--size", "64") as address:
        name, port, token = re.fullmatch(r"http://(.+):(\d+)/\?token=(.+)", address).groups()
        assert name != "0.0.0.0" and len(token) > 20  # which no other machine can open
        for path in ("/", "/app.js", "/socket", f"/?token={token[:-1]}"):
            assert _get(int(port), path)[0] == 401, path
        assert _get(int(port), f"/?token={token}")[0] == 200


def test_without_motion_or_light_the_avatar_stands_in_its_own(options):
    bare = ViewOptions(Path("avatar.onnx"), size=(SIZE, None), raster="cpu")
    with _serving(bare) as (port, _), _visiting(port) as visitor:
        assert visitor.scene["motion"]["duration"] == 0 and visitor.scene["light"] == 0
        assert visitor.frame(light=0).any()


def test_a_note_on_the_light_comes_with_its_frames(options, tmp_path):
    broken = np.ones((16, 32, 3), np.float32)
    broken[3, 4] = np.nan
    write_image(tmp_path / "nan.exr", broken)
    with _serving(replace(options, hdr=(*options.hdr, tmp_path / "nan.exr"))) as (port, _), _visiting(port) as visitor:
        for light, noted in ((1, False), (2, True)):
            header = visitor.ask(ask="render", number=1, state=visitor.state(light=light))
            assert any("NaN" in note for note in header["notes"]) == noted
            visitor.socket.recv()


def test_live_frames_get_smaller_to_hold_the_frame_rate_and_exact_ones_do_not(options):
    scene = Scene(replace(options, size=(2 * SIZE, None)))
    with _running(scene, fps_floor=1000.0) as port, _visiting(port) as visitor:

        def width(live: bool) -> int:
            state = visitor.state(width=2 * SIZE, height=2 * SIZE)
            header = visitor.ask(ask="render", number=1, live=live, state=state)
            visitor.socket.recv()
            return header["width"]

        assert [width(True) for _ in range(12)][-1] == SIZE
        assert width(False) == 2 * SIZE
    scene.close()


def test_the_motion_is_edited_as_rnd_play_does(options):
    edits = MotionEdits(speed=2.0, in_place=True)
    scene = Scene(replace(options, reading=MotionOptions(speed=edits.speed, in_place=edits.in_place)))
    untouched = load_motion(options.motion, scene.avatar.skeleton)
    expected = edit_motion(untouched, edits)
    assert scene.motion.duration == expected.duration < untouched.duration
    assert (scene.motion.translations == expected.translations).all()
    scene.close()


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"reading": MotionOptions(motion_up="z")}, "--motion-up"),
        ({"reading": MotionOptions(joint_map=Path("t.toml"))}, "--joint-map"),
        ({"reading": MotionOptions(loop=True)}, "--loop"),
        ({"capture": Path("b"), "reading": MotionOptions(motion_up="z")}, "--motion-up"),
        ({"port": 99999}, "--port"),
        ({"size": (8, None)}, "--size"),
        ({"fps_floor": 0}, "--fps-floor"),
    ],
)
def test_options_that_do_nothing_or_make_no_sense_are_refused(changes, line):
    with pytest.raises(InputError, match=line):
        ViewOptions(Path("avatar.onnx"), **changes)


def test_refusals_of_the_command(options, capsys, tmp_path, monkeypatch):
    assert is_loopback(ViewOptions(Path("a")).host) and is_loopback("::1") and not is_loopback("0.0.0.0")
    assert main(["avatar.onnx", "--motion", str(tmp_path / "none.npz")]) == 2
    monkeypatch.setattr(rnd_viewer.view.cli, "kernels_are_cold", lambda: True)
    with _serving(options) as (port, _):
        assert main(["avatar.onnx", "--port", str(port), "--no-browser"]) == 2
    errors = capsys.readouterr().err.splitlines()
    assert len(errors) == 3 and errors[1] == f"rnd-view: {COMPILING}" and "--port picks another" in errors[2]
    monkeypatch.setitem(sys.modules, "websockets", None)
    assert main(["avatar.onnx"]) == 2
    assert "rnd-avatar[view]" in capsys.readouterr().err


def test_an_address_of_another_machine_is_not_blamed_on_the_port(options):
    with pytest.raises(InputError, match="--host"), serve(Scene(options), "192.0.2.1", 0, "token"):
        pass
