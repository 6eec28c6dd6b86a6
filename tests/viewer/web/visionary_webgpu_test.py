"""rnd-convert's clip for Visionary on WebGPU, where it is to run: the same numbers as on the CPU."""

from __future__ import annotations

import functools
import http.server
import json
import threading

import numpy as np
import onnxruntime as ort
import pytest

from rnd_viewer.convert.cli import main
from support.browser import CHROMIUM, chromium
from support.tiny import ASSETS

RUNTIME = ASSETS.parent / "viewer/web/node_modules/onnxruntime-web/dist"
SHOWN = 500  # numbers of each output that are compared
RUN = """(async () => {
  const ort = await import("/ort.webgpu.min.mjs");
  Object.assign(ort.env.wasm, { numThreads: 1, wasmPaths: "/" });
  const session = await ort.InferenceSession.create("/visionary.onnx", { executionProviders: ["webgpu"] });
  const made = await session.run({ time: new ort.Tensor("float32", [TIME], [1]) });
  return Object.values(made).map(({ data }) => Array.from(data.slice(-SHOWN)));
})()"""

pytestmark = [
    pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium"),
    pytest.mark.skipif(not RUNTIME.is_dir(), reason="needs npm ci in viewer/web"),
]


class _Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, format: str, *arguments: object) -> None:
        pass


def test_the_clip_runs_on_webgpu(tmp_path):
    inputs = [str(ASSETS / "avatar.onnx"), "--motion", str(ASSETS / "walk.npz")]
    site, time = tmp_path / "site", 1.5 / 30
    assert main(["splats", *inputs, "--frames", "10:12", "--format", "visionary", "--out", str(site)]) == 0
    for file in RUNTIME.iterdir():
        (site / file.name).symlink_to(file)
    (site / "index.html").write_text("<!doctype html><link rel=icon href=data:,><title>ready</title>")
    session = ort.InferenceSession(site / "visionary.onnx", providers=["CPUExecutionProvider"])
    expected = session.run(None, {"time": np.array([time], np.float32)})
    with (
        http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(_Quiet, directory=str(site))) as server,
        chromium(tmp_path / "profile", webgpu=True) as page,
    ):
        threading.Thread(target=server.serve_forever, daemon=True).start()
        page.open(f"http://127.0.0.1:{server.server_port}/")
        page.wait("document.title === 'ready'")
        if not page.run("navigator.gpu?.requestAdapter().then(Boolean)"):
            pytest.skip("this Chromium has no WebGPU")
        got = page.run(RUN.replace("TIME", json.dumps(time)).replace("SHOWN", str(SHOWN)))
        server.shutdown()
    for ours, theirs in zip(expected, got, strict=True):
        assert (ours.ravel()[-SHOWN:] == np.array(theirs, ours.dtype)).all()
