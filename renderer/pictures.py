"""Pictures in and out of files: uint8 sRGB (height, width, 3), through OpenImageIO."""

from __future__ import annotations

import base64
import io
import tempfile
from pathlib import Path

import numpy as np
import OpenImageIO as oiio

from pipeline.numerics.srgb import LINEAR_OF_LEVEL, levels_of_linear
from renderer.files import write_whole
from storage.errors import ResourceExhausted

PHOTO_QUALITY = 92
PNG_LEVEL = 3  # a third of the time of the default, 6, for 7 % more bytes (views of fountain_p11)
EMBEDDED_QUALITY = 82
EMBEDDED_WIDTH_PX = 1024
MIN_WIDTH_PX = 16


def save_picture(path: Path, rgb: np.ndarray) -> None:
    """Write a PNG, or by the ending .jpg a JPEG; it appears under its name only when it is whole."""
    path = Path(path)
    write_whole(path, _encoded(rgb, "jpeg" if path.suffix == ".jpg" else "png", PHOTO_QUALITY))


def on_background(rgb: np.ndarray, alpha: np.ndarray, background: tuple[int, int, int] | None = None) -> np.ndarray:
    """A picture (height, width, 3) with its alpha (height, width), uint8 or where it is covered, or opaque on a colour,
    mixed in linear light."""
    if alpha.dtype == bool:
        alpha = np.where(alpha, np.uint8(255), np.uint8(0))
    if background is None:
        return np.dstack([rgb, alpha])
    made = np.where(alpha[..., None], rgb, np.array(background, np.uint8))
    mixed = (alpha > 0) & (alpha < 255)
    share = alpha[mixed][:, None] / 255
    light = share * LINEAR_OF_LEVEL[rgb[mixed]] + (1 - share) * LINEAR_OF_LEVEL[np.array(background, np.uint8)]
    made[mixed] = levels_of_linear(light)
    return made


def save_animation(path: Path, frames: list[np.ndarray], frames_a_second: int = 25) -> None:
    """Frames (height, width, 3 or 4) as an endless WebP; it appears under its name only when it is whole."""
    from PIL import Image

    first, *others = (Image.fromarray(frame) for frame in frames)
    made = io.BytesIO()
    first.save(
        made, "WEBP", save_all=True, append_images=others, duration=round(1000 / frames_a_second), loop=0, quality=80,
        minimize_size=False,
    )  # fmt: skip
    write_whole(Path(path), made.getvalue())


def resized(rgb: np.ndarray, width_px: int, height_px: int) -> np.ndarray:
    """A picture at another size, filtered over the pixels that each new one covers; itself where the size is right."""
    if rgb.shape[:2] == (height_px, width_px):
        return rgb
    region = oiio.ROI(0, width_px, 0, height_px, 0, 1, 0, 3)
    picture = oiio.ImageBuf(np.ascontiguousarray(rgb))
    # A tent: a quarter of the time of OpenImageIO's default, Lanczos, and it cannot overshoot.
    return oiio.ImageBufAlgo.resize(picture, filtername="triangle", roi=region).get_pixels(oiio.UINT8)


def jpeg_within(rgb: np.ndarray, max_bytes: int) -> bytes:
    """The picture as a JPEG of at most `max_bytes`, made narrower until it fits; not below MIN_WIDTH_PX."""
    height, width = rgb.shape[:2]
    narrow = min(width, EMBEDDED_WIDTH_PX)
    while True:
        data = _encoded(resized(rgb, narrow, max(1, round(height * narrow / width))), "jpeg", EMBEDDED_QUALITY)
        if len(data) <= max_bytes or narrow <= MIN_WIDTH_PX:
            return data
        # Bytes go with area at most; smaller pictures hold more detail a pixel, hence the 5 % less.
        narrow = max(MIN_WIDTH_PX, int(narrow * 0.95 * (max_bytes / len(data)) ** 0.5))


def png_uri(rgb: np.ndarray) -> str:
    """A PNG as a data URI."""
    return data_uri(_encoded(rgb, "png"), "image/png")


def data_uri(data: bytes, media_type: str) -> str:
    """Bytes as a data URI, in base64."""
    return f"data:{media_type};base64,{base64.b64encode(data).decode('ascii')}"


def _encoded(rgb: np.ndarray, kind: str, quality: int = 0) -> bytes:
    """The bytes of a picture as "jpeg" or "png"; `quality`, out of 100, is for JPEG alone."""
    buffer = oiio.ImageBuf(np.ascontiguousarray(rgb))
    if kind == "jpeg":
        buffer.specmod().attribute("Compression", f"jpeg:{quality}")
    else:
        buffer.specmod().attribute("png:compressionLevel", PNG_LEVEL)
    with tempfile.TemporaryDirectory() as folder:  # OpenImageIO's Python binding writes to files alone
        path = Path(folder) / "picture"
        if not buffer.write(str(path), oiio.UINT8, kind):
            raise ResourceExhausted(folder, f"a picture that could not be written ({buffer.geterror().strip()})")
        return path.read_bytes()
