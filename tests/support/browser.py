"""Headless Chromium, driven by its devtools protocol: just what the tests of the pages need."""

from __future__ import annotations

import base64
import itertools
import json
import shutil
import subprocess
import threading
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from websockets.sync.client import connect

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
PATIENCE = 60  # s; two cores may be busy with other things


class LeftPage(AssertionError):
    """The tab went to another page before it answered."""


class Page:
    """One tab."""

    def __init__(self, socket: Any) -> None:
        self._socket = socket
        self._numbers = itertools.count(1)
        self.messages: list[str] = []  # what the page complained of
        for domain in ("Page", "Runtime", "Log"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """One devtools command and its result."""
        number = next(self._numbers)
        self._socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            message = json.loads(self._socket.recv(timeout=PATIENCE))
            if message.get("id") == number:
                if "navigated" in message.get("error", {}).get("message", ""):
                    raise LeftPage(message)
                assert "error" not in message, message
                return message["result"]
            self._note(message)

    def _note(self, message: dict[str, Any]) -> None:
        method, parameters = message.get("method"), message.get("params", {})
        if method == "Runtime.exceptionThrown":
            self.messages.append(parameters["exceptionDetails"]["exception"].get("description", "?"))
        elif method == "Log.entryAdded" and parameters["entry"]["level"] == "error":
            self.messages.append(parameters["entry"]["text"])

    def open(self, url: str) -> None:
        self.call("Page.navigate", url=url)

    def run(self, expression: str) -> Any:
        """The value of a JavaScript expression; a promise is awaited."""
        result = self.call(
            "Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True, userGesture=True
        )
        assert "exceptionDetails" not in result, result["exceptionDetails"]
        return result["result"].get("value")

    def wait(self, condition: str) -> None:
        """Until the JavaScript ``condition`` holds."""
        until = time.monotonic() + PATIENCE
        while not self._holds(condition):
            assert time.monotonic() < until, (condition, self.messages)
            time.sleep(0.05)

    def _holds(self, condition: str) -> bool:
        try:
            return bool(self.run(f"Boolean({condition})"))
        except LeftPage:
            return False

    def screenshot(self, path: Path) -> None:
        path.write_bytes(base64.b64decode(self.call("Page.captureScreenshot")["data"]))

    def press(self, code: str) -> None:
        """Press and release a key named by its place on the keyboard, such as ``KeyR``."""
        for kind in ("keyDown", "keyUp"):
            self.call("Input.dispatchKeyEvent", type=kind, code=code)

    def drop(self, path: Path) -> None:
        """Drop a file or a folder of this machine on the middle of the page."""
        data = {"items": [], "files": [str(path)], "dragOperationsMask": 1}
        for kind in ("dragEnter", "dragOver", "drop"):
            self.call("Input.dispatchDragEvent", type=kind, x=300, y=300, data=data)

    def drag(self, start: tuple[float, float], by: tuple[float, float], *, shift: bool = False) -> None:
        """Drag with the left button."""
        end = (start[0] + by[0], start[1] + by[1])
        for kind, (x, y) in (("mousePressed", start), ("mouseMoved", end), ("mouseReleased", end)):
            self.call(
                "Input.dispatchMouseEvent",
                type=kind,
                x=x,
                y=y,
                button="left",
                buttons=1,
                clickCount=1,
                modifiers=8 if shift else 0,
            )


@contextmanager
def chromium(
    profile: Path, *, size: tuple[int, int] = (1100, 720), webgl: bool = False, webgpu: bool = False
) -> Iterator[Page]:
    """A fresh browser with one tab and no GPU; with ``webgl`` and ``webgpu``, SwiftShader stands in for one."""
    assert CHROMIUM is not None
    options = [
        *("--headless=new", "--no-sandbox", "--no-first-run", "--disable-background-networking"),
        *("--disable-component-update", "--hide-scrollbars", "--disable-dev-shm-usage", "--mute-audio"),
        "--force-prefers-reduced-motion",  # or a motion would play from the start
        *(("--use-angle=swiftshader", "--enable-unsafe-swiftshader") if webgl else ("--disable-gpu",)),
        *(("--enable-unsafe-webgpu", "--use-webgpu-adapter=swiftshader") if webgpu else ()),
        *(f"--user-data-dir={profile}", f"--window-size={size[0]},{size[1]}", "--remote-debugging-port=0"),
    ]
    process = subprocess.Popen(
        [CHROMIUM, *options, "about:blank"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        port = _port(profile / "DevToolsActivePort", process)
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json", timeout=PATIENCE) as answer:
            tabs = [tab for tab in json.load(answer) if tab["type"] == "page"]
        with connect(tabs[0]["webSocketDebuggerUrl"], max_size=None, compression=None) as socket:
            page = Page(socket)
            screen = {"width": size[0], "height": size[1], "deviceScaleFactor": 1, "mobile": False}
            page.call("Emulation.setDeviceMetricsOverride", **screen)
            yield page
    finally:
        process.terminate()
        process.wait(timeout=PATIENCE)


def _port(file: Path, process: subprocess.Popen[bytes]) -> int:
    until = time.monotonic() + PATIENCE
    while not (file.is_file() and (text := file.read_text())):
        assert process.poll() is None and time.monotonic() < until, "Chromium did not start"
        time.sleep(0.05)
    return int(text.split()[0])


@contextmanager
def answering(server: Any) -> Iterator[None]:
    """Requests to ``server`` are answered in a thread of its own, to the end of the context."""
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield
    finally:
        server.shutdown()
        thread.join()
