"""A station's map as the packed file holds it: colours as a WebP picture, distances as codes of even steps of their
logarithm, of which each row stores what it is above the row before.

A step of depth is as fine as the depth test needs (sample.py), no finer: on a scan of a room 10 bits take 2/3 of the
bytes of 13. Down the columns differences are smaller than along the rows: walls stand upright.
"""

from __future__ import annotations

import io
from bisect import bisect_left
from dataclasses import dataclass
from functools import cache

import numpy as np
from PIL import Image, UnidentifiedImageError

from pipeline.maps.sample import SHARE_OF_DISTANCE
from pipeline.maps.station_map import NOTHING, StationMap, decode_distances
from pipeline.numerics.accuracy import psnr_db
from storage.errors import InvalidPackedFile
from storage.maps import StoredMap

VOID = 0  # the code of a texel that shows no surface; code c >= 1 is nearest exp((c - 1) step)
# Of WebP. Lossy ones halve the resolution of hues, which some pictures do not bear; these are kept without loss once
# their levels are rounded to whole multiples: conference_room at 100 has 39.5 dB in 326 kB, with every sixth level 43.3
# in 448, with all 938.
LOSSY = tuple(range(30, 101, 5))
MULTIPLES = {101: 6, 102: 4, 103: 2, 104: 1}
METHOD = 4  # of WebP: 6 takes four times as long for 2 % fewer bytes


@dataclass(frozen=True)
class MapPictures:
    """The arrays of one map, and what they lose."""

    stored: StoredMap
    color: np.ndarray  # (color_bytes,) uint8: a WebP picture
    depth_low: np.ndarray  # (h, 6 h) uint8
    depth_high: np.ndarray  # (h, 6 h) uint8
    quality: int  # of LOSSY, or a key of MULTIPLES
    squared_error: float  # of all channels of all texels that show a surface, 1.0 is white
    n_values: int


def encode_map(station_map: StationMap, levels: np.ndarray, target_psnr_db: float) -> MapPictures:
    """The pictures of a map whose light is brought to `levels` (256, 3): the fewest bytes whose colours keep
    `target_psnr_db` where there is a surface."""
    frame, covered = station_map.frame, station_map.depth != NOTHING
    color = np.empty((*covered.shape, 3), np.uint8)
    for k in range(3):
        color[..., k] = np.rint(levels[:, k])[station_map.color[..., k]]
    color = filled(color, covered)
    low, high = encode_codes(codes_of(station_map))

    @cache
    def coded(quality: int) -> tuple[bytes, float]:
        data = _webp(color, quality)
        off = _pixels(data)[covered].astype(np.float64) - color[covered]
        return data, float((off**2).sum()) / 255**2

    n_values = 3 * int(covered.sum())

    def keeps(quality: int) -> bool:
        return n_values == 0 or psnr_db(coded(quality)[1], n_values) >= target_psnr_db

    qualities = LOSSY if keeps(LOSSY[-1]) else tuple(MULTIPLES)
    quality = qualities[min(bisect_left(qualities, True, key=keeps), len(qualities) - 1)]
    data, error = coded(quality)
    stored = StoredMap(frame.centre, frame.height_px, frame.nearest, SHARE_OF_DISTANCE, len(data))
    return MapPictures(stored, np.frombuffer(data, np.uint8), low, high, quality, error, n_values)


def decode_colors(stored: StoredMap, color: np.ndarray, where: str) -> np.ndarray:
    """The colours (h, 6 h, 3) uint8 of a map's picture, which comes from a file that may lie.

    Raises: InvalidPackedFile naming `where`.
    """
    try:
        with Image.open(io.BytesIO(color.tobytes()), formats=["WEBP"]) as picture:
            if picture.size != (6 * stored.height_px, stored.height_px):  # before anything so large is taken
                raise ValueError(f"a picture of {picture.size} pixels")
            return np.array(picture.convert("RGB"))
    except (OSError, ValueError, UnidentifiedImageError, Image.DecompressionBombError) as error:
        wanted = f"a WebP picture of {6 * stored.height_px} x {stored.height_px} pixels"
        raise InvalidPackedFile(where, f"map_colors: {error}"[:300], wanted) from error


def codes_of(station_map: StationMap) -> np.ndarray:
    """Depth codes (h, 6 h) uint16 of a map.

    Guarantees: a decoded distance is off by half of SHARE_OF_DISTANCE at most, and by half a step of the map's own.
    """
    frame = station_map.frame
    code = np.rint(np.log(decode_distances(station_map.depth, frame) / frame.nearest) / SHARE_OF_DISTANCE)
    return np.where(station_map.depth == NOTHING, VOID, code.clip(0, 65534) + 1).astype(np.uint16)


def encode_codes(codes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Low and high bytes (h, 6 h) uint8 of what codes are above those of the row before: 0, -1, 1, -2 ... as 0, 1, 2, 3
    ..."""
    above = np.diff(codes, axis=0, prepend=np.zeros((1, codes.shape[1]), np.uint16)).view(np.int16).astype(np.int32)
    folded = np.where(above < 0, -2 * above - 1, 2 * above).astype(np.uint16)
    return (folded & 255).astype(np.uint8), (folded >> 8).astype(np.uint8)


def decode_codes(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """The codes (h, 6 h) uint16 that `encode_codes` was given; any bytes decode to some."""
    folded = low.astype(np.uint16) | high.astype(np.uint16) << 8
    above = (folded >> 1) ^ -(folded & 1).astype(np.uint16)
    return np.cumsum(above, axis=0, dtype=np.uint16)


def filled(picture: np.ndarray, known: np.ndarray) -> np.ndarray:
    """A picture (h, w, 3) uint8 whose texels that are not `known` take after those around them, as coarse means of what
    is known (pull and push; Gortler et al., The Lumigraph, 1996): what WebP takes the fewest bytes for, and mixes no
    black into."""
    return np.rint(_filled(picture.astype(np.float32), known)).astype(np.uint8)


def _filled(picture: np.ndarray, known: np.ndarray) -> np.ndarray:
    height, width = known.shape
    if known.all() or not known.any() or min(height, width) == 1:
        return picture
    mean, share = halved(picture, known)
    coarse = _filled(mean, share > 0).repeat(2, axis=0).repeat(2, axis=1)[:height, :width]
    return np.where(known[..., None], picture, coarse)


def halved(picture: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Means (ceil h/2, ceil w/2, 3) float32 of 2x2 texels, weighted by `known`, a share or a flag; and the means of
    that."""
    weight = known.astype(np.float32)
    height, width = (-(-n // 2) * 2 for n in weight.shape)
    pad = (height - weight.shape[0], width - weight.shape[1])
    weight = np.pad(weight, ((0, pad[0]), (0, pad[1])))
    picture = np.pad(picture.astype(np.float32), ((0, pad[0]), (0, pad[1]), (0, 0)))
    fours = (slice(0, None, 2), slice(1, None, 2))
    total = np.sum([weight[i, j] for i in fours for j in fours], axis=0)
    light = np.sum([picture[i, j] * weight[i, j][..., None] for i in fours for j in fours], axis=0)
    return light / np.maximum(total, 1e-9)[..., None], total / np.float32(4)


def _webp(color: np.ndarray, quality: int) -> bytes:
    stream, multiple = io.BytesIO(), MULTIPLES.get(quality)
    if multiple:
        color = np.minimum(np.rint(color / multiple) * multiple, 255).astype(np.uint8)
    Image.fromarray(color).save(stream, "WEBP", quality=min(quality, 100), lossless=multiple is not None, method=METHOD)
    return stream.getvalue()


def _pixels(data: bytes) -> np.ndarray:
    with Image.open(io.BytesIO(data)) as picture:
        return np.array(picture.convert("RGB"))
