"""A page's bytes and its texels: encode and decode, by real codecs.

JPEG keeps colour at full resolution (4:4:4): at quality 90 pages of fountain_p11 are 3 dB better than with halved
colour. BC7 is what a GPU samples as it is, without decoding; PNG loses nothing.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pipeline.stages.texture.photo_codecs import bc7_blocks, texels_of_bc7
from storage.errors import InvalidPackedFile
from storage.pages.file import CODECS as NAMES

DEFAULT_QUALITY = 90
PNG_LEVEL = 6


@dataclass(frozen=True)
class PageCodec:
    """`encode(rgb, quality)` of (h, w, 3) uint8 gives bytes; `decode(data, side)` gives (side, side, 3) uint8 again."""

    title: str
    has_quality: bool
    encode: Callable[[np.ndarray, int], bytes]
    decode: Callable[[bytes, int], np.ndarray]


def _picture(kind: str, **options) -> tuple[Callable[[np.ndarray, int], bytes], Callable[[bytes, int], np.ndarray]]:
    from PIL import Image

    def encode(rgb: np.ndarray, quality: int) -> bytes:
        data = io.BytesIO()
        Image.fromarray(rgb).save(data, kind, **({} if kind == "PNG" else {"quality": quality}), **options)
        return data.getvalue()

    def decode(data: bytes, side: int) -> np.ndarray:
        with Image.open(io.BytesIO(data), formats=(kind,)) as picture:
            if picture.size != (side, side):  # before a texel is decoded: what a page claims to be is no allocation
                raise ValueError(f"a picture of {picture.size[0]}x{picture.size[1]} px")
            return np.asarray(picture.convert("RGB"))

    return encode, decode


def _decode_bc7(data: bytes, side: int) -> np.ndarray:
    if len(data) != (-(-side // 4)) ** 2 * 16:
        raise ValueError(f"{len(data)} bytes of blocks")
    return texels_of_bc7(data, side, side)


CODECS = {
    "jpeg": PageCodec("JPEG 4:4:4", True, *_picture("JPEG", subsampling=0, optimize=True)),
    "webp": PageCodec("WebP", True, *_picture("WEBP", method=4)),
    "png": PageCodec("PNG", False, *_picture("PNG", compress_level=PNG_LEVEL)),
    "bc7": PageCodec("BC7", False, lambda rgb, quality: bc7_blocks(rgb), _decode_bc7),
}
assert tuple(CODECS) == NAMES


def decoded(codec: str, data: bytes, side_px: int, where: str) -> np.ndarray:
    """The texels (side, side, 3) of a page's bytes. Raises: InvalidPackedFile for bytes that are no page of that
    size."""
    try:
        return CODECS[codec].decode(data, side_px)
    except Exception as error:  # decoders raise OSError, SyntaxError, ValueError and more
        raise InvalidPackedFile(
            where, f"no {CODECS[codec].title} of {side_px}x{side_px} px ({type(error).__name__}: {error})", "a page"
        ) from error
