"""Photographs through OpenImageIO: the header alone, or the pixels as 8-bit sRGB.

EXIF orientation is ignored, as COLMAP ignores it: pixels stay in sensor order. Alpha is dropped without being
multiplied in. OpenImageIO's own limits stand guard over hostile headers.
"""

from __future__ import annotations

import numpy as np
import OpenImageIO as oiio

from storage.errors import InvalidScan, UnsupportedScan

MAX_PHOTO_MB = 1024  # a photograph of 18900 x 18900 pixels
MAX_SIDE_PX = 65_535  # what a JPEG can hold
MAX_CHANNELS = 8

oiio.attribute("limits:imagesize_MB", MAX_PHOTO_MB)
oiio.attribute("limits:resolution", MAX_SIDE_PX)
oiio.attribute("limits:channels", MAX_CHANNELS)

_INTEGER_SAMPLES = (oiio.UINT8, oiio.UINT16)


def _open(path: str, where: str) -> oiio.ImageInput:
    config = oiio.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)  # else RGB comes multiplied by alpha
    photo = oiio.ImageInput.open(path, config)
    if photo is None:
        raise InvalidScan(where, "an unreadable photo", "a whole JPEG, PNG or TIFF")
    return photo


def photo_size(path: str, where: str) -> tuple[int, int]:
    """Width and height in pixels, from the header alone.

    Raises: InvalidScan where the header cannot be read, UnsupportedScan for samples that are not 8 or 16 bits.
    """
    photo = _open(path, where)
    spec = photo.spec()
    photo.close()
    if spec.format.basetype not in _INTEGER_SAMPLES:
        raise UnsupportedScan(where, f"a photo with samples of type {spec.format}", "8 or 16 bits a sample")
    return spec.width, spec.height


def decode_photo(path: str, where: str) -> np.ndarray:  # (height, width, 3)
    """The pixels as uint8 sRGB; grey becomes RGB, 16 bits become 8, alpha is dropped.

    Raises: InvalidScan where the file is truncated or damaged, UnsupportedScan as `photo_size`.
    """
    photo_size(path, where)
    photo = _open(path, where)
    n_channels = photo.spec().nchannels
    pixels = photo.read_image(0, 0, 0, 3 if n_channels >= 3 else 1, "uint8")
    # A truncated JPEG gives grey pixels and an error, so the pixels alone prove nothing.
    damaged = photo.has_error
    photo.geterror()  # else it stays with the thread
    photo.close()
    if damaged or pixels is None:
        raise InvalidScan(where, "a damaged photo", "a whole JPEG, PNG or TIFF")
    return np.ascontiguousarray(np.broadcast_to(pixels, (*pixels.shape[:2], 3)))
