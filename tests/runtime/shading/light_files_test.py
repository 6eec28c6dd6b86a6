"""Light probes of other encodings, orientations and layers: right, or refused for the true reason."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
from numpy.testing import assert_allclose

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.images import write_image
from rnd_runtime.shading.files.load import load_light

CASES = Path(__file__).parents[2] / "cases/formats"
RGBE = 1 / 64  # readers may add half a step to the mantissa
RNG = np.random.default_rng(0)


def test_the_cases_are_one_light_but_for_their_size():
    """The same light as XYZE, bottom up, in Blender's two layers and in lowercase channels."""
    means = {
        name: load_light(CASES / name).mean_radiance
        for name in ("xyze.hdr", "bottomup.hdr", "blender2.exr", "lower.exr")
    }
    for name, mean in means.items():
        assert_allclose(mean, means["lower.exr"], rtol=0.02, err_msg=name)
    top, bottom = (load_light(CASES / name).radiance[[0, -1], 0] for name in ("bottomup.hdr", "xyze.hdr"))
    assert_allclose(top, bottom, rtol=0.02)


def _write_rgbe(path: Path, rgbe: np.ndarray, resolution: str, form: str = "rgbe", more: str = "") -> Path:
    path.write_bytes(f"#?RADIANCE\n{more}FORMAT=32-bit_rle_{form}\n\n{resolution}\n".encode() + rgbe.tobytes())
    return path


UPRIGHT = RNG.integers(128, 256, (4, 8, 4), dtype=np.uint8)
UPRIGHT[..., 3] = 129


@pytest.mark.parametrize("across", [False, True])
@pytest.mark.parametrize("x", "+-")
@pytest.mark.parametrize("y", "-+")
def test_every_orientation_of_a_radiance_file_is_upright(tmp_path, x, y, across):
    stored = UPRIGHT[:: 1 if y == "-" else -1, :: 1 if x == "+" else -1]
    resolution = f"{x}X 8 {y}Y 4" if across else f"{y}Y 4 {x}X 8"
    path = _write_rgbe(tmp_path / "a.hdr", stored.swapaxes(0, 1) if across else stored, resolution)
    assert_allclose(load_light(path).radiance, UPRIGHT[..., :3] / 128, rtol=RGBE)
    assert load_light(path).notes == ()


def test_large_maps_are_flipped_too(tmp_path, monkeypatch):
    monkeypatch.setattr("rnd_runtime.shading.files.load._MAX_ROWS", 2)
    path = _write_rgbe(tmp_path / "a.hdr", UPRIGHT[::-1], "+Y 4 +X 8")
    upright = _write_rgbe(tmp_path / "b.hdr", UPRIGHT, "-Y 4 +X 8")
    assert_allclose(load_light(path).radiance, load_light(upright).radiance, rtol=1e-6)
    path = _write_rgbe(tmp_path / "c.hdr", UPRIGHT.swapaxes(0, 1), "+X 8 -Y 4")
    with pytest.raises(InputError, match=r"c\.hdr: large light probe: expected rows from left to right, got columns"):
        load_light(path)


@pytest.mark.parametrize(
    ("primaries", "white"), [("", (0.3127, 0.329)), (".64 .33 .29 .6 .15 .06 .3333 .3333", (0.3333, 0.3333))]
)
def test_grey_in_xyz_is_grey(tmp_path, primaries, white):
    """Of D65, or of the white that the file states (Radiance's own is 1/3, 1/3)."""
    x, y = white
    xyz = np.array([x / y, 1, (1 - x - y) / y])
    stored = np.full((2, 4, 4), [*np.round(128 * xyz), 129], np.uint8)
    path = _write_rgbe(tmp_path / "a.hdr", stored, "-Y 2 +X 4", "xyze", primaries and f"PRIMARIES={primaries}\n")
    light = load_light(path)
    assert_allclose(light.radiance, 1, rtol=0.02)
    assert len(light.notes) == 1 and "CIE XYZ" in light.notes[0]


def test_red_in_xyz_is_red(tmp_path):
    stored = np.full((2, 4, 4), [*np.round(255 * np.array([0.4124, 0.2126, 0.0193])), 128], np.uint8)
    radiance = load_light(_write_rgbe(tmp_path / "a.hdr", stored, "-Y 2 +X 4", "xyze")).radiance
    assert_allclose(radiance[0, 0], [1, 0, 0], atol=0.02)


@pytest.mark.parametrize(
    ("form", "resolution", "words"),
    [
        ("abcd", "-Y 2 +X 4", "FORMAT of the light probe: expected rgbe or xyze"),
        ("rgbe", "-Y 2 +Y 4", "a line such as"),
    ],
)
def test_other_headers_are_refused_for_their_reason(tmp_path, form, resolution, words):
    path = _write_rgbe(tmp_path / "a.hdr", np.full((2, 4, 4), 128, np.uint8), resolution, form)
    with pytest.raises(InputError, match=words) as caught:
        load_light(path)
    assert str(caught.value).startswith(str(path))


def test_of_blenders_layers_the_compositors_is_taken_and_the_others_named(tmp_path):
    layers = ("ViewLayer.Combined", "ViewLayer.DiffCol", "Composite.Combined")
    pixels = RNG.random((4, 8, 9)).astype(np.float32)
    path = tmp_path / "a.exr"
    write_image(path, pixels, channel_names=tuple(f"{layer}.{colour}" for layer in layers for colour in "RGB"))
    light = load_light(path)
    assert_allclose(light.radiance, pixels[..., 6:])
    assert "Composite.Combined is taken; left out: ViewLayer.Combined, ViewLayer.DiffCol" in light.notes[0]
    write_image(path, pixels[..., :6], channel_names=tuple(f"{layer}.{c}" for layer in layers[:2] for c in "RGB"))
    assert_allclose(load_light(path).radiance, pixels[..., :3])


def test_luminance_is_grey(tmp_path):
    pixels = RNG.random((4, 8, 1)).astype(np.float32)
    write_image(tmp_path / "a.exr", pixels, channel_names=("Y",))
    light = load_light(tmp_path / "a.exr")
    assert_allclose(light.radiance, np.repeat(pixels, 3, 2))
    assert "luminance alone" in light.notes[0]


def _luminance_chroma(path: Path) -> Path:
    """An EXR by hand: Y, and RY and BY of half the size, as OpenEXR's RgbaOutputFile writes WRITE_YC."""

    def attribute(name: str, kind: str, value: bytes) -> bytes:
        return f"{name}\0{kind}\0".encode() + struct.pack("<i", len(value)) + value

    channels = b"".join(
        n.encode() + b"\0" + struct.pack("<iB3xii", 1, 0, s, s) for n, s in (("BY", 2), ("RY", 2), ("Y", 1))
    )
    box = struct.pack("<4i", 0, 0, 7, 3)
    head = b"v/1\x01" + struct.pack("<i", 2) + attribute("channels", "chlist", channels + b"\0")
    head += attribute("compression", "compression", b"\0") + attribute("dataWindow", "box2i", box)
    head += attribute("displayWindow", "box2i", box) + attribute("lineOrder", "lineOrder", b"\0")
    head += attribute("pixelAspectRatio", "float", struct.pack("<f", 1)) + b""
    head += attribute("screenWindowCenter", "v2f", struct.pack("<2f", 0, 0))
    head += attribute("screenWindowWidth", "float", struct.pack("<f", 1)) + b"\0"
    lines = [np.full(8 + 8 * (y % 2 == 0), 0.5, "<f2").tobytes() for y in range(4)]
    at, table, body = len(head) + 8 * 4, b"", b""
    for y, line in enumerate(lines):
        table += struct.pack("<Q", at + len(body))
        body += struct.pack("<ii", y, len(line)) + line
    path.write_bytes(head + table + body)
    return path


def test_cie_xyz_is_no_luminance_alone(tmp_path):
    write_image(tmp_path / "a.exr", np.ones((4, 8, 3), np.float32), channel_names=("X", "Y", "Z"))
    with pytest.raises(InputError, match=r"a\.exr: light probe: expected R, G and B, got CIE XYZ \(X, Y, Z\)"):
        load_light(tmp_path / "a.exr")


def test_luminance_and_chroma_are_refused_by_name(tmp_path):
    with pytest.raises(InputError, match=r"a\.exr: .*(luminance and chroma|ubsampled)"):
        load_light(_luminance_chroma(tmp_path / "a.exr"))


@pytest.mark.parametrize("first", ["RGB", "Z"])
def test_of_several_parts_the_first_is_read_and_the_others_named(tmp_path, first):
    """As Nuke writes them: a light is noted, another first part is refused with the reason."""
    path, size = tmp_path / "a.exr", (8, 4)
    specs = [oiio.ImageSpec(*size, len(names), "half") for names in (first, "RGB")]
    for spec, names, part in zip(specs, (first, "RGB"), ("rgba", "specular")):
        spec.channelnames = tuple(names)
        spec.attribute("oiio:subimagename", part)
    target = oiio.ImageOutput.create(str(path))
    assert target.open(str(path), tuple(specs))
    for k, spec in enumerate(specs):
        if k:
            assert target.open(str(path), spec, "AppendSubimage")
        assert target.write_image(np.full((4, 8, spec.nchannels), 1.0 + k, np.float32))
    target.close()
    told = "of the light's file the first part is read; left out: specular"
    if first == "RGB":
        light = load_light(path)
        assert told in light.notes and (light.radiance == 1).all()
    else:
        with pytest.raises(InputError, match=told):
            load_light(path)
