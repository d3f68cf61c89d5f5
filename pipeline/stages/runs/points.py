"""Decoded cells as the points of a scan: what comes after textures, sizes and packs them in the frame that the renderer
decodes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.geometry.chunks import bounds
from pipeline.geometry.normals import decode_normals
from pipeline.splats.boxes import store_boxes
from pipeline.stages.points.kept import columns_of
from pipeline.stages.runs.codes import brick_rows
from pipeline.stages.runs.found import CellsAsPoints
from pipeline.summaries import Counted, Points, Vector
from storage.work import arrays, work

SPREAD = 1.2  # cells, at least, of a splat's radius: those of a surface lie off it by up to half of one, and show gaps from the side


@dataclass(frozen=True)
class CellsBlock:
    """What a task tells of its block."""

    n_splats: int
    block_low: Vector
    block_high: Vector
    n_degenerate: int
    median_spacing: float


@dataclass(frozen=True)
class RunPoints:
    """A task a block. Arrays: the columns of the points, of the point nearest to each cell's centre, but `position` and
    `normal` of the cell; normal_code (n, 2) int8; spacing (n,) float32, the point's and at least a cell; degenerate
    (n,) bool. It stands in the place of the partition and of the neighbours."""

    points: Path
    neighbours: Path
    cells: Path
    codes: Path
    cell: float
    name = "run-points"

    def init(self, folder: Path) -> int:
        n = work.summary(self.codes, Counted).n_splats
        for name, dtype in (columns_of(self.points) | {"normal": np.dtype(("f4", 3))}).items():
            arrays.create(folder, name, (n, *dtype.shape), str(dtype.base))
        arrays.create(folder, "normal_code", (n, 2), "int8")
        arrays.create(folder, "spacing", (n,), "float32")
        arrays.create(folder, "degenerate", (n,), "bool")
        return arrays.n_blocks(n)

    def run(self, folder: Path, index: int) -> CellsBlock:
        start, stop = arrays.block_range(index, work.summary(self.codes, Counted).n_splats)
        position, normal_code, point = (
            brick_rows(self.codes, self.cells, name, start, stop) for name in ("position", "normal_code", "point")
        )
        rows, back = np.unique(point, return_inverse=True)
        made = {name: arrays.read_rows(self.points, name, rows)[back] for name in columns_of(self.points)}
        spacing = arrays.read_rows(self.neighbours, "spacing", rows)[back]
        made["position"] = position.astype(np.float64)
        made["normal"] = decode_normals(normal_code).astype(np.float32)
        made["normal_code"] = normal_code
        least = np.float32(SPREAD * self.cell)
        made["spacing"] = np.where(np.isfinite(spacing), np.maximum(spacing, least), least)
        made["degenerate"] = arrays.read_rows(self.neighbours, "degenerate", rows)[back]
        for name, values in made.items():
            arrays.write(folder, name, start, values)
        low, high = bounds(made["position"])
        return CellsBlock(
            n_splats=stop - start,
            block_low=tuple(low.tolist()),
            block_high=tuple(high.tolist()),
            n_degenerate=int(made["degenerate"].sum()),
            median_spacing=float(np.median(made["spacing"])),
        )

    def finalise(self, folder: Path, results: list[CellsBlock]) -> CellsAsPoints:
        n = sum(r.n_splats for r in results)
        store_boxes(folder, *(np.array([getattr(r, name) for r in results]) for name in ("block_low", "block_high")))
        return CellsAsPoints(
            n_splats=n,
            origin=work.summary(self.points, Points).origin,
            levels=(n,),
            median_spacing=float(
                np.median([r.median_spacing for r in results])
            ),  # of medians of blocks: all much alike
            n_degenerate=sum(r.n_degenerate for r in results),
        )
