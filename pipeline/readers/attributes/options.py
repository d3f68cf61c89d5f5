"""What may be asked of reading a scan, beside its path."""

from __future__ import annotations

import math
from dataclasses import dataclass

from pipeline.readers.attributes.marks import left_out

STATION_WORDS = "three finite numbers as x,y,z, in the scan's own coordinates, or ID=x,y,z;ID=x,y,z by a LAS file's point source ids"
MOST_SOURCE_IDS = 65_535

Position = tuple[float, float, float]


def canonical_station(text: str) -> str:
    """The one text for a scanner's position, or for those of several. Raises ValueError.

    >>> canonical_station(" 1, 2.50,-3e2")
    '1,2.5,-300'
    >>> canonical_station("7 = 1,2,3; 2=0,0,0")
    '2=0,0,0;7=1,2,3'
    """
    if not text.strip():
        return ""
    try:
        if "=" not in text:
            return _shown(_position(text))
        found: dict[int, Position] = {}
        for part in filter(str.strip, text.split(";")):
            id, _, position = part.partition("=")
            if int(id) in found or not 0 <= int(id) <= MOST_SOURCE_IDS:
                raise ValueError(id)
            found[int(id)] = _position(position)
        return ";".join(f"{id}={_shown(found[id])}" for id in sorted(found))
    except ValueError:
        raise ValueError(f"station is {text!r}; allowed: {STATION_WORDS}") from None


def _position(text: str) -> Position:
    x, y, z = (float(part) for part in text.split(","))
    if not all(map(math.isfinite, (x, y, z))):
        raise ValueError(text)
    return x, y, z


def _shown(position: Position) -> str:
    return ",".join(f"{n:.17g}" if float(f"{n:g}") != n else f"{n:g}" for n in position)


@dataclass(frozen=True)
class ReadOptions:
    """Texts as knobs have them; "" leaves the choice to the scan."""

    marked_points: str = ""  # as marks.canonical_marks writes it
    station: str = ""  # x,y,z: all points were seen from there; or by point source id, as canonical_station writes it
    sparse_model: str = ""  # the folder of the COLMAP model to use, as "sparse/1"
    height_scale: float = 1.0  # heights are multiplied by it

    @property
    def left_out(self) -> frozenset[str]:
        return left_out(self.marked_points)

    @property
    def station_xyz(self) -> Position | None:
        """The position of the scanner that saw all points, where one was given."""
        return _position(self.station) if self.station.strip() and "=" not in self.station else None

    @property
    def station_by_source(self) -> dict[int, Position]:
        """The positions of scanners by point source id, where they were given so."""
        if "=" not in self.station:
            return {}
        parts = (part.partition("=") for part in canonical_station(self.station).split(";"))
        return {int(id): _position(position) for id, _, position in parts}
