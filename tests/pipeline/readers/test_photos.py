"""Decoding of photographs: every kind of sample becomes 8-bit RGB, damage is refused."""

import struct

import numpy as np
import OpenImageIO as oiio
import pytest

from pipeline.readers.photos import MAX_SIDE_PX, decode_photo, photo_size
from storage.errors import InvalidScan, UnsupportedScan
from tests.pipeline.readers.workspace import write_photo


def picture(n_channels, dtype=np.uint8):
    top = np.iinfo(dtype).max
    return np.random.default_rng(0).integers(0, top, (6, 5, n_channels), dtype, endpoint=True)


def decoded(path, pixels, sample="uint8"):
    write_photo(path, pixels, sample)
    return decode_photo(str(path), "here")


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_photos__rgb_is_unchanged(tmp_path, suffix):
    pixels = picture(3)
    np.testing.assert_array_equal(decoded(tmp_path / f"a{suffix}", pixels), pixels)
    assert photo_size(str(tmp_path / f"a{suffix}"), "here") == (5, 6)


@pytest.mark.parametrize("n_channels", [1, 2])
def test_photos__grey_becomes_rgb(tmp_path, n_channels):
    pixels = picture(n_channels)
    got = decoded(tmp_path / "a.png", pixels)
    np.testing.assert_array_equal(got, np.repeat(pixels[..., :1], 3, axis=2))


def test_photos__alpha_is_dropped_and_not_multiplied_in(tmp_path):
    pixels = picture(4)
    np.testing.assert_array_equal(decoded(tmp_path / "a.png", pixels), pixels[..., :3])


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_photos__16_bits_become_8(tmp_path, suffix):
    pixels = picture(3, np.uint16)
    expected = np.rint(pixels / 257)
    assert np.abs(decoded(tmp_path / f"a{suffix}", pixels, "uint16") - expected).max() <= 0


def test_photos__exif_orientation_is_ignored(tmp_path):
    path = str(tmp_path / "a.jpg")
    spec = oiio.ImageSpec(32, 16, 3, "uint8")
    spec.attribute("Orientation", 6)
    out = oiio.ImageOutput.create(path)
    out.open(path, spec)
    pixels = np.zeros((16, 32, 3), np.uint8)
    pixels[:, :16] = 200
    out.write_image(pixels)
    out.close()
    assert oiio.ImageInput.open(path).spec().getattribute("Orientation") == 6
    got = decode_photo(path, "here")
    assert got.shape == (16, 32, 3) and got[:, :12].min() > 190 and got[:, 20:].max() < 10


def test_photos__floats_are_refused_by_name(tmp_path):
    write_photo(tmp_path / "a.tif", np.ones((4, 4, 3), np.float32), "float")
    with pytest.raises(UnsupportedScan, match="samples of type float"):
        decode_photo(str(tmp_path / "a.tif"), "here")


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_photos__every_truncation_is_refused(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    write_photo(path, picture(3))
    whole = path.read_bytes()
    # libpng and libjpeg forgive what lies behind the last pixel.
    for n in range(0, len(whole) - 30, 17):
        path.write_bytes(whole[:n])
        with pytest.raises(InvalidScan, match="here"):
            decode_photo(str(path), "here")


def test_photos__a_header_that_promises_too_much_is_refused(tmp_path):
    path = tmp_path / "a.png"
    write_photo(path, picture(3))
    content = bytearray(path.read_bytes())
    content[16:24] = struct.pack(">II", MAX_SIDE_PX + 1, MAX_SIDE_PX + 1)
    path.write_bytes(content)
    with pytest.raises(InvalidScan, match="here"):
        decode_photo(str(path), "here")


def test_photos__what_comes_back_is_writable_and_contiguous(tmp_path):
    got = decoded(tmp_path / "a.png", picture(1))
    assert got.flags.writeable and got.flags.c_contiguous and got.dtype == np.uint8
