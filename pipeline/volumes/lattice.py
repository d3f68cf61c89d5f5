"""Where the HCP grid lies in a volume: its slices along the slowest axis, so that few slices of voxels serve one of cells.

The directions A of the volume are split A = Q R, R upper triangular with a positive diagonal: `Q` turns local coordinates into the
file's frame, and local z = R[2, 2] k depends on k alone, whatever is oblique or sheared. Cell (0, 0, 0) stands on voxel (0, 0, 0).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pipeline.geometry.hcp import REACH, ROW, SLICE, check_extent
from storage.errors import InvalidScan

MOST_IN_SLICE = 1 << 28  # cells: a GiB of values a slice, of which a task holds some
TASK_BYTES = 1 << 27  # of voxels and values that a task holds, halos apart
HALO = 2  # slices of cells either side: neighbours of neighbours


@dataclass(frozen=True)
class Lattice:
    """The cells about a volume, and how to get there."""

    size: float  # distance of neighbouring centres, unit
    turn: np.ndarray  # Q (3, 3): local to the file's frame
    stretch: np.ndarray  # R (3, 3): voxels to local
    origin: np.ndarray  # (3,) of voxel (0, 0, 0), in the file's frame
    low: tuple[int, int, int]  # first column, row and slice
    counts: tuple[int, int, int]  # columns, rows and slices
    n_slices: int  # of voxels

    @property
    def to_voxels(self) -> np.ndarray:
        """R^-1 (3, 3): local to voxels."""
        return np.linalg.inv(self.stretch)

    def slices_a_task(self, voxels_in_slice: int) -> int:
        """As many slices of cells as TASK_BYTES hold, with their voxels; 8 at least, or halos would be most of the work."""
        a_slice = 5 * self.counts[0] * self.counts[1] + 4 * voxels_in_slice * self.size * SLICE / self.stretch[2, 2]
        return int(np.clip(TASK_BYTES // a_slice, 8, 64))

    def voxel_slices(self, first: int, end: int, reach: int) -> tuple[int, int]:
        """First and end of the slices of voxels that points of the cells of slices first..end, moved by a cell, look at."""
        step = self.size * SLICE / self.stretch[2, 2]
        beyond = 2 * REACH * self.size / self.stretch[2, 2] + reach
        return max(0, math.floor(first * step - beyond)), min(self.n_slices, math.ceil((end - 1) * step + beyond) + 1)

    def in_frame(self, local: np.ndarray) -> np.ndarray:
        """Local positions (n, 3) in the file's frame."""
        return local @ self.turn.T + self.origin


def lattice_of(shape: tuple[int, int, int], directions: np.ndarray, origin: np.ndarray, size: float) -> Lattice:
    """The cells of a volume of that shape.

    Raises: InvalidScan where there are too many cells in a slice, or along an axis.
    """
    turn, stretch = np.linalg.qr(np.asarray(directions, np.float64))
    sign = np.sign(np.diag(stretch))
    turn, stretch = turn * sign, stretch * sign[:, None]
    last = np.array(shape) - 1.0
    corners = np.array([[i, j, k] for i in (0, last[0]) for j in (0, last[1]) for k in (0, last[2])]) @ stretch.T
    pitch = np.array([size, size * ROW, size * SLICE])
    check_extent(float(np.abs(corners).max()), size)
    low, high = (
        np.floor(corners.min(axis=0) / pitch).astype(int) - 1,
        np.ceil(corners.max(axis=0) / pitch).astype(int) + 1,
    )
    low[2] = 0
    high[2] = int(
        np.ceil(last[2] * stretch[2, 2] / pitch[2])
    )  # the cells about the last voxels, whose centres may lie beyond them
    counts = high - low + 1
    if counts[0] * counts[1] > MOST_IN_SLICE:
        raise InvalidScan(
            "cell",
            f"a size of {size:g} makes {counts[0]:,} x {counts[1]:,} cells in a slice",
            f"at most {MOST_IN_SLICE:,}",
            f"choose a cell of {size * math.sqrt(counts[0] * counts[1] / MOST_IN_SLICE):.3g} or more",
        )
    return Lattice(
        size, turn, stretch, np.asarray(origin, np.float64), tuple(low.tolist()), tuple(counts.tolist()), shape[2]
    )


def auto_size(spacing: tuple[float, float, float]) -> float:
    """A cell a voxel where these are cubes: a cell has the volume size^3 / sqrt(2). Where spacing differs by axis, by the finest, so
    that nothing that the volume shows is lost along it.

    >>> round(auto_size((1.0, 1.0, 2.5)), 4)
    1.1225
    """
    return 2 ** (1 / 6) * min(spacing)
