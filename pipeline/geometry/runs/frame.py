"""Where a hexagonal close packed grid lies in a scan."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class GridFrame:
    """The grid that the points of a volume's surface are cells of: where its cell (0, 0, 0) lies, and how it is turned."""

    origin: tuple[float, float, float]
    turn: tuple[float, ...]  # (9,) rows of the matrix from its axes to the volume's
