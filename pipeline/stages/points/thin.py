"""Points in file order -> which of them are kept, where a share of them is asked for."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.geometry.thinning import thinned
from pipeline.stages.points.kept import KEPT, finite_pieces, n_parts, n_rows, part_range, part_rows
from pipeline.summaries import Counted, ScanRead
from storage.errors import InvalidScan
from storage.work import arrays, work


@dataclass(frozen=True)
class Thin:
    """A task a part of the file. Array: kept (n_rows,) bool, whether each point of the ingest is one of the share
    `density` < 1 of those with a finite position that is kept, evenly spread within its part (`thinned`). A scan of one
    part is thinned as a whole.

    Raises: InvalidScan where none is left.
    """

    ingest: Path
    density: float
    name = "thin"

    def init(self, folder: Path) -> int:
        arrays.create(folder, KEPT, (n_rows(self.ingest),), "bool", (part_rows(self.ingest),))
        return n_parts(self.ingest)

    def run(self, folder: Path, index: int) -> Counted:
        start, stop = part_range(self.ingest, index)
        pieces = list(finite_pieces(self.ingest, start, stop, ("position",)))
        place = np.concatenate([piece["point"] for piece in pieces])
        keep = thinned(np.concatenate([piece["position"] for piece in pieces]), self.density)
        kept = np.zeros(stop - start, bool)
        kept[place[keep] - start] = True
        arrays.write(folder, KEPT, start, kept)
        return Counted(int(np.count_nonzero(keep)))

    def finalise(self, folder: Path, results: list[Counted]) -> Counted:
        n = sum(r.n_splats for r in results)
        if not n:
            n_points = work.summary(self.ingest, ScanRead).n_points
            found = f"{self.density:g} keeps none of {n_points:,} points"
            raise InvalidScan("density", found, f"{1 / n_points:.2g} and more")
        return Counted(n)
