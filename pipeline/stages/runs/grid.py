"""Which grid a scan's runs lie in: the size of its cells, the axis that slices lie across, and bricks for tasks."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.geometry.hcp import keys_of
from pipeline.geometry.normals import decode_normals
from pipeline.geometry.runs.bricks import split
from pipeline.geometry.runs.cells import MOST_HIT_RATE, Cells, fill, mean_spacing, search_size
from pipeline.geometry.runs.codes import encode_runs, turn_across
from pipeline.geometry.runs.starts import bits_of
from pipeline.geometry.runs.walks import runs_of
from pipeline.splats.boxes import boxes_of
from pipeline.stages.runs.found import GridFound
from pipeline.summaries import Points
from storage.work import arrays, work

PIECES, PIECE_BLOCKS = 8, 8  # of the sample: pieces of so many blocks that lie together, so that few cells are cut


@dataclass(frozen=True)
class RunGridChoice:
    """A task. Array: bricks (m, 6) int64 of pipeline.geometry.runs.bricks.

    `turn` is that of a volume's own grid, whose cells these are; else slices lie across the axis that gives the longest
    runs. Without a `cell` one of the size at which `hit_rate` points lie in a cell: sampling error first, whatever runs
    that makes.
    """

    points: Path
    splats: Path
    run_length: int
    cell: float | None = None
    turn: tuple[float, ...] | None = None
    hit_rate: float = MOST_HIT_RATE
    name = "run-grid"

    def init(self, folder: Path) -> int:
        return 1

    def run(self, folder: Path, index: int) -> GridFound:
        points = work.summary(self.points, Points)
        position, code = (
            _sample(folder, name, points.n_splats)
            for folder, name in ((self.points, "position"), (self.splats, "normal_code"))
        )
        sampled = [(turn, self._cells(position, turn)) for turn in self._turns()]
        found = [(turn, cells, runs_of(cells.key, self.run_length)) for turn, cells in sampled]
        turn, cells, runs = max(found, key=lambda x: x[2].mean_length)
        near = np.unique(keys_of(in_grid(position, turn), cells.size), return_index=True)[1]
        codes, _ = encode_runs(cells.key, decode_normals(code[near]), runs)
        low, high = boxes_in_grid(self.points, turn)
        count = np.diff([*range(0, points.n_splats, arrays.BLOCK), points.n_splats])
        arrays.store(folder, "bricks", split((low + high) / 2, count, cells.size))
        return GridFound(
            cell=cells.size,
            turn=turn,
            hit_rate=cells.hit_rate,
            efficiency=runs.mean_length / self.run_length,
            spacing=mean_spacing(position),
            gpu_bits_a_point=sum(bits_of(codes).values()) * codes.n_cells / len(position),
            n_splats=points.n_splats,
        )

    def finalise(self, folder: Path, results: list[GridFound]) -> GridFound:
        return results[0]

    def _turns(self) -> list[tuple[float, ...]]:
        return [turn_across(axis) for axis in (2, 1, 0)] if self.turn is None else [self.turn]

    def _cells(self, position: np.ndarray, turn: tuple[float, ...]) -> Cells:
        there = in_grid(position, turn)
        return search_size(there, self.hit_rate) if self.cell is None else fill(there, self.cell)


def in_grid(position: np.ndarray, turn: tuple[float, ...]) -> np.ndarray:
    """Positions (n, 3) float64 in the grid's axes."""
    return position @ np.array(turn).reshape(3, 3)


def boxes_in_grid(points: Path, turn: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Low and high corner (b, 3) in the grid's axes of what holds each block of a stage's points."""
    low, high = boxes_of(points)
    matrix = np.array(turn).reshape(3, 3)
    middle, half = (low + high) / 2 @ matrix, (high - low) / 2 @ np.abs(matrix)
    return middle - half, middle + half


def _sample(folder: Path, name: str, n: int) -> np.ndarray:
    """Rows of all points, or of PIECES pieces, spread evenly."""
    rows = PIECE_BLOCKS * arrays.BLOCK
    if n <= PIECES * rows:
        return arrays.read(folder, name)
    starts = np.linspace(0, n - rows, PIECES).astype(int) // arrays.BLOCK * arrays.BLOCK
    return np.concatenate([arrays.read(folder, name, int(at), int(at) + rows) for at in starts])
