"""The points of an ingest that a scan is made of: those with a finite position, or a share of them, by hash."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from pipeline.numerics.hashing import uniform_hash
from pipeline.summaries import ScanRead, Vector
from storage.errors import InvalidScan
from storage.work import arrays, work

PIECE = 1 << 16  # points held at a time
DENSITY_SEED = 1 << 63  # beyond every job's seed: which points are kept tells nothing of which are learned from
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
    """The columns of its points in order: those of the ingest, and each one's place there."""
    return columns_of(ingest) | {"point": np.dtype(np.int64)}


def record_of(ingest: Path) -> np.dtype:
    """A point with all of its columns."""
    return np.dtype([(name, dtype.base, dtype.shape) for name, dtype in columns_made_of(ingest).items()])


def n_rows(ingest: Path) -> int:
    """Points of the file, with those that are dropped."""
    return work.summary(ingest, ScanRead).n_read


def kept_pieces(
    ingest: Path, density: float, start: int, stop: int, names: tuple[str, ...] = COLUMNS
) -> Iterator[dict[str, np.ndarray]]:
    """The kept ones of rows start..stop by column, PIECE rows at a time: those of `names` that the ingest has, positions
    against the origin, and `point`, the place in the ingest."""
    names = tuple(name for name in columns_of(ingest) if name in names)
    origin = np.array(origin_of(work.summary(ingest, ScanRead)))
    for at in range(start, stop, PIECE):
        end = min(at + PIECE, stop)
        place, rows = np.arange(at, end), {name: arrays.read(ingest, name, at, end) for name in names}
        keep = np.isfinite(rows["position"]).all(axis=1)
        if density < 1:
            keep &= uniform_hash(place, DENSITY_SEED) < density
        if not keep.all():
            place, rows = place[keep], {name: column[keep] for name, column in rows.items()}
        yield rows | {"point": place, "position": rows["position"] - origin}


def n_kept(ingest: Path, density: float) -> int:
    """How many points are kept."""
    if density >= 1:
        return work.summary(ingest, ScanRead).n_points
    return sum(len(piece["point"]) for piece in kept_pieces(ingest, density, 0, n_rows(ingest), ("position",)))


def check_kept(ingest: Path, density: float, n: int) -> None:
    """Raises InvalidScan where no point is kept."""
    if not n:
        n_points = work.summary(ingest, ScanRead).n_points
        raise InvalidScan("density", f"{density:g} keeps none of {n_points:,} points", f"{1 / n_points:.2g} and more")
