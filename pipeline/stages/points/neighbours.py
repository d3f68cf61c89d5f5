"""How far splats lie apart, and normals where the scan has none, or one that is zero or not finite."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.numerics.limits import check_radius
from pipeline.splats.boxes import boxes_of, runs_of_boxes
from pipeline.splats.neighbours import Blocks, find_neighbours
from pipeline.splats.normals import NEIGHBOURS, estimate_normals, usable_normals
from pipeline.splats.signs import MOST_POINTS, settled_signs
from pipeline.summaries import Points, ScanRead, Spacings
from storage.errors import InvalidScan
from storage.work import arrays, work

SPACING_RANK = 4  # "3-5 splats contribute to the final pixel" (HPG 2021, section 3.6.1)
MOST_SPACINGS = 1 << 22  # for the median; of a larger scan some of each block count, which its task tells
SAMPLED = 1 << 17  # of a larger scan, or one a block: one process that reads 610,352 blocks of 10 billion takes minutes


@dataclass(frozen=True)
class SpacingBlock:
    """What a task tells of its block; of a large scan also some of its finite spacings."""

    n_splats: int
    n_degenerate: int
    sample: tuple[float, ...] = ()


def blocks_of(partition: Path) -> Blocks:
    """The points of a scan in chunk order, by blocks."""
    points = work.summary(partition, Points)

    def load(block: int) -> np.ndarray:
        return arrays.read(partition, "position", *arrays.block_range(block, points.n_splats))

    return Blocks(load, *boxes_of(partition), runs_of_boxes(partition))


@dataclass(frozen=True)
class Neighbourhoods:
    """A task a block. Arrays: spacing (n,) float32, the distance to the 4th nearest neighbour; normal (n, 3) float32,
    unit length and not yet turned; degenerate (n,) bool where no normal could be told.

    With `settle` the normals, all of them estimated, are turned so that neighbours agree on which side is out."""

    partition: Path
    settle: bool = False
    name = "neighbours"

    def init(self, folder: Path) -> int:
        n = work.summary(self.partition, Points).n_splats
        arrays.create(folder, "spacing", (n,), "float32")
        arrays.create(folder, "normal", (n, 3), "float32")
        arrays.create(folder, "degenerate", (n,), "bool")
        return arrays.n_blocks(n)

    def run(self, folder: Path, index: int) -> SpacingBlock:
        n = work.summary(self.partition, Points).n_splats
        start, stop = arrays.block_range(index, n)
        normal, bad = np.zeros((stop - start, 3)), np.ones(stop - start, bool)
        if arrays.exists(self.partition, "normal"):
            normal, bad = usable_normals(arrays.read(self.partition, "normal", start, stop))
        found = find_neighbours(index, NEIGHBOURS if bad.any() else SPACING_RANK, blocks_of(self.partition))
        missing = np.flatnonzero(bad)
        degenerate = np.zeros(stop - start, bool)
        if len(missing):
            point = arrays.read(self.partition, "position", start, stop)[missing]
            normal[missing], degenerate[missing] = estimate_normals(point, found.position[missing])
        spacing = found.distance[:, SPACING_RANK - 1].astype(np.float32)
        arrays.write(folder, "spacing", start, spacing)
        arrays.write(folder, "normal", start, normal.astype(np.float32))
        arrays.write(folder, "degenerate", start, degenerate)
        sample = spacing[:: -(-n // SAMPLED)] if n > MOST_SPACINGS else spacing[:0]
        return SpacingBlock(stop - start, int(degenerate.sum()), tuple(sample[np.isfinite(sample)].tolist()))

    def finalise(self, folder: Path, results: list[SpacingBlock]) -> Spacings:
        n = arrays.layout_of(folder, "spacing").shape[0]
        if n > MOST_SPACINGS:
            finite = np.array([spacing for block in results for spacing in block.sample])
        else:
            values = arrays.read(folder, "spacing", 0, n)
            finite = values[np.isfinite(values)]
        if self.settle:
            self._settle(folder, n)
        median = float(np.median(finite)) if len(finite) else None
        return Spacings(median, sum(r.n_degenerate for r in results), self.settle)

    def _settle(self, folder: Path, n: int) -> None:
        normal = arrays.read(folder, "normal", 0, n)
        signs = settled_signs(arrays.read(self.partition, "position", 0, n), normal.astype(np.float64))
        for i in range(arrays.n_blocks(n)):
            start, stop = arrays.block_range(i, n)
            arrays.write(folder, "normal", start, normal[start:stop] * signs[start:stop, None])


def signs_are_open(scan: ScanRead, partition: Path) -> bool:
    """Whether nothing but the points says which side of a surface is out: a scan, as its ingest has it, without
    normals, photographs or stations, not from the air, and of so few points that one process settles them."""
    told = any(arrays.exists(partition, name) for name in ("normal", "station"))
    told = told or bool(scan.cameras) or scan.format == "las"
    return not told and work.summary(partition, Points).n_splats <= MOST_POINTS


def radius_of(neighbours: Spacings, asked: float | None, scan: str) -> float:
    """The splat radius: what was asked for, else the median spacing (about 4 splats then cover a surface point)."""
    radius = neighbours.median_spacing if asked is None else asked
    if not radius:
        raise InvalidScan(
            scan,
            "too few different positions to tell a splat radius from",
            f"more than {SPACING_RANK} different positions",
            "give one with --radius",
        )
    check_radius(scan, radius)
    return radius
