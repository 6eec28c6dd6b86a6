"""The page and its websocket on one port, for this machine alone by default."""

from __future__ import annotations

import json
import logging
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from errno import EACCES, EADDRINUSE
from http import HTTPStatus
from importlib import resources
from io import BytesIO
from pathlib import Path
from socket import AF_INET, AF_INET6, SOCK_DGRAM, gethostname, socket
from time import perf_counter
from types import ModuleType
from typing import Any
from urllib.parse import urlsplit

import numpy as np
from msgspec.structs import replace

from rnd_runtime.cli.extras import need_packages
from rnd_runtime.core.errors import InputError, withheld
from rnd_runtime.core.signals import temporary_folder
from rnd_runtime.core.threads import set_threads
from rnd_viewer.play.video import clip_writer

from .access import HTTP_PORT, Access
from .governor import ResolutionController
from .listener import Listener, connection_limit
from .options import SIZES
from .scene import Bytes, Scene
from .state import MAX_CLIP_FRAMES, ClipRequest, RenderRequest, Request, parse_request
from .training import Training

JPEG_QUALITY = 90
_ALL_ADDRESSES = {"0.0.0.0": "192.0.2.1", "::": "2001:db8::1"}  # and one of another network
MAX_BYTES_IN = 1 << 14  # a request is a few hundred
MAX_WAITING = 256  # requests of one page; it sends the next after an answer
HANDSHAKE_S = 5  # from connecting to the last header
CLOSE_S = 10  # from the first byte of a file, or of a goodbye, to the end of the connection
GOODBYE_S = 1.0  # in which a page that still reads hears that the viewer ends
CONTENT_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".svg": "image/svg+xml",
    ".png": "image/png",
    ".json": "application/json",
}
# Nothing from elsewhere runs in the page, and nobody frames it.
HEADERS = {
    "Content-Security-Policy": "default-src 'self'; img-src 'self' blob: data:; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}


def load_websockets() -> ModuleType:
    """Import websockets' server or say which extra brings it."""
    need_packages("view", "websockets")
    import websockets.sync.server

    return websockets.sync.server


@contextmanager
def serve(
    shown: Scene | Training, host: str, port: int, token: str, fps_floor: float | None = None
) -> Iterator[tuple[Listener, str]]:
    """Yield a listening server, to be run by its ``serve_forever``, and the URL to open, which holds ``token``.

    A ``Training`` has its own page at the address; the avatar's is ``index.html`` then.

    Raises:
        InputError: websockets is missing, or nothing can listen there.
    """
    server_module = load_websockets()
    visitor = _Visitor(shown, fps_floor)
    training = shown if isinstance(shown, Training) else None

    class Connection(server_module.ServerConnection):  # type: ignore[name-defined]
        def process_event(self, event: Any) -> None:
            if self.recv_messages.frames.qsize() >= MAX_WAITING:
                raise ConnectionError("too many requests wait")  # which ends the connection
            super().process_event(event)

    def answer(connection: Any, request: Any) -> Any:
        refusal = access.refusal(request.path, request.headers)
        if refusal is not None:
            return connection.respond(*refusal)
        listener.recognise(connection.socket)
        path = urlsplit(request.path).path
        if path != "/socket":
            return _answer_http(connection, path, access, training)
        full = HTTPStatus.SERVICE_UNAVAILABLE, "too many pages are open\n"
        return None if listener.admit_page(connection.socket) else connection.respond(*full)

    try:
        server = server_module.serve(
            visitor.talk,
            host,
            port,
            process_request=answer,
            compression=None,
            open_timeout=HANDSHAKE_S,
            close_timeout=CLOSE_S,
            max_size=MAX_BYTES_IN,
            max_queue=None,  # behind a full queue pings wait too, and the page is taken for gone
            create_connection=Connection,
            server_header=None,
            logger=_quiet_logger(),
            family=AF_INET6 if ":" in host else AF_INET,
        )
    except OSError as error:
        taken = error.errno in (EADDRINUSE, EACCES)
        hint = "--port picks another" if taken else "--host takes an address of this machine"
        raise InputError("cannot listen", got=f"{error.strerror} on {host}:{port}", hint=hint) from error
    listener = Listener(server, connection_limit())
    try:
        access = Access.of(host, listener.port, token)
        yield listener, f"http://{_name_from_elsewhere(host)}:{listener.port}/?token={token}"
    finally:
        hanging_up = threading.Timer(GOODBYE_S, listener.hang_up)
        hanging_up.start()
        listener.shutdown()
        hanging_up.cancel()


def _name_from_elsewhere(host: str) -> str:
    """What stands for ``host`` in an address; where that is all of this machine's addresses, one of them."""
    family = AF_INET6 if ":" in host else AF_INET
    if host in _ALL_ADDRESSES:
        with socket(family, SOCK_DGRAM) as unused:
            try:
                # nothing is sent: it only picks our own address
                unused.connect((_ALL_ADDRESSES[host], HTTP_PORT))
                host = unused.getsockname()[0]
            except OSError:  # no network
                host = gethostname()
    return f"[{host}]" if ":" in host else host


def _answer_http(connection: Any, path: str, access: Access, training: Training | None) -> Any:
    """A file of the page, or what a training has to show."""
    folder = resources.files(__package__) / "page"
    name = path.removeprefix("/") or ("training.html" if training else "index.html")
    content: bytes | None = None
    if training and name == "training.json":
        content = json.dumps(training.state()).encode()
    elif training and name.startswith("previews/"):
        content = training.preview(name.removeprefix("previews/"))
    elif name in {file.name for file in folder.iterdir()}:
        content = (folder / name).read_bytes()
    suffix = Path(name).suffix
    if content is None or suffix not in CONTENT_TYPES:
        return connection.respond(HTTPStatus.NOT_FOUND, "no such file\n")
    response = connection.respond(HTTPStatus.OK, "")
    response.body = content
    del response.headers["Content-Length"], response.headers["Content-Type"]
    response.headers["Content-Length"] = str(len(content))
    response.headers["Content-Type"] = CONTENT_TYPES[suffix]
    for header, value in HEADERS.items():
        response.headers[header] = value
    response.headers["Set-Cookie"] = access.set_cookie()
    return response


def _quiet_logger() -> logging.Logger:
    """websockets reports every connection that breaks; only our own mistakes are worth a traceback."""
    logger = logging.getLogger("rnd_viewer.websockets")
    logger.setLevel(logging.ERROR)
    logger.filters = [lambda record: record.msg == "connection handler failed"]
    return logger


class _Visitor:
    """Answers pages; several may look at one scene, which renders for one at a time."""

    def __init__(self, shown: Scene | Training, fps_floor: float | None) -> None:
        self._shown, self._fps_floor = shown, fps_floor
        self._rendering = threading.Lock()

    def talk(self, socket: Any) -> None:
        """Serve one websocket until it closes. A request that cannot be met is answered with the reason."""
        from websockets.exceptions import ConnectionClosed

        with suppress(ConnectionClosed):  # while a frame was on its way
            try:
                scene = self._shown.scene() if isinstance(self._shown, Training) else self._shown
            except InputError as error:
                self._send(socket, {"kind": "error", "message": str(error)})
                return
            set_threads(scene.threads)  # per thread, and each visitor has one
            governor = None if self._fps_floor is None else ResolutionController(self._fps_floor)
            self._send(socket, {"kind": "scene", "scene": scene.description()})
            for message in socket:
                try:
                    self._answer(socket, scene, governor, parse_request(message))
                except InputError as error:
                    self._send(socket, {"kind": "error", "message": str(error)})
                except OSError as error:
                    if (reason := withheld(error)) is None:
                        raise
                    self._send(socket, {"kind": "error", "message": reason})

    def _answer(self, socket: Any, scene: Scene, governor: ResolutionController | None, request: Request) -> None:
        if isinstance(request, RenderRequest):
            self._render(socket, scene, governor if request.live else None, request)
        elif isinstance(request, ClipRequest):
            self._clip(socket, scene, request)
        else:
            data = scene.truth_file(request.index).read_bytes()
            self._send(socket, {"kind": "truth", "index": request.index}, data)

    def _render(self, socket: Any, scene: Scene, governor: ResolutionController | None, request: RenderRequest) -> None:
        state, started = request.state, perf_counter()
        if governor:
            width, height = (max(round(governor.scale * side), SIZES[0]) for side in (state.width, state.height))
            state = replace(state, width=width, height=height)
        with self._rendering:
            view = scene.render(state)
            notes, sun = scene.notes_of_light(state), scene.sun_of_light(state)
        pixels, encoding_ms = encode(view.srgb, state.encoding)
        header = {
            "kind": "frame",
            "number": request.number,
            "width": view.srgb.shape[1],
            "height": view.srgb.shape[0],
            "encoding": state.encoding,
            "joints": view.joints.astype(np.float64).round(2).tolist(),
            "notes": notes,
            "sun": sun,
            "times": {name: 1e3 * seconds for name, seconds in view.seconds.items()} | {"encoding": encoding_ms},
        }
        self._send(socket, header, pixels)
        if governor:
            governor.observe(perf_counter() - started)

    def _clip(self, socket: Any, scene: Scene, request: ClipRequest) -> None:
        state, frames = replace(request.state, truth=None), scene.frames_at(request.fps)
        if frames > MAX_CLIP_FRAMES:
            raise InputError("clip", expected=f"at most {MAX_CLIP_FRAMES} frames", got=frames)
        with temporary_folder() as folder:
            file = folder / "clip.mp4"
            with clip_writer(file, fps=request.fps) as append:
                for number in range(frames):
                    azimuth = state.azimuth + request.turn * number / frames
                    now = replace(state, time=number / request.fps, azimuth=azimuth)
                    with self._rendering:
                        append(np.ascontiguousarray(scene.render(now).srgb))
                    self._send(socket, {"kind": "progress", "done": number + 1, "of": frames})
            notes = scene.motion.loop_notes(request.fps)
            self._send(socket, {"kind": "clip", "notes": notes}, file.read_bytes())

    @staticmethod
    def _send(socket: Any, header: dict[str, Any], body: bytes | Bytes | None = None) -> None:
        """A header as JSON text; what it announces follows in a binary message of its own."""
        socket.send(json.dumps(header))
        if body is not None:
            socket.send(body if isinstance(body, bytes) else body.data.cast("B"))


def encode(srgb: Bytes, encoding: str) -> tuple[bytes | Bytes, float]:
    """The pixels [H, W, 3] as ``raw`` RGBA [H, W, 4] or as ``jpeg``, and the milliseconds that took."""
    started = perf_counter()
    data: bytes | Bytes
    if encoding == "jpeg":
        data = _jpeg(srgb)
    else:
        data = np.full((*srgb.shape[:2], 4), 255, np.uint8)
        data[..., :3] = srgb
    return data, 1e3 * (perf_counter() - started)


def _jpeg(srgb: Bytes) -> bytes:
    need_packages("view", "PIL", what="JPEG needs")
    from PIL import Image

    stream = BytesIO()
    Image.fromarray(srgb).save(stream, "jpeg", quality=JPEG_QUALITY)
    return stream.getvalue()
