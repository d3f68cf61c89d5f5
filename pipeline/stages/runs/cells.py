"""Points of a brick -> its cells, their mean normals, and the runs that cover them; then the steps of normals for
all."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.geometry.hcp import centres_of, index_of, keys_of
from pipeline.geometry.normals import decode_normals, encode_normals
from pipeline.geometry.runs.bricks import inside, reaches
from pipeline.geometry.runs.cells import CANCELLED
from pipeline.geometry.runs.gaps import close_gaps
from pipeline.geometry.runs.normals import SAMPLE, learn_steps
from pipeline.geometry.runs.walks import neighbours_in_slice
from pipeline.stages.runs.found import CellsFilled, GridFound
from pipeline.stages.runs.grid import boxes_in_grid, in_grid
from pipeline.summaries import Points
from storage.work import arrays, work

LEAST_SAMPLE = 4096  # cells of each brick that steps are learned from, if it has them


@dataclass(frozen=True)
class BrickFilled:
    """What a task tells of its brick; errors in the scan's unit."""

    n_splats: int
    n_cells: int
    n_added: int
    n_decoded: int
    max_error: float
    error: float  # summed


@dataclass(frozen=True)
class RunCells:
    """A task a brick. Arrays by brick i: key_i (n,) int64; normal_i (n, 3) float32; point_i (n,) int64, the row of the
    nearest point; cell_i (m,) int32 and start_i (r + 1,) int64, the runs; of all codebook (32, 2) int8."""

    points: Path
    splats: Path  # whose normals are turned to who sees them
    grid: Path
    run_length: int
    closing: bool = True  # gaps between runs
    name = "run-cells"

    def init(self, folder: Path) -> int:
        return len(arrays.read(self.grid, "bricks"))

    def run(self, folder: Path, index: int) -> BrickFilled:
        found = self._points_of(arrays.read(self.grid, "bricks")[index])
        if not len(found.key):
            return BrickFilled(n_splats=0, n_cells=0, n_added=0, n_decoded=0, max_error=0.0, error=0.0)
        key, begin = np.unique(found.key, return_index=True)
        normal = _mean_normals(found.normal, begin)
        closed = close_gaps(key, self.run_length) if self.closing else close_gaps(key, self.run_length, enough=0.0)
        normal, point = _filled(closed.key, closed.is_added, normal, found.row[begin])
        rows = {
            "key": closed.key,
            "normal": normal.astype(np.float32),
            "point": point,
            "cell": closed.runs.cells,
            "start": closed.runs.start,
        }
        for name, values in rows.items():
            arrays.store(folder, f"{name}_{index}", values)
        self._store_sample(folder, index, normal[closed.runs.cells], closed.runs.start)
        return BrickFilled(
            n_splats=len(found.key),
            n_cells=len(key),
            n_added=int(closed.is_added.sum()),
            n_decoded=len(closed.runs.cells),
            max_error=float(np.sqrt(found.off.max())),
            error=float(np.sqrt(found.off).sum()),
        )

    def finalise(self, folder: Path, results: list[BrickFilled]) -> CellsFilled:
        some = [i for i, r in enumerate(results) if r.n_decoded]
        target = np.concatenate([arrays.read(folder, f"sample_{i}") for i in some])
        lengths = np.concatenate([np.diff(arrays.read(folder, f"sample_start_{i}")) for i in some])
        start = np.concatenate([[0], np.cumsum(lengths)])
        arrays.store(folder, "codebook", learn_steps(target.astype(np.float64), encode_normals(target), start))
        n_cells, n_points, n_decoded, n_added = (
            sum(getattr(r, name) for r in results) for name in ("n_cells", "n_splats", "n_decoded", "n_added")
        )
        return CellsFilled(
            n_splats=n_points,
            n_cells=n_cells,
            n_added=n_added,
            n_decoded=n_decoded,
            first_cell=tuple(np.cumsum([0, *(r.n_decoded for r in results)]).tolist()),
            max_error=max(r.max_error for r in results),
            mean_error=sum(r.error for r in results) / n_points,
            hit_rate=n_points / n_cells,
        )

    def _points_of(self, brick: np.ndarray) -> _Points:
        """The points whose cells are in the brick, by cell, the nearest to its centre first."""
        points, grid = work.summary(self.points, Points), work.summary(self.grid, GridFound)
        size, turn = grid.cell, grid.turn
        blocks = np.flatnonzero(reaches(*boxes_in_grid(self.points, turn), brick, size))
        parts = [self._points_in_block(int(block), points.n_splats, brick, size, turn) for block in blocks]
        parts = parts or [_Points(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0), np.zeros((0, 3)))]
        key, row, off, normal = (
            np.concatenate([getattr(p, n) for p in parts]) for n in ("key", "row", "off", "normal")
        )
        order = np.lexsort([row, off, key])
        return _Points(key[order], row[order], off[order], normal[order])

    def _points_in_block(self, block: int, n: int, brick: np.ndarray, size: float, turn: tuple[float, ...]) -> _Points:
        start, stop = arrays.block_range(block, n)
        position = in_grid(arrays.read(self.points, "position", start, stop), turn)
        key = keys_of(position, size)
        mine = np.flatnonzero(inside(np.stack(index_of(key), axis=1), brick))
        off = ((position[mine] - centres_of(key[mine], size)) ** 2).sum(axis=1)
        normal = decode_normals(arrays.read(self.splats, "normal_code", start, stop)[mine])
        return _Points(key[mine], start + mine, off, normal)

    def _store_sample(self, folder: Path, index: int, target: np.ndarray, start: np.ndarray) -> None:
        """Whole runs, every so many-th."""
        most = max(LEAST_SAMPLE, SAMPLE // self.init(folder))
        chosen = np.arange(0, len(start) - 1, -(-len(target) // most))
        length = np.diff(start)[chosen]
        begin = np.concatenate([[0], np.cumsum(length)])
        rows = np.repeat(start[chosen] - begin[:-1], length) + np.arange(begin[-1])
        arrays.store(folder, f"sample_{index}", target[rows].astype(np.float32))
        arrays.store(folder, f"sample_start_{index}", begin)


@dataclass(frozen=True)
class _Points:
    """Rows correspond."""

    key: np.ndarray  # (n,) int64
    row: np.ndarray  # (n,) int64 in the points' folder
    off: np.ndarray  # (n,) squared distance to the centre
    normal: np.ndarray  # (n, 3) unit


def _mean_normals(normal: np.ndarray, begin: np.ndarray) -> np.ndarray:
    """Of each cell (n_cells, 3), unit; where those of a cell cancel, as on two sides of a sheet, that of its nearest
    point."""
    total = np.add.reduceat(normal, begin, axis=0)
    count = np.diff(np.append(begin, len(normal)))
    length = np.linalg.norm(total, axis=1)
    usable = (length > CANCELLED * count)[:, None]
    return np.where(usable, total / np.maximum(length, 1e-30)[:, None], normal[begin])


def _filled(
    key: np.ndarray, is_added: np.ndarray, normal: np.ndarray, point: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Normals and points of all cells: those of cells that close gaps are a neighbour's, of several that of the lowest
    key."""
    normals, points = np.zeros((len(key), 3)), np.full(len(key), -1)
    normals[~is_added], points[~is_added] = normal, point
    if not is_added.any():
        return normals, points
    graph = neighbours_in_slice(key)
    waiting = np.flatnonzero(is_added)
    while len(waiting):
        near = graph[waiting]
        known = (near >= 0) & (points[near] >= 0)
        source = np.where(known, near, len(key)).min(axis=1)
        ready = source < len(key)
        assert ready.any(), "a cell that closes a gap lies beside one that is filled"
        normals[waiting[ready]], points[waiting[ready]] = normals[source[ready]], points[source[ready]]
        waiting = waiting[~ready]
    return normals, points
