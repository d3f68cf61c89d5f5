"""A stratified sample of a scan's points, as a folder that can stand for the partition's."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.stages.partition import columns_of
from storage import arrays, work

CELL = 512  # points that stay together: a compact piece of surface, whose inner points keep their neighbours


@dataclass(frozen=True)
class SampledPartition:
    """One task. Arrays as the partition's: whole cells of CELL consecutive points, one from each of equal parts of the
    scan's order, dealt out to the blocks in turn, so that every block is a sample of the whole scan."""

    partition: Path
    n_wanted: int
    name = "sampled-partition"

    def init(self, folder: Path) -> int:
        n = len(self._rows())
        for name, dtype in columns_of(self.partition).items():
            arrays.create(folder, name, (n, *dtype.shape), str(dtype.base))
        return 1

    def run(self, folder: Path, index: int) -> dict:
        rows = self._rows()
        for name in columns_of(self.partition):
            column = arrays.opened(self.partition, name)
            cells = [np.asarray(column[at : at + CELL]) for at in rows[::CELL]]
            arrays.write(folder, name, 0, np.concatenate(cells)[: len(rows)])
        return {"n_splats": len(rows)}

    def finalise(self, folder: Path, results: list[dict]) -> dict:
        n, whole = results[0]["n_splats"], work.summary(self.partition)
        bounds = [arrays.read(folder, "position", *arrays.block_range(i, n)) for i in range(arrays.n_blocks(n))]
        return {"n_splats": n, "origin": whole["origin"], "block_low": [b.min(axis=0).tolist() for b in bounds],
                "block_high": [b.max(axis=0).tolist() for b in bounds]}

    def _rows(self) -> np.ndarray:
        """Which points of the partition, cell by cell."""
        n = work.summary(self.partition)["n_splats"]
        n_cells = n // CELL
        n_taken = min(n_cells, -(-self.n_wanted // CELL))
        if n_taken < 2:
            return np.arange(min(n, self.n_wanted))
        cells = (np.arange(n_taken) + 0.5) * n_cells / n_taken
        n_blocks = arrays.n_blocks(n_taken * CELL)
        dealt = np.argsort(np.arange(n_taken) % n_blocks, kind="stable")
        return (cells.astype(np.int64)[dealt, None] * CELL + np.arange(CELL)).ravel()
