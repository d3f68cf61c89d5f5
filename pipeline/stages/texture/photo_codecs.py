"""What photographs are compressed by elsewhere, by real encoders, and what it leaves of them.

Block codes (BC1, BC7) are textures that a GPU samples as they are; their bytes hold MIP_LEVELS levels, as the paper
counts them. JPEG, WebP and AVIF are pictures: a renderer must decode them whole before it can draw.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from types import ModuleType

import numpy as np

from storage.errors import ResourceExhausted

MIP_LEVELS = 5  # HPG 2021, Table 1
BC1_LEVEL = 10  # of 18: the highest gains 0.14 dB for five times the time (a photograph of fountain_p11)
BC7_EFFORT = 4  # of 4: 0.5 dB above 0 at three times the time (the same)
AVIF_SPEED = 8  # of 10


@dataclass(frozen=True)
class PhotoCodec:
    """`coded(rgb, budget_bytes)` gives the decoded picture (h, w, 3) uint8 and the bytes it took; block codes and raw
    pixels know no budget."""

    title: str
    encoder: str
    renderable: bool
    coded: Callable[[np.ndarray, float | None], tuple[np.ndarray, int]]


def halved(rgb: np.ndarray, times: int) -> np.ndarray:
    """The mip level `times` below: means over the pixels that each covers, in sRGB as the baseline filters."""
    from PIL import Image

    for _ in range(times):
        height, width = rgb.shape[:2]
        rgb = np.asarray(Image.fromarray(rgb).resize((max(1, width // 2), max(1, height // 2)), Image.Resampling.BOX))
    return rgb


def texture_bytes(width_px: int, height_px: int, bytes_of: Callable[[int, int], int]) -> int:
    """Bytes of a texture with its mip levels.

    >>> texture_bytes(16, 16, lambda w, h: 3 * w * h)
    1023
    """
    sizes = [(max(1, width_px >> level), max(1, height_px >> level)) for level in range(MIP_LEVELS)]
    return sum(bytes_of(*size) for size in sizes)


def _raw(rgb: np.ndarray, _) -> tuple[np.ndarray, int]:
    return rgb, texture_bytes(rgb.shape[1], rgb.shape[0], lambda w, h: 3 * w * h)


def _blocks(encode: Callable[[bytes, int, int], bytes], decode: Callable[[bytes, int, int], bytes], block_bytes: int):
    def coded(rgb: np.ndarray, _) -> tuple[np.ndarray, int]:
        height, width = rgb.shape[:2]
        n_bytes = texture_bytes(width, height, lambda w, h: block_bytes * -(-w // 4) * -(-h // 4))
        return _texels(_block_bytes(rgb, encode), height, width, decode), n_bytes

    return coded


def _block_bytes(rgb: np.ndarray, encode: Callable[[bytes, int, int], bytes]) -> bytes:
    height, width = rgb.shape[:2]
    # Whole blocks, edges repeated: one of the encoders takes nothing else.
    whole = np.pad(rgb, ((0, -height % 4), (0, -width % 4), (0, 0)), mode="edge")
    rgba = np.dstack([whole, np.full(whole.shape[:2], 255, np.uint8)])
    return encode(rgba.tobytes(), whole.shape[1], whole.shape[0])


def _texels(blocks: bytes, height: int, width: int, decode: Callable[[bytes, int, int], bytes]) -> np.ndarray:
    rows, columns = height + -height % 4, width + -width % 4
    bgra = np.frombuffer(decode(blocks, columns, rows), np.uint8).reshape(rows, columns, 4)
    return bgra[:height, :width, 2::-1].copy()


def bc7_blocks(rgb: np.ndarray) -> bytes:
    """A picture (h, w, 3) uint8 as BC7, 16 bytes for each 4x4 texels."""
    return _block_bytes(rgb, _bc7)


def texels_of_bc7(blocks: bytes, height: int, width: int) -> np.ndarray:
    """The picture (h, w, 3) uint8 of BC7 blocks."""
    return _texels(blocks, height, width, _decode_bc7)


def _package(name: str) -> ModuleType:
    """One of those that only the evaluation needs. Raises ResourceExhausted where it is not installed."""
    try:
        return import_module(name)
    except ImportError:
        raise ResourceExhausted(f"package {name}", "not installed", "pip install 'splatpress[evaluate]'") from None


# Decoded by texture2ddecoder: etcpak's own decoder crashed (0.9.15), bc7enc's is a loop in Python.
def _bc1(rgba: bytes, width: int, height: int) -> bytes:
    return _package("bc7enc").pack_dds(rgba, width, height, "DXT1", level=BC1_LEVEL)


def _fast_bc1(rgba: bytes, width: int, height: int) -> bytes:
    return _package("etcpak").compress_bc1(rgba, width, height)


def _bc7(rgba: bytes, width: int, height: int) -> bytes:
    etcpak = _package("etcpak")
    effort = etcpak.BC7CompressBlockParams()
    effort.init_linear_weights()  # the error in RGB, which is what PSNR counts
    effort.m_uber_level = BC7_EFFORT
    return etcpak.compress_bc7(rgba, width, height, effort)


def _decode_bc1(blocks: bytes, width: int, height: int) -> bytes:
    return _package("texture2ddecoder").decode_bc1(blocks, width, height)


def _decode_bc7(blocks: bytes, width: int, height: int) -> bytes:
    return _package("texture2ddecoder").decode_bc7(blocks, width, height)


def _picture(kind: str, **options):
    def coded(rgb: np.ndarray, budget_bytes: float | None) -> tuple[np.ndarray, int]:
        """At the highest quality within the budget; at the lowest where even that exceeds it."""
        from PIL import Image

        low, high, best = 1, 100, None
        while low <= high:
            quality = (low + high) // 2
            data = io.BytesIO()
            Image.fromarray(rgb).save(data, kind, quality=quality, **options)
            if data.tell() <= budget_bytes:
                best, low = data, quality + 1
            else:
                best, high = best or (data if quality == 1 else None), quality - 1
        return np.asarray(Image.open(best).convert("RGB")), best.tell()

    return coded


CODECS = {
    "raw": PhotoCodec("RGB", "none", True, _raw),
    "bc7": PhotoCodec("BC7", f"etcpak (bc7enc, effort {BC7_EFFORT})", True, _blocks(_bc7, _decode_bc7, 16)),
    "bc1": PhotoCodec("BC1", f"bc7enc-py (rgbcx, level {BC1_LEVEL})", True, _blocks(_bc1, _decode_bc1, 8)),
    "bc1-fast": PhotoCodec("BC1, fast encoder", "etcpak", True, _blocks(_fast_bc1, _decode_bc1, 8)),
    "jpeg": PhotoCodec("JPEG", "Pillow (libjpeg-turbo)", False, _picture("JPEG", optimize=True)),
    "webp": PhotoCodec("WebP", "Pillow (libwebp)", False, _picture("WEBP")),
    "avif": PhotoCodec(
        "AVIF", f"Pillow (libavif, speed {AVIF_SPEED})", False, _picture("AVIF", speed=AVIF_SPEED, max_threads=1)
    ),
}
