"""Large pictures of a stage in tiles that are compressed: for what repeats itself, and is looked at in parts by many
tasks.

NAME.tiles is the tiles' zstd frames, row by row; NAME.tiles.json, written last, has shape, dtype and where each frame
begins.
"""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
from numcodecs.zstd import Zstd

from storage import place
from storage.whole import whole
from storage.work import work

TILE = 256  # to a side: 768 kB of three float32, unpacked in 0.4 ms
LEVEL = 1  # a picture of nearest points is 6 to 7.5 times smaller at 1 and at 3, and takes 1.3 times as long at 3


def store_tiles(folder: Path, name: str, picture: np.ndarray) -> None:
    """A picture (h, w, channels), there under its name whole or not at all."""
    height, width, _ = picture.shape
    frames = [
        Zstd(LEVEL).encode(np.ascontiguousarray(picture[top : top + TILE, left : left + TILE]))
        for top in range(0, height, TILE)
        for left in range(0, width, TILE)
    ]
    with whole(folder / f"{name}.tiles") as partial:
        partial.write_bytes(b"".join(frames))
    begin = np.cumsum([0, *map(len, frames)]).tolist()
    about = {"shape": list(picture.shape), "dtype": str(picture.dtype), "begin": begin}
    work.write_json(folder / f"{name}.tiles.json", about)


def shape_of(folder: Path, name: str) -> tuple[int, int, int]:
    """Of a picture: height, width, channels."""
    return tuple(_about(folder, name)["shape"])


def read_tiles(folder: Path, name: str, top: int, bottom: int, left: int, right: int) -> np.ndarray:
    """Rows top..bottom and columns left..right of a picture, which must lie in it; only tiles that these touch are
    read."""
    about = _about(folder, name)
    height, width, channels = about["shape"]
    assert 0 <= top < bottom <= height and 0 <= left < right <= width
    result = np.empty((bottom - top, right - left, channels), about["dtype"])
    for i in range(top // TILE, -(-bottom // TILE)):
        for j in range(left // TILE, -(-right // TILE)):
            y, x = (slice(max(a, k * TILE), min(b, (k + 1) * TILE)) for a, b, k in ((top, bottom, i), (left, right, j)))
            tile = _tile(folder, name, about, i, j)
            inside = tile[y.start - i * TILE : y.stop - i * TILE, x.start - j * TILE : x.stop - j * TILE]
            result[y.start - top : y.stop - top, x.start - left : x.stop - left] = inside
    return result


def _tile(folder: Path, name: str, about: dict, i: int, j: int) -> np.ndarray:
    height, width, channels = about["shape"]
    at = i * -(-width // TILE) + j
    begin, end = about["begin"][at : at + 2]
    with open(place.here(folder / f"{name}.tiles"), "rb") as file:
        file.seek(begin)
        frame = file.read(end - begin)
    shape = min(TILE, height - i * TILE), min(TILE, width - j * TILE), channels
    return np.frombuffer(Zstd().decode(frame), about["dtype"]).reshape(shape)


@functools.lru_cache(maxsize=1024)
def _about(folder: Path, name: str) -> dict:
    return work.read_json(folder / f"{name}.tiles.json")
