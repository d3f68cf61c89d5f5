"""What may be asked of reading a scan, beside its path."""

from __future__ import annotations

import math
from dataclasses import dataclass

from pipeline.readers.attributes.marks import left_out

STATION_WORDS = "three finite numbers as x,y,z, in the scan's own coordinates"


def canonical_station(text: str) -> str:
    """The one text for a scanner's position. Raises ValueError.

    >>> canonical_station(" 1, 2.50,-3e2")
    '1,2.5,-300'
    """
    if not text.strip():
        return ""
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != 3 or not all(map(math.isfinite, numbers)):
        raise ValueError(f"station is {text!r}; allowed: {STATION_WORDS}")
    return ",".join(f"{n:.17g}" if float(f"{n:g}") != n else f"{n:g}" for n in numbers)


@dataclass(frozen=True)
class ReadOptions:
    """Texts as knobs have them; "" leaves the choice to the scan."""

    marked_points: str = ""  # as marks.canonical_marks writes it
    station: str = ""  # x,y,z: all points were seen from there
    sparse_model: str = ""  # the folder of the COLMAP model to use, as "sparse/1"
    height_scale: float = 1.0  # heights are multiplied by it

    @property
    def left_out(self) -> frozenset[str]:
        return left_out(self.marked_points)

    @property
    def station_xyz(self) -> tuple[float, float, float] | None:
        """The scanner's position, where one was given."""
        if not self.station:
            return None
        x, y, z = (float(part) for part in canonical_station(self.station).split(","))
        return x, y, z
