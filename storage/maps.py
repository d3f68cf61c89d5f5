"""Maps of laser stations in a packed file: what the header says of each, and what it may say."""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite

from storage.json_fields import numbers, typed

NO_MAP, MOST_MAPS = 255, 127  # of `station`: a splat without a map; with one its number below MOST_MAPS, and
IN_PART = 128  # added where the map shows too little of the splat to be looked up from aside
MAP_ROWS = 16  # heights of maps are whole numbers of so many rows, so that they can be halved four times
MOST_MAP_ROWS = 2720  # six times as wide: no WebP is wider


@dataclass(frozen=True)
class StoredMap:
    """What a laser station saw, as the pictures of the packed file are to be read (docs/FORMAT.md, Map)."""

    centre: tuple[float, float, float]  # of the station, absolute, in the scan's unit
    height_px: int  # of its map, six times as wide
    nearest: float  # distance that depth code 1 stands for
    depth_step: float  # of the logarithm of the distance, a code
    color_bytes: int  # of its WebP picture

    @staticmethod
    def from_json(data: dict) -> StoredMap:
        return typed(StoredMap, data, centre=numbers(data["centre"], 3))

    @property
    def n_texels(self) -> int:
        return 6 * self.height_px**2

    @property
    def is_sound(self) -> bool:
        """Whether its numbers are such that pictures can be read with them."""
        return (
            all(map(isfinite, self.centre))
            and all(isfinite(x) and x > 0 for x in (self.nearest, self.depth_step))
            and self.height_px in range(MAP_ROWS, MOST_MAP_ROWS + 1, MAP_ROWS)
            and self.color_bytes >= 1
        )
