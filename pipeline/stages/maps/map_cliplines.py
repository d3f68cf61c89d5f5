"""Cliplines of splats that reach over a silhouette, as the map that textures each of them shows it.

The alpha of the panoramic system trims splats fragment by fragment (CEIG 2019, section 3.1); a line a splat does most
of that in 12 bits, and needs no map where it is drawn. Maps have all points of a scan, so they know its edges better
than the points that became splats.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.effects.cliplines.lines import best_lines, disc_points
from pipeline.effects.cliplines.stage import LEAST_GAIN, ClippedBlock
from pipeline.maps.choice import NO_STATION
from pipeline.maps.sample import Squares, foreign_points
from pipeline.maps.station_map import StationMap
from pipeline.stages.maps.resample_maps import MappedSplats
from pipeline.summaries import Clipped
from storage.work import arrays

ROWS = 2048  # splats at a time


@dataclass(frozen=True)
class MapCliplines:
    """A task a block. Arrays as those of `Cliplines`: has_clipline (n,) bool, clipline (n,) uint32."""

    of: MappedSplats
    name = "map-cliplines"

    def init(self, folder: Path) -> int:
        n = self.of.n_splats
        arrays.create(folder, "has_clipline", (n,), "bool")
        arrays.create(folder, "clipline", (n,), "uint32")
        return arrays.n_blocks(n)

    def run(self, folder: Path, index: int) -> ClippedBlock:
        start, stop = arrays.block_range(index, self.of.n_splats)
        splats = self.of.block(start, stop)
        best = splats.best_stations()
        code, has = np.zeros(stop - start, np.uint32), np.zeros(stop - start, bool)
        for station in np.unique(best[best != NO_STATION]):
            station_map = self.of.map_of(int(station))
            squares, rows = splats.squares(station_map), np.flatnonzero(best == station)
            for at in range(0, len(rows), ROWS):
                some = rows[at : at + ROWS]
                code[some], has[some] = _lines(station_map, squares.only(some))
        arrays.write(folder, "has_clipline", start, has)
        arrays.write(folder, "clipline", start, code)
        return ClippedBlock(n_splats=len(has), n_clipped=int(has.sum()))

    def finalise(self, folder: Path, results: list[ClippedBlock]) -> Clipped:
        return Clipped(sum(r.n_clipped for r in results))


def _lines(station_map: StationMap, squares: Squares) -> tuple[np.ndarray, np.ndarray]:
    foreign = foreign_points(station_map, squares, disc_points()[0])
    code, has = np.zeros(len(foreign), np.uint32), np.zeros(len(foreign), bool)
    some = np.flatnonzero(foreign.any(axis=1) & ~foreign.all(axis=1))
    code[some], gain = best_lines(foreign[some])
    has[some] = gain >= LEAST_GAIN
    return np.where(has, code, 0), has
