"""The page for static hosts reads the light probes that Python reads, to the same radiance, or says why it does not."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from rnd_runtime.core.errors import InputError
from rnd_runtime.shading.directional import extract_directional
from rnd_runtime.shading.files.channels import REC709
from rnd_runtime.shading.files.load import load_light
from rnd_runtime.shading.light import light_notes
from support.paths import ROOT
from support.sun_scenes import beside_a_lamp

WEB = ROOT / "viewer/web"
NODE = shutil.which("node")
HEIGHT = 37  # whole blocks of no compression: the last one is shorter
RADIANCE = np.random.default_rng(4).uniform(0.01, 3, (HEIGHT, 2 * HEIGHT, 3)).astype(np.float16)
LOSSLESS = ("none", "rle", "zips", "zip", "piz", "pxr24")  # of half floats

pytestmark = [
    pytest.mark.skipif(NODE is None, reason="needs Node.js"),
    pytest.mark.skipif(not (WEB / "node_modules/parse-exr").is_dir(), reason="needs npm ci in viewer/web"),
]

_READER = """
import { readFileSync } from "node:fs";
const { readLight, lightNotes } = await import(process.argv[1] + "/shading/light.js");
let answer;
try {
    const light = readLight(new Uint8Array(readFileSync(process.argv[2])), process.argv[2]);
    answer = { ...light, radiance: [...light.radiance], notes: lightNotes(light) };
} catch (error) { answer = { refused: error.message }; }
console.log(JSON.stringify(answer));
"""
_SUNS = """
import { readFileSync } from "node:fs";
const { readLight } = await import(process.argv[1] + "/shading/light.js");
const { extractSuns } = await import(process.argv[1] + "/shading/sun.js");
const { suns, sky } = extractSuns(readLight(new Uint8Array(readFileSync(process.argv[2])), process.argv[2]));
console.log(JSON.stringify({ suns, sky: [...sky.radiance] }));
"""


def _page(file: Path, code: str = _READER) -> Any:
    """What the page's code makes of a probe, in Node.js."""
    assert NODE is not None
    command = [NODE, "--input-type=module", "--eval", code, WEB.as_uri() + "/src", str(file)]
    return json.loads(subprocess.run(command, capture_output=True, check=True, timeout=60).stdout)


def _exr(path: Path, pixels: np.ndarray, *, kind: str = "half", window: tuple[int, int] = (0, 0), **said: Any) -> Path:
    """An EXR of ``pixels`` [H, W, C]; ``window``: where its first pixel stands on a canvas that is as large."""
    height, width, channels = pixels.shape
    spec = oiio.ImageSpec(width, height, channels, kind)
    spec.full_width, spec.full_height = width + window[0], height + window[1]
    spec.x, spec.y = window
    spec.channelnames = said.pop("names", ("R", "G", "B", "A")[:channels])
    if "kinds" in said:
        spec.channelformats = said.pop("kinds")
    tile = said.pop("tile", 0)
    spec.tile_width = spec.tile_height = tile
    for name, value in said.items():
        spec.attribute({"order": "openexr:lineOrder"}.get(name, name), value)
    target = oiio.ImageOutput.create(str(path))
    assert target.open(str(path), spec), target.geterror()
    write = target.write_tiles if tile else target.write_scanlines
    top, left = window[1], window[0]
    rows = (left, left + width, top, top + height, 0, 1) if tile else (top, top + height, 0)
    assert write(*rows, np.ascontiguousarray(pixels.astype(np.float32))), target.geterror()
    assert target.close()
    return path


def _assert_the_same(file: Path) -> None:
    got, light = _page(file), load_light(file)
    assert "refused" not in got, got
    assert got["notes"] == light_notes(light)
    expected = light.radiance
    assert (got["height"], got["width"]) == expected.shape[:2]
    assert_array_equal(np.array(got["radiance"], np.float32).reshape(expected.shape), expected)


@pytest.mark.parametrize("order", ["increasingY", "decreasingY"])
@pytest.mark.parametrize("compression", LOSSLESS)
def test_lines_may_be_stored_from_the_bottom(tmp_path, compression, order):
    file = _exr(tmp_path / "sky.exr", RADIANCE, compression=compression, order=order)
    assert_array_equal(load_light(file).radiance, RADIANCE.astype(np.float32))
    _assert_the_same(file)


@pytest.mark.parametrize("kind", ["half", "float"])
@pytest.mark.parametrize("said", [{}, {"tile": 16}, {"tile": 16, "order": "decreasingY"}])
def test_tiles_and_an_alpha(tmp_path, kind, said):
    pixels = np.concatenate([RADIANCE, np.ones_like(RADIANCE[..., :1])], axis=2)
    _assert_the_same(_exr(tmp_path / "sky.exr", pixels, kind=kind, compression="zip", **said))


AP0 = (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, 0.32168, 0.33767)
D65_IN_FULL = (*REC709[:6], 0.31271, 0.32902)


@pytest.mark.parametrize(
    ("primaries", "brightest", "about"),
    [
        (D65_IN_FULL, 1.0, []),
        (
            AP0,
            1.0,
            ["Rec.709, but its file states red (0.7347, 0.2653), green (0, 1), blue (0.0001, -0.077) and white"],
        ),
        ((float("nan"), 1.23456e-5, 12340.0, *AP0[3:]), 1.0, ["red (nan, 1.235e-05), green (1.234e+04, 1)"]),
        (REC709, 0.00012345, ["largest radiance is 0.000123; try --exposure"]),
        (AP0, 3.3e-7, ["Rec.709", "3.3e-07;"]),
        (REC709, 0.0, ["is 0;"]),
    ],
)
def test_a_light_is_spoken_of_in_the_same_words(tmp_path, primaries, brightest, about):
    pixels = np.full((4, 8, 3), brightest, np.float32)
    spec = oiio.ImageSpec(8, 4, 3, "float")
    spec.attribute("chromaticities", oiio.TypeDesc("float[8]"), primaries)
    target = oiio.ImageOutput.create(str(tmp_path / "sky.exr"))
    assert target.open(str(tmp_path / "sky.exr"), spec) and target.write_image(pixels) and target.close()
    notes = light_notes(load_light(tmp_path / "sky.exr"))
    assert len(notes) == len(about) and all(words in note for words, note in zip(about, notes))
    assert _page(tmp_path / "sky.exr")["notes"] == notes


def test_repaired_texels_are_reported(tmp_path):
    pixels = RADIANCE.astype(np.float32)
    pixels[3, 4:6, 1] = np.nan
    _assert_the_same(_exr(tmp_path / "sky.exr", pixels, kind="float"))
    assert _page(tmp_path / "sky.exr")["notes"][0].startswith("2 texels")


def test_a_sun_that_half_floats_cut_is_their_largest_number(tmp_path):
    pixels = RADIANCE.copy()
    pixels[3, 4] = pixels[3, 5, 1] = np.inf
    _assert_the_same(file := _exr(tmp_path / "sky.exr", pixels))
    answer = _page(file)
    assert max(answer["radiance"]) == 65504 and answer["notes"] == light_notes(load_light(file))
    assert answer["notes"][0].startswith("2 texels of the light were infinite")


FIVE = np.concatenate([RADIANCE, np.ones((HEIGHT, 2 * HEIGHT, 2), np.float16)], axis=2)
RGB_AND = ("R", "G", "B", "A", "id")


@pytest.mark.parametrize(
    ("said", "message"),
    [
        ({"names": ("view.R", "view.G", "view.B")}, "expected channels R, G and B, of no layer, got view.B, view.G"),
        ({"window": (3, 0)}, "image layout: expected one flat image that fills its canvas, got pixels 3,0,76,36 of"),
        ({"kind": "uint"}, "pixels: expected half or float in all channels, got B of whole numbers"),
        ({"compression": "b44"}, "compression: expected none, RLE, ZIPS, ZIP, PIZ, PXR24, DWAA, DWAB, got B44"),
    ],
)
def test_what_would_be_read_wrongly_is_refused(tmp_path, said, message):
    answer = _page(_exr(tmp_path / "sky.exr", RADIANCE, **said))
    assert message in answer["refused"]


def test_other_channels_do_not_shift_the_colours(tmp_path):
    half = ("half",) * 4
    _assert_the_same(_exr(tmp_path / "a.exr", FIVE, names=RGB_AND, kinds=(*half, "float")))
    answer = _page(_exr(tmp_path / "b.exr", FIVE, names=RGB_AND, kinds=(*half, "uint")))
    assert "got id of whole numbers" in answer["refused"]
    answer = _page(_exr(tmp_path / "c.exr", FIVE[..., :3], kinds=("half", "float", "half")))
    assert "half or float in all channels, got both" in answer["refused"]


@pytest.mark.parametrize("order", ["increasingY", "decreasingY"])
def test_files_cut_anywhere_are_refused(tmp_path, order):
    whole = _exr(tmp_path / "sky.exr", RADIANCE, compression="zip", order=order).read_bytes()
    for length in (*range(0, 400, 29), 700, 3000, len(whole) - 1):
        (tmp_path / "cut.exr").write_bytes(whole[:length])
        assert "refused" in _page(tmp_path / "cut.exr"), length


def _hdr(path: Path, radiance: np.ndarray = RADIANCE) -> bytes:
    target = oiio.ImageOutput.create(str(path))
    assert target.open(str(path), oiio.ImageSpec(2 * HEIGHT, HEIGHT, 3, "float"))
    assert target.write_image(radiance.astype(np.float32)) and target.close()
    return path.read_bytes()


def test_radiance_files_cut_anywhere_are_refused(tmp_path):
    radiance, file = RADIANCE.copy(), tmp_path / "cut.hdr"
    radiance[-1, ::2] = 0.1  # exponents that differ: the last line ends with a literal, not with a run
    whole = _hdr(tmp_path / "sky.hdr", radiance)
    for length in (*range(0, 200, 29), 3000, len(whole) - 30, len(whole) - 1):
        file.write_bytes(whole[:length])
        with pytest.raises(InputError):
            load_light(file)
        assert "refused" in _page(file), length
    assert _page(file)["refused"] == "the .hdr file is cut short"


@pytest.mark.parametrize("kind", ["run", "bytes"])
def test_radiance_files_whose_lines_are_overrun_are_refused(tmp_path, kind):
    whole, file = _hdr(tmp_path / "sky.hdr"), tmp_path / "long.hdr"
    first = whole.index(b"\n", whole.index(b"\n\n") + 2) + 1 + 4  # of the codes of the first line
    longer = {"run": b"\xff\x80", "bytes": b"\x80" + bytes(128)}[kind]
    file.write_bytes(whole[:first] + 3 * longer + whole[first:])
    with pytest.raises(InputError):
        load_light(file)
    assert _page(file)["refused"] == "the .hdr file: expected runs that end with their line, got a longer one"


def test_radiance_files_with_the_line_ends_of_windows(tmp_path):
    file = tmp_path / "sky.hdr"
    whole = _hdr(file)
    _assert_the_same(file)
    end = whole.index(b"\n", whole.index(b"\n\n") + 2) + 1
    file.write_bytes(whole[:end].replace(b"\n", b"\r\n") + whole[end:])
    _assert_the_same(file)


def test_radiance_files_in_xyz_are_for_python_alone(tmp_path):
    file = tmp_path / "sky.hdr"
    file.write_bytes(_hdr(file).replace(b"rle_rgbe", b"rle_xyze"))
    assert "CIE XYZ" in load_light(file).notes[0]
    assert "expected FORMAT=32-bit_rle_rgbe, got FORMAT=32-bit_rle_xyze" in _page(file)["refused"]


def test_an_attribute_of_negative_size_ends(tmp_path):
    """It led back to its own name, for ever."""
    file = tmp_path / "a.exr"
    size = (-10).to_bytes(4, "little", signed=True)
    file.write_bytes(b"\x76\x2f\x31\x01\x02\x00\x00\x00" + b"a\x00int\x00" + size + bytes(8))
    assert "the .exr file is damaged" in _page(file)["refused"]


@pytest.mark.parametrize(
    "stated",
    [
        "EXPOSURE= 3\nEXPOSURE=7.5\n",
        "EXPOSURE=1.0\nPRIMARIES=0.7 0.3 0.2 0.7 0.1 0.1 0.33 0.33\n",
        "PRIMARIES=1 2 3\n",
        "PRIMARIES=0 0 0 0 0 0 0 0\n",
        "EXPOSURE=0\n",
        "EXPOSURE=fast\n",
        "EXPOSURE=1e31\n",
    ],
)
def test_what_a_radiance_file_states_is_taken_alike(tmp_path, stated):
    file = tmp_path / "sky.hdr"
    file.write_bytes(_hdr(file).replace(b"\n", b"\n" + stated.encode(), 1))
    page = _page(file)
    try:
        light = load_light(file)
    except InputError as error:
        assert page["refused"] in str(error) and "EXPOSURE" in page["refused"]
    else:
        assert_array_equal(np.float32(page["radiance"]).reshape(light.radiance.shape), light.radiance)
        assert page["notes"] == light_notes(light)


def test_a_sun_is_taken_out_beside_a_lamp_of_brighter_texels(tmp_path: Path) -> None:
    radiance, _ = beside_a_lamp()
    file = _exr(tmp_path / "sun.exr", radiance, kind="float")
    rest, suns = extract_directional(load_light(file))
    got = _page(file, _SUNS)
    assert len(got["suns"]) == len(suns) == 1
    for name in ("direction", "irradiance", "spread"):
        assert_allclose(got["suns"][0][name], getattr(suns[0], name), rtol=1e-6)
    assert_array_equal(np.array(got["sky"], np.float32), rest.radiance.ravel())
