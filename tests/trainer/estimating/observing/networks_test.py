"""Networks in the user's cache: missing, damaged, and fetched from a package."""

from __future__ import annotations

import hashlib
import io
import json
import tarfile
from pathlib import Path

import pytest

from rnd_runtime.core.errors import InputError
from rnd_trainer.commands import data as data_cli
from rnd_trainer.estimating.observing import networks


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr("sys.platform", "linux")
    return tmp_path / "cache" / "rnd-avatar" / "networks"


def packed(path: Path, content: bytes) -> Path:
    with tarfile.open(path, "w:gz") as archive:
        info = tarfile.TarInfo("package/net.bin")
        info.size = len(content)
        archive.addfile(info, io.BytesIO(content))
    return path


class Converted:
    def SerializeToString(self) -> bytes:
        return b"a graph"


def test_a_missing_network_names_the_command(cache: Path) -> None:
    with pytest.raises(InputError, match=r"network pose_landmarks is missing \(rnd-data networks fetches it\)"):
        networks.network_file("pose_landmarks")
    assert not cache.exists()


def test_what_is_fetched_is_checked_converted_and_found(tmp_path, cache, monkeypatch) -> None:
    content = b"0123456789"
    digest = hashlib.sha256(b"345").hexdigest()
    known = networks.Network("small", "a small one", "net.bin", 3, 6, digest)
    monkeypatch.setattr(networks, "NETWORKS", (known,))
    monkeypatch.setattr(networks, "convert", lambda model, name: Converted() if model == b"345" else None)
    (path,) = networks.fetch_networks(packed(tmp_path / "package.tgz", content), (known,))
    assert path == networks.network_file("small") == cache / "small.onnx"
    assert path.read_bytes() == b"a graph"
    assert json.loads((cache / "networks.json").read_text())["small"]["licence"] == "Apache-2.0"
    path.write_bytes(b"another graph")
    with pytest.raises(InputError, match="expected this version's"):
        networks.network_file("small")


@pytest.mark.parametrize("content", [b"another package", b""])
def test_another_package_is_refused_and_nothing_is_left(tmp_path: Path, cache: Path, content: bytes) -> None:
    known = networks.Network("small", "a small one", "net.bin", 0, 4, "0" * 64)
    with pytest.raises(InputError, match="sha256 of small"):
        networks.fetch_networks(packed(tmp_path / "package.tgz", content), (known,))
    assert list(cache.iterdir()) == []


def test_what_is_no_package_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file.tgz").write_bytes(b"no archive")
    with pytest.raises(InputError, match=r"expected a \.tgz with package/"):
        networks.fetch_networks(tmp_path / "file.tgz")


def test_without_npm_one_line_says_what_to_do(monkeypatch, capsys) -> None:
    monkeypatch.setenv("PATH", "")
    with pytest.raises(SystemExit) as leaving:
        data_cli.main(["networks"])
    assert leaving.value.code == 2
    said = capsys.readouterr().err.splitlines()[-1]
    assert "npm is not installed" in said and "--package FILE" in said


def test_a_registry_that_is_not_reached_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    npm = tmp_path / "bin" / "npm"
    npm.parent.mkdir()
    npm.write_text("#!/bin/sh\necho 'npm error code ENOTFOUND' >&2\nexit 1\n")
    npm.chmod(0o755)
    monkeypatch.setenv("PATH", f"{npm.parent}:/bin:/usr/bin")
    with pytest.raises(InputError, match="cannot be fetched: got npm error code ENOTFOUND"):
        networks.fetch_networks()
