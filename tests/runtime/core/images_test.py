"""The one transfer function, the one rounding, and files that keep every byte."""

import os
import struct
import subprocess
import sys
import time
import zlib

import numpy as np
import OpenImageIO as oiio
import pytest
from numpy.testing import assert_allclose

from rnd_runtime.core.errors import InputError
from rnd_runtime.core.images import linear_to_srgb, read_header, read_image, srgb_to_linear, to_bytes, write_image


def _png_chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def _png(pixels: np.ndarray, colour_type: int, extra: bytes = b"") -> bytes:
    """A PNG assembled by hand from the specification: what any other program could have written."""
    height, width = pixels.shape[:2]
    rows = b"".join(b"\0" + row.astype(pixels.dtype.newbyteorder(">")).tobytes() for row in pixels)
    header = struct.pack(">IIBBBBB", width, height, 8 * pixels.dtype.itemsize, colour_type, 0, 0, 0)
    body = _png_chunk(b"IHDR", header) + extra + _png_chunk(b"IDAT", zlib.compress(rows))
    return b"\x89PNG\r\n\x1a\n" + body + _png_chunk(b"IEND", b"")


def _random(shape: tuple[int, ...], dtype: type = np.uint8) -> np.ndarray:
    return np.random.default_rng(0).integers(0, np.iinfo(dtype).max + 1, shape, dtype)


def _save(path, pixels, kind, **attributes):
    """Write with OpenImageIO directly, for files we would not write ourselves."""
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], kind)
    for name, value in attributes.items():
        setattr(spec, name, value) if hasattr(spec, name) else spec.attribute(name, value)
    target = oiio.ImageOutput.create(str(path))
    assert target.open(str(path), spec) and target.write_image(pixels) and target.close()


def test_transfer_function_at_known_points():
    # IEC 61966-2-1: the toe's end, middle grey, white
    assert_allclose(linear_to_srgb([0, 0.0031308, 0.18, 0.5, 1]), [0, 0.04045, 0.46136, 0.73536, 1], atol=1e-5)
    assert to_bytes(linear_to_srgb(0.18)) == 118


def test_transfer_function_is_continuous_monotonic_and_inverted():
    x = np.linspace(0, 1, 100_001)
    y = linear_to_srgb(x)
    assert (np.diff(y) > 0).all()
    assert abs(linear_to_srgb(0.0031308 - 1e-12) - linear_to_srgb(0.0031308 + 1e-12)) < 1e-7
    assert_allclose(srgb_to_linear(y), x, atol=1e-7)  # the standard's two thresholds agree to 1e-8
    assert linear_to_srgb(np.float32([0.2])).dtype == np.float32
    assert linear_to_srgb(-1.0) == 0


def test_every_byte_survives_the_way_to_linear_and_back():
    every = np.arange(256, dtype=np.uint8)
    assert (to_bytes(linear_to_srgb(srgb_to_linear(every / 255))) == every).all()
    assert (to_bytes(linear_to_srgb(srgb_to_linear(every.astype(np.float32) / 255))) == every).all()


def test_rounding_is_half_up_clipped_and_never_wraps():
    values = [-1, 0, 0.49 / 255, 0.5 / 255, 1.5 / 255, 254.49 / 255, 1, 1.01, 1e30, np.inf, -np.inf, np.nan]
    assert to_bytes(values).tolist() == [0, 0, 0, 1, 2, 254, 255, 255, 255, 255, 0, 0]


@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_png_round_trip_is_exact(tmp_path, channels, dtype):
    pixels = _random((5, 7, channels), dtype)
    write_image(tmp_path / "a.png", pixels)
    back = read_image(tmp_path / "a.png")
    assert back.dtype == dtype and (back == pixels).all()


def test_png_colours_are_not_multiplied_or_divided_by_alpha(tmp_path):
    """OpenImageIO does both unless told not to; at alpha 0 the colours would be gone."""
    pixels = _random((4, 4, 4))
    pixels[..., 3] = [0, 1, 128, 255]
    (tmp_path / "theirs.png").write_bytes(_png(pixels, colour_type=6))
    assert (read_image(tmp_path / "theirs.png") == pixels).all()
    write_image(tmp_path / "ours.png", pixels)
    assert (read_image(tmp_path / "ours.png") == pixels).all()
    naive = oiio.ImageInput.open(str(tmp_path / "theirs.png")).read_image("uint8")
    assert (naive != pixels).any()  # the trap is real


def test_foreign_grey_and_colour_pngs_are_read_as_their_bytes(tmp_path):
    for colour_type, pixels in ((0, _random((3, 5, 1))), (2, _random((3, 5, 3))), (2, _random((3, 5, 3), np.uint16))):
        (tmp_path / "a.png").write_bytes(_png(pixels, colour_type))
        assert (read_image(tmp_path / "a.png") == pixels).all()


def test_gamma_and_profile_chunks_change_nothing(tmp_path):
    pixels = _random((3, 5, 3))
    gamma = _png_chunk(b"gAMA", struct.pack(">I", 100_000))
    (tmp_path / "a.png").write_bytes(_png(pixels, 2, gamma))
    assert (read_image(tmp_path / "a.png") == pixels).all()


def test_exr_is_float_and_keeps_sun_texels_and_tiny_values(tmp_path):
    pixels = np.float32([[[1e6, 65520, 1e-30], [3e38, 0, 0.1]]])
    write_image(tmp_path / "a.exr", pixels)
    back = read_image(tmp_path / "a.exr")
    assert back.dtype == np.float32 and (back == pixels).all()
    assert read_header(tmp_path / "a.exr").pixel_type == "float"


def test_exr_of_halves_is_read_as_float32(tmp_path):
    pixels = np.float32([[[0.5, 2.0, 65504.0]]])
    _save(tmp_path / "a.exr", pixels, "half")
    assert read_image(tmp_path / "a.exr").dtype == np.float32
    assert (read_image(tmp_path / "a.exr") == pixels).all()


@pytest.mark.parametrize("kinds", [("uint", "uint", "uint"), ("uint", "half", "float"), ("half", "half", "uint")])
def test_exr_of_whole_numbers_is_refused_in_any_channel(tmp_path, kinds):
    """Read as floats, they come back divided by 2³² − 1."""
    _save(tmp_path / "a.exr", np.full((3, 5, 3), 7, np.float32), kinds[0], channelformats=kinds)
    with pytest.raises(InputError, match=r"a\.exr: type of pixels: expected uint8 .* or float, got uint"):
        read_image(tmp_path / "a.exr")


def test_exr_channels_carry_their_names_and_stay_in_order(tmp_path):
    pixels = np.random.default_rng(0).normal(size=(3, 4, 5)).astype(np.float32)
    names = ("albedo.R", "albedo.G", "albedo.B", "depth.Z", "visibility.V")
    write_image(tmp_path / "a.exr", pixels, channel_names=names)
    header = read_header(tmp_path / "a.exr")
    assert set(header.channels) == set(names)
    back = read_image(tmp_path / "a.exr")
    for k, name in enumerate(names):
        assert (back[..., header.channels.index(name)] == pixels[..., k]).all(), name


def test_header_without_decoding(tmp_path):
    write_image(tmp_path / "a.png", _random((3, 4, 3)))
    header = read_header(tmp_path / "a.png")
    assert (header.width, header.height, header.channels) == (4, 3, ("R", "G", "B"))
    assert header.pixel_type == "uint8"


def test_equal_pixels_give_equal_bytes_at_any_time(tmp_path):
    pictures = {"a.png": _random((6, 6, 3)), "a.exr": np.ones((6, 6, 3), np.float32)}
    for name, pixels in pictures.items():
        write_image(tmp_path / name, pixels)
    first = {name: (tmp_path / name).read_bytes() for name in pictures}
    time.sleep(1.1)  # OpenEXR's headers hold the time in seconds
    for name, pixels in pictures.items():
        write_image(tmp_path / name, pixels)
        assert (tmp_path / name).read_bytes() == first[name]
        assert str(tmp_path).encode() not in first[name]


def test_broken_files_say_why_in_one_line(tmp_path):
    write_image(tmp_path / "whole.exr", np.random.default_rng(0).random((64, 64, 3)).astype(np.float32))
    whole = (tmp_path / "whole.exr").read_bytes()
    write_image(tmp_path / "whole.png", _random((64, 64, 3)))
    files = {
        "not_an.exr": b"hello" * 20,
        "cut.exr": whole[: len(whole) // 2],
        "cut.png": (tmp_path / "whole.png").read_bytes()[:2000],
        "empty.png": b"",
        "unknown.xyz": b"what?",
    }
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(InputError) as caught:
            read_image(tmp_path / name)
        message = str(caught.value)
        assert str(tmp_path / name) in message and "\n" not in message
        assert len(message) > len(str(tmp_path / name)) + len(": image cannot be read: got "), message
        said = {"not_an.exr": "something else than a .exr file", "empty.png": "an empty file"}
        assert message.endswith(said.get(name, ""))


def test_even_pixels_in_dwab_are_sound_and_more_than_memory_holds_is_not(tmp_path):
    """DWAB has no bound such as deflate's; here 7200 : 1."""
    pixels = np.full((1024, 2048, 3), 0.5, np.float32)
    _save(tmp_path / "even.exr", pixels, "half", compression="dwab")
    assert_allclose(read_image(tmp_path / "even.exr"), pixels, atol=0.01)
    data = bytearray((tmp_path / "even.exr").read_bytes())
    for name in (b"dataWindow", b"displayWindow"):
        at = data.index(name + b"\0box2i\0") + len(name) + 7 + 4
        data[at + 8 : at + 16] = np.array([19999, 19999], "<i4").tobytes()
    (tmp_path / "vast.exr").write_bytes(data + bytes(1_000_000))
    with pytest.raises(InputError, match="expected 2400000000 bytes of pixels"):
        read_header(tmp_path / "vast.exr")


def test_pictures_turned_by_exif_and_crops_are_refused(tmp_path):
    _save(tmp_path / "turned.jpg", _random((8, 16, 3)), "uint8", Orientation=6)
    with pytest.raises(InputError, match="orientation 1, got 6"):
        read_image(tmp_path / "turned.jpg")
    pixels = np.zeros((4, 4, 3), np.float32)
    _save(tmp_path / "crop.exr", pixels, "float", full_width=8, full_height=8)
    with pytest.raises(InputError, match="fills its canvas"):
        read_image(tmp_path / "crop.exr")


def test_writing_elsewhere_is_refused_and_leaves_nothing(tmp_path):
    with pytest.raises(InputError, match=r"\.png or \.exr, got \.tga"):
        write_image(tmp_path / "a.tga", _random((2, 2, 3)))
    (tmp_path / "a.png").mkdir()
    with pytest.raises(InputError, match="folder"):
        write_image(tmp_path / "a.png", _random((2, 2, 3)))
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]


def test_names_that_are_not_text_are_one_line(tmp_path):
    folder = tmp_path / os.fsdecode(b"\xff")
    folder.mkdir()
    with pytest.raises(InputError, match="name of an image: expected UTF-8"):
        write_image(folder / "a.png", np.ones((2, 2, 3), np.uint8))
    (folder / "a.exr").write_bytes(b"")
    with pytest.raises(InputError, match="name of an image: expected UTF-8"):
        read_image(folder / "a.exr")
    assert [file.name for file in folder.iterdir()] == ["a.exr"]


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="limits file sizes with ulimit")
@pytest.mark.parametrize(("name", "kind"), [("a.exr", "float32"), ("a.png", "uint8")])
def test_full_disk_leaves_no_half_picture(tmp_path, name, kind):
    """A write that fails (here: a limit on the size of files) is an InputError and keeps the old picture."""
    write_image(tmp_path / name, np.ones((2, 2, 3), kind))
    before = (tmp_path / name).read_bytes()
    code = (
        "import resource, signal, sys, numpy as np\n"
        "from rnd_runtime.core.images import write_image\n"
        "from rnd_runtime.core.errors import InputError\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))\n"
        "pixels = (255 * np.random.default_rng(0).random((256, 256, 3))).astype(sys.argv[2])\n"
        "try:\n    write_image(sys.argv[1], pixels)\n"
        "except InputError as error:\n    print(error)\n"
    )
    result = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / name), kind], capture_output=True, text=True, check=True
    )
    assert "cannot be written" in result.stdout, result
    assert (tmp_path / name).read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == [name]
