"""How fast the two pages draw in headless Chromium: rnd-view with raw and JPEG pixels, and the page without a server.

python scripts/bench_pages.py [AVATAR.onnx] [--json assets/bench/pages.json]

Chromium paints on the CPU here, beside the renderer; a machine with a GPU has the cores to itself.
"""

from __future__ import annotations

import argparse
import functools
import http.server
import json
import os
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parent.parent
ASSETS, DIST = ROOT / "assets", ROOT / "viewer/web/dist"
sys.path.insert(0, str(ROOT / "tests"))

from browser import Page, chromium  # noqa: E402

from rnd_runtime.playback.doctor import machine  # noqa: E402
from rnd_viewer.view.options import ViewOptions  # noqa: E402
from rnd_viewer.view.scene import Scene  # noqa: E402
from rnd_viewer.view.server import serve  # noqa: E402

SIZE, PLAYED_S, ONE_BY_ONE = 512, 6, 30

# Pictures asked for one by one: the median of every stage and of the whole way there and back.
STAGES = """(async () => {
  const stages = {}, whole = [];
  for (let k = 0; k < COUNT; k++) {
    rnd.state.time = (k * 0.0371) % rnd.scene().motion.duration;
    const asked = performance.now(), picture = await rnd.picture(false);
    whole.push(performance.now() - asked);
    for (const [name, ms] of Object.entries(picture.times)) (stages[name] ??= []).push(ms);
  }
  const median = (values) => +values.sort((a, b) => a - b)[values.length >> 1].toFixed(2);
  const medians = Object.fromEntries(Object.entries(stages).map(([name, values]) => [name, median(values)]));
  return { ms_median: median(whole), stages_ms: medians };
})()"""
# Frames drawn while it plays, two of them in the making at any time.
PLAYING = """(async () => {
  rnd.play(true);
  await new Promise((done) => setTimeout(done, 1000));
  const rates = [];
  for (let k = 0; k < SECONDS; k++) {
    await new Promise((done) => setTimeout(done, 1000));
    rates.push(rnd.rate());
  }
  rnd.play(false);
  return rates.sort((a, b) => a - b)[rates.length >> 1];
})()"""


class _Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, format: str, *arguments: Any) -> None:
        pass


@contextmanager
def _static_host(avatar: Path) -> Iterator[str]:
    with tempfile.TemporaryDirectory() as folder:
        for entry in (*DIST.iterdir(), ASSETS / "walk.npz", ASSETS / "sky.exr"):
            (Path(folder) / entry.name).symlink_to(entry)
        (Path(folder) / "avatar.onnx").symlink_to(avatar.resolve())
        handler = functools.partial(_Quiet, directory=folder)
        with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
            threading.Thread(target=server.serve_forever, daemon=True).start()
            yield f"http://127.0.0.1:{server.server_port}/?avatar=avatar.onnx&motion=walk.npz&hdr=sky.exr"
            server.shutdown()


@contextmanager
def _browser(*, webgl: bool) -> Iterator[Page]:
    with (
        tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile,
        chromium(Path(profile), webgl=webgl) as page,
    ):
        yield page


def _measure(page: Page, url: str) -> dict[str, Any]:
    page.open(url)
    page.wait(f"location.href === {json.dumps(url)} && window.rnd && rnd.scene()")
    page.run(f"Object.assign(rnd.state, {{width: {SIZE}, height: {SIZE}}}); rnd.picture().then(() => 1)")
    result: dict[str, Any] = page.run(STAGES.replace("COUNT", str(ONE_BY_ONE)))
    return result | {"fps": page.run(PLAYING.replace("SECONDS", str(PLAYED_S)))}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("avatar", nargs="?", type=Path, default=ASSETS / "avatar.onnx")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    avatar: Path = arguments.avatar
    scene = Scene(ViewOptions(avatar, ASSETS / "walk.npz", (ASSETS / "sky.exr",), size=SIZE, raster="cpu"))
    scene.warm_up()
    common = {"gaussians": scene.avatar.gaussians, "size": SIZE, "cores": os.cpu_count()}
    common["machine"] = machine()
    rows = []
    with serve(scene, "127.0.0.1", 0, None) as (server, url), _browser(webgl=False) as page:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        rows.append({"page": "rnd-view, raw pixels", **_measure(page, url)})
        rows.append({"page": "rnd-view, JPEG", **_measure(page, f"{url}?encoding=jpeg")})
        server.shutdown()
    with _static_host(avatar) as web, _browser(webgl=True) as page:
        size = sum(file.stat().st_size for file in DIST.rglob("*") if file.is_file())
        rows.append({"page": "viewer/web", **_measure(page, web), "mb": round(size / 1e6, 1)})
    text = json.dumps([row | common for row in rows], indent=1)
    print(text)
    if arguments.json:
        arguments.json.write_text(text + "\n")


if __name__ == "__main__":
    main()
