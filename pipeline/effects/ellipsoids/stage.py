"""Splats -> which of them are ellipsoids, with centre and half axes; neighbours are looked for across blocks."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.effects.ellipsoids.classes import radius_classes
from pipeline.effects.ellipsoids.decision import CELLS_RADII, WIDEST_RADII, thin_splats
from pipeline.effects.ellipsoids.fit import fit
from pipeline.effects.ellipsoids.neighbourhoods import Around
from pipeline.effects.ellipsoids.thinned import CELL_RADII, distinct, thinned_of_distinct
from pipeline.execution.compiled import kernel
from pipeline.geometry.chunks import bounds
from pipeline.splats.boxes import boxes_of
from pipeline.splats.coarser import first_finest
from pipeline.splats.decoded import splat_radii
from pipeline.summaries import Points
from storage.work import arrays, work


@dataclass(frozen=True)
class EllipsoidsMade:
    """How many splats became ellipsoids, and their share."""

    n_splats: int
    n_ellipsoids: int
    share: float


@dataclass(frozen=True)
class EllipsoidBlock:
    """What a task tells of its block."""

    n_splats: int
    n_ellipsoids: int


@dataclass(frozen=True)
class Ellipsoids:
    """A task a block. Arrays: has_ellipsoid (n,) bool; centre (n, 3) float64, against the origin, and axes (n, 3, 3)
    float32, half axes as rows, longest first; both zeros for discs."""

    partition: Path
    radius: float
    noise_radii: float
    sizes: Path | None = None  # size_code and size_scale: each splat has a radius of its own
    name = "ellipsoids"

    def init(self, folder: Path) -> int:
        n = work.summary(self.partition, Points).n_splats
        for name, shape, dtype in (
            ("has_ellipsoid", (n,), "bool"),
            ("centre", (n, 3), "float64"),
            ("axes", (n, 3, 3), "float32"),
        ):
            arrays.create(folder, name, shape, dtype)
        return arrays.n_blocks(n)

    def run(self, folder: Path, index: int) -> EllipsoidBlock:
        start, stop = arrays.block_range(index, work.summary(self.partition, Points).n_splats)
        position = arrays.read(self.partition, "position", start, stop)
        thin, centre = np.zeros(stop - start, bool), np.zeros((stop - start, 3))
        axes = np.zeros((stop - start, 3, 3), np.float32)
        classes = list(radius_classes(splat_radii(self.sizes, self.radius, start, stop), self.radius))
        finest = max(start, self._first_finest()) - start  # a coarser level is of discs: its neighbourhoods are others
        classes = [(radius, rows) for radius, rows in ((r, rows[rows >= finest]) for r, rows in classes) if len(rows)]
        widest = max((radius for radius, _ in classes), default=self.radius)
        there = distinct(self._points_about(position[finest:], WIDEST_RADII * widest)) if classes else position[:0]
        for radius, rows in classes:
            points = _about(there, position[rows], WIDEST_RADII * radius)
            around = Around(thinned_of_distinct(points, CELL_RADII * radius), CELLS_RADII * radius)
            found = thin_splats(position[rows], around, radius, self.noise_radii * radius)
            rows = rows[found]
            if len(rows):
                offset, axes[rows] = fit(position[rows], points, radius)
                centre[rows] = position[rows] + offset
                thin[rows] = True
        for name, rows in (("has_ellipsoid", thin), ("centre", centre), ("axes", axes)):
            arrays.write(folder, name, start, rows)
        return EllipsoidBlock(n_splats=stop - start, n_ellipsoids=int(thin.sum()))

    def finalise(self, folder: Path, results: list[EllipsoidBlock]) -> EllipsoidsMade:
        n = sum(r.n_splats for r in results)
        n_ellipsoids = sum(r.n_ellipsoids for r in results)
        return EllipsoidsMade(n, n_ellipsoids, n_ellipsoids / n)

    def _first_finest(self) -> int:
        """The first splat of the finest level."""
        return first_finest(work.summary(self.partition, Points))

    def _points_about(self, some: np.ndarray, reach: float) -> np.ndarray:
        """All points of the scan that can be neighbours of `some` (m, 3): those in their box, grown by `reach`."""
        summary = work.summary(self.partition, Points)
        low, high = boxes_of(self.partition)
        from_, to = bounds(some)
        from_, to = from_ - reach, to + reach
        found = []
        first = self._first_finest()
        for block in np.flatnonzero(((low <= to) & (high >= from_)).all(axis=1)):
            start, stop = arrays.block_range(int(block), summary.n_splats)
            if stop > first:
                points = arrays.read(self.partition, "position", max(first, start), stop)
                found.append(_about(points, some, reach))
        return np.concatenate(found)


def _about(points: np.ndarray, some: np.ndarray, reach: float) -> np.ndarray:
    """Of `points` (n, 3) those in the box of `some` (m, 3), grown by `reach`, in their order."""
    low, high = bounds(some)
    return points[_inside(points, low - reach, high + reach)]


@kernel()
def _inside(points, low, high):  # (n,) bool
    inside = np.ones(len(points), np.bool_)
    for i in range(len(points)):
        for axis in range(3):
            inside[i] &= low[axis] <= points[i, axis] <= high[axis]
    return inside
