"""Splats -> which of them are ellipsoids, with centre and half axes; neighbours are looked for across blocks."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.effects.ellipsoids.decision import WIDEST_RADII, thin_splats
from pipeline.effects.ellipsoids.fit import fit
from pipeline.effects.ellipsoids.neighbourhoods import CELL_RADII, thinned
from storage.work import arrays, work


@dataclass(frozen=True)
class Ellipsoids:
    """A task a block. Arrays: has_ellipsoid (n,) bool; centre (n, 3) float64, against the origin, and axes (n, 3, 3)
    float32, half axes as rows, longest first; both zeros for discs."""

    partition: Path
    radius: float
    noise_radii: float
    name = "ellipsoids"

    def init(self, folder: Path) -> int:
        n = work.summary(self.partition)["n_splats"]
        for name, shape, dtype in (
            ("has_ellipsoid", (n,), "bool"),
            ("centre", (n, 3), "float64"),
            ("axes", (n, 3, 3), "float32"),
        ):
            arrays.create(folder, name, shape, dtype)
        return arrays.n_blocks(n)

    def run(self, folder: Path, index: int) -> dict:
        start, stop = arrays.block_range(index, work.summary(self.partition)["n_splats"])
        position = arrays.read(self.partition, "position", start, stop)
        points = self._points_about(index)
        thin = thin_splats(
            position, thinned(points, CELL_RADII * self.radius), self.radius, self.noise_radii * self.radius
        )
        centre, axes = np.zeros((stop - start, 3)), np.zeros((stop - start, 3, 3), np.float32)
        if thin.any():
            offset, axes[thin] = fit(position[thin], np.unique(points, axis=0), self.radius)
            centre[thin] = position[thin] + offset
        for name, rows in (("has_ellipsoid", thin), ("centre", centre), ("axes", axes)):
            arrays.write(folder, name, start, rows)
        return {"n_splats": stop - start, "n_ellipsoids": int(thin.sum())}

    def finalise(self, folder: Path, results: list[dict]) -> dict:
        n = sum(r["n_splats"] for r in results)
        n_ellipsoids = sum(r["n_ellipsoids"] for r in results)
        return {"n_splats": n, "n_ellipsoids": n_ellipsoids, "share": n_ellipsoids / n}

    def _points_about(self, index: int) -> np.ndarray:
        """All points of the scan that can be neighbours of a block's: those in its box, grown by the outlier
        distance."""
        summary = work.summary(self.partition)
        low, high = np.array(summary["block_low"]), np.array(summary["block_high"])
        reach = WIDEST_RADII * self.radius
        from_, to = low[index] - reach, high[index] + reach
        found = []
        for block in np.flatnonzero(((low <= to) & (high >= from_)).all(axis=1)):
            points = arrays.read(self.partition, "position", *arrays.block_range(int(block), summary["n_splats"]))
            found.append(points[((points >= from_) & (points <= to)).all(axis=1)])
        return np.concatenate(found)
