"""The points of an ingest that a scan is made of: those with a finite position, or the share of them that was thinned
out."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from pipeline.summaries import Counted, ScanRead, Vector
from storage.work import arrays, work

PIECE = 1 << 16  # points held at a time
PART = 1 << 20  # points a task, where tasks go by parts of the file
MOST_PARTS = 1 << 12  # of a larger scan parts are larger: each leaf reads from all of them
KEPT = "kept"  # array of what was thinned
COLUMNS = ("position", "normal", "color", "intensity", "station", "candidate", "point")


def origin_of(scan: ScanRead) -> Vector:
    """The middle of the scan's bounds, or the cell near it of the grid that its points lie in."""
    if scan.grid is not None:
        return scan.grid.origin
    x, y, z = ((a + b) / 2 for a, b in zip(scan.low, scan.high))
    return x, y, z


def columns_of(points: Path) -> dict[str, np.dtype]:
    """The columns that a folder of points has, with the type of a row."""
    found = {name: arrays.layout_of(points, name) for name in COLUMNS if arrays.exists(points, name)}
    return {name: np.dtype((layout.dtype, layout.shape[1:])) for name, layout in found.items()}


def columns_made_of(ingest: Path) -> dict[str, np.dtype]:
    """The columns of its points in order: those of the ingest, positions in float64 as they are then told against the
    origin, and each one's place there."""
    return columns_of(ingest) | {"position": np.dtype(("f8", (3,))), "point": np.dtype(np.int64)}


def record_of(ingest: Path) -> np.dtype:
    """A point with all of its columns."""
    return np.dtype([(name, dtype.base, dtype.shape) for name, dtype in columns_made_of(ingest).items()])


def n_rows(ingest: Path) -> int:
    """Points of the file, with those that are dropped."""
    return work.summary(ingest, ScanRead).n_read


def part_rows(ingest: Path) -> int:
    """Points of the file a part: the same however many workers there are."""
    return max(PART, -(-n_rows(ingest) // MOST_PARTS))


def n_parts(ingest: Path) -> int:
    """How many tasks the points of an ingest are parted into."""
    return arrays.n_blocks(n_rows(ingest), part_rows(ingest))


def part_range(ingest: Path, index: int) -> tuple[int, int]:
    """First row and end of a part."""
    return arrays.block_range(index, n_rows(ingest), part_rows(ingest))


def finite_pieces(
    ingest: Path, start: int, stop: int, names: tuple[str, ...] = COLUMNS, thinned: Path | None = None
) -> Iterator[dict[str, np.ndarray]]:
    """The points of rows start..stop with a finite position, or those that are kept of them, by column, PIECE rows at a
    time: those of `names` that the ingest has, positions against the origin, and `point`, the place in the ingest."""
    names = tuple(name for name in columns_of(ingest) if name in names)
    origin = np.array(origin_of(work.summary(ingest, ScanRead)))
    for at in range(start, stop, PIECE):
        end = min(at + PIECE, stop)
        place, rows = np.arange(at, end), {name: arrays.read(ingest, name, at, end) for name in names}
        keep = np.isfinite(rows["position"]).all(axis=1) if thinned is None else arrays.read(thinned, KEPT, at, end)
        if not keep.all():
            place, rows = place[keep], {name: column[keep] for name, column in rows.items()}
        yield rows | {"point": place, "position": rows["position"] - origin}


def n_kept(ingest: Path, thinned: Path | None) -> int:
    """How many points are kept."""
    return work.summary(ingest, ScanRead).n_points if thinned is None else work.summary(thinned, Counted).n_splats
