"""Points in chunk order -> coarser levels of them, and all levels as the points of one scan, the coarsest first.

What comes after treats them as splats like others: they are quantised, textured from the photographs, coded and packed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.execution.stage import StageRecord
from pipeline.geometry.chunks import bounds
from pipeline.geometry.sizes import BITS, Scales, cells_of, encode_sizes, fit_scales
from pipeline.splats.boxes import store_boxes
from pipeline.splats.coarser import coarser_splats, mean_colors, rows_of_group
from pipeline.splats.decoded import read_sizes, splat_radii
from pipeline.splats.normals import usable_normals
from pipeline.stages.points.kept import columns_of
from pipeline.stages.points.sizes import create_sizes, write_sizes
from pipeline.summaries import Counted, Points, SizesNeeded, Spacings
from storage.packed.levels import n_coarser
from storage.packed.schema import CHUNK, GROUP, ONE_SIZE
from storage.work import arrays, work

LEVEL_SHIFT = 56  # bits of `point` above a place in the file: chosen by hash, a level's splats are not those of another
# Times the radius that the splats of a cell cover together: coarser ones twice as large reach half a pixel over edges
# and silhouettes, where most of their pictures' error is. PSNR to the finest level's, of a quarter and a twentieth of
# the splats as they are chosen (benchmarks/levels.py): fountain_p11 33.3 and 25.2 dB with 1, 33.8 and 25.6 with 0.84,
# 34.2 and 26.4 with 0.71; conference_room 28.8 and 26.4, 29.3 and 26.3, 29.2 and 26.0.
SLIM = 0.8
POINTS, NEIGHBOURS, SIZES = PARTS = ("points", "neighbours", "sizes")


@dataclass(frozen=True)
class CoarserLevel:
    """A task a group. Arrays: the columns of the finer level's points; splat_normal (n, 3) float32, unit length and
    turned either way; splat_radius (n,) float32; degenerate (n,) bool. `points` and `neighbours` are the partition's
    and the neighbours' folders at level 1, beyond it both the folder of the level before."""

    points: Path
    neighbours: Path
    sizes: Path | None
    radius: float
    level: int
    name = "coarser-level"

    def init(self, folder: Path) -> int:
        n = n_coarser(work.summary(self.points, Counted).n_splats)
        for name, dtype in columns_of(self.points).items():
            arrays.create(folder, name, (n, *dtype.shape), str(dtype.base), (GROUP, *dtype.shape))
        arrays.create(folder, "splat_normal", (n, 3), "float32", (GROUP, 3))
        arrays.create(folder, "splat_radius", (n,), "float32", (GROUP,))
        arrays.create(folder, "degenerate", (n,), "bool", (GROUP,))
        return n // GROUP

    def run(self, folder: Path, index: int) -> Counted:
        start, stop = rows_of_group(index, work.summary(self.points, Counted).n_splats)
        columns = {name: arrays.read(self.points, name, start, stop) for name in columns_of(self.points)}
        if self.level == 1:
            normal = arrays.read(self.neighbours, "normal", start, stop)
            radius = splat_radii(self.sizes, self.radius, start, stop)
        else:
            normal, radius = (arrays.read(self.points, name, start, stop) for name in ("splat_normal", "splat_radius"))
        found = coarser_splats(columns["position"], normal, radius)
        made = {name: column[found.middle] for name, column in columns.items()}
        made["position"] = found.position
        made["point"] = (made["point"] & (1 << LEVEL_SHIFT) - 1) | self.level << LEVEL_SHIFT
        if "color" in made:
            made["color"] = mean_colors(columns["color"], radius, found.cell)
        if "normal" in made:
            made["normal"] = _turned(found.normal, made["normal"])
        made["splat_normal"], made["splat_radius"] = found.normal, found.radius
        made["degenerate"] = arrays.read(self.neighbours, "degenerate", start, stop)[found.middle]
        for name, rows in made.items():
            arrays.write(folder, name, index * GROUP, rows)
        return Counted(GROUP)

    def finalise(self, folder: Path, results: list[Counted]) -> Counted:
        return Counted(sum(r.n_splats for r in results))


@dataclass(frozen=True)
class LevelsBlock:
    """What a task tells of its block; its box, of points alone."""

    n_splats: int
    block_low: tuple[float, ...] = ()
    block_high: tuple[float, ...] = ()


@dataclass(frozen=True)
class Levels:
    """A task a block of all levels. `part` says whose folder it stands for with all of them: the partition's (POINTS),
    the neighbours' (NEIGHBOURS) or the sizes' (SIZES). Levels are whole groups but the last, the finest, so that no
    chunk or group has splats of two."""

    part: str
    finest: Path  # the folder of the part of the finest level; of sizes that nothing told, the partition's
    coarser: tuple[Path, ...]  # of `CoarserLevel`, the coarsest first
    radius: float
    even: bool = False  # all splats of the finest level have the radius, whatever sizes they need
    slim: float = SLIM
    bits: int | None = BITS  # of the codes of sizes; None: for quadrics
    name = "levels"

    def init(self, folder: Path) -> int:
        n = sum(self._counts())
        if self.part == SIZES:
            create_sizes(folder, n)
        for name, dtype in self._columns().items():
            arrays.create(folder, name, (n, *dtype.shape), str(dtype.base))
        return arrays.n_blocks(n)

    def run(self, folder: Path, index: int) -> LevelsBlock:
        counts = self._counts()
        start, stop = arrays.block_range(index, sum(counts))
        firsts = np.cumsum([0, *counts[:-1]])
        pieces = [
            (level, max(0, start - int(first)), min(count, stop - int(first)))
            for level, (first, count) in enumerate(zip(firsts, counts))
            if first < stop and first + count > start
        ]
        if self.part == SIZES:
            code, step, cells = (np.concatenate(part) for part in zip(*(self._sizes(*piece) for piece in pieces)))
            write_sizes(folder, start, code, Scales(step, self.radius, cells))
            return LevelsBlock(n_splats=stop - start)
        columns = {name: np.concatenate([self._read(name, *piece) for piece in pieces]) for name in self._columns()}
        for name, rows in columns.items():
            arrays.write(folder, name, start, rows)
        if self.part == NEIGHBOURS:
            return LevelsBlock(n_splats=stop - start)
        low, high = bounds(columns["position"])
        return LevelsBlock(n_splats=stop - start, block_low=tuple(low.tolist()), block_high=tuple(high.tolist()))

    def finalise(self, folder: Path, results: list[LevelsBlock]) -> Points | Spacings | SizesNeeded:
        if self.part == SIZES and not arrays.exists(self.finest, "size_code"):
            return SizesNeeded(sum(r.n_splats for r in results))  # nothing told any
        known: Any = work.summary(self.finest, self.summary_type)
        if self.part == NEIGHBOURS:
            return known
        known = replace(known, n_splats=sum(r.n_splats for r in results))
        if self.part == SIZES:
            return known
        store_boxes(folder, *(np.array([getattr(r, name) for r in results]) for name in ("block_low", "block_high")))
        return replace(known, levels=tuple(self._counts()))

    @property
    def summary_type(self) -> type:
        """That of the folder that it stands for."""
        return {POINTS: Points, NEIGHBOURS: Spacings, SIZES: SizesNeeded}[self.part]

    def _counts(self) -> list[int]:
        """Splats of each level, the coarsest first."""
        named = next(n for n in ("position", "spacing", "size_code") if arrays.exists(self.finest, n))
        n_finest = arrays.layout_of(self.finest, named).shape[0]
        return [work.summary(level, Counted).n_splats for level in self.coarser] + [n_finest]

    def _columns(self) -> dict[str, np.dtype]:
        if self.part == POINTS:
            return columns_of(self.finest)
        of_neighbours = {"spacing": np.dtype("f4"), "normal": np.dtype(("f4", 3)), "degenerate": np.dtype(bool)}
        return of_neighbours if self.part == NEIGHBOURS else {}

    def _read(self, name: str, level: int, start: int, stop: int) -> np.ndarray:
        if level == len(self.coarser):
            return arrays.read(self.finest, name, start, stop)
        if self.part == NEIGHBOURS:
            name = {"spacing": "splat_radius", "normal": "splat_normal"}.get(name, name)
        return arrays.read(self.coarser[level], name, start, stop)

    def _sizes(self, level: int, start: int, stop: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Codes, scales and how many values there are, of rows of one level, which begin a chunk."""
        if level < len(self.coarser):
            size = self.slim * arrays.read(self.coarser[level], "splat_radius", start, stop).astype(np.float64)
            scales = fit_scales(size, self.radius, self.bits)
            return encode_sizes(size, scales), scales.step, scales.cells
        if self.even:
            even = np.full((-(-(stop - start) // CHUNK), 2), ONE_SIZE, np.uint8)
            return np.zeros(stop - start, np.uint8), even, cells_of(even, self.bits)
        code, scales = read_sizes(self.finest, self.radius, start, stop)
        return code, scales.step, scales.cells


def with_levels(
    do: Callable[[CoarserLevel | Levels], StageRecord],
    partition: StageRecord,
    neighbours: Path,
    needed: StageRecord | None,
    sizes: Path | None,
    radius: float,
    n_coarser: int,
    bits: int | None = BITS,
) -> tuple[StageRecord, Path, Path]:
    """The points, neighbours and sizes of all levels, in the place of those of the finest, by stages that `do` does;
    its splats have the one radius where they have no `sizes`, even if they `needed` some."""
    coarser: tuple[Path, ...] = ()
    for level in range(1, n_coarser + 1):
        source = (coarser[0],) * 2 if coarser else (partition.folder, neighbours)
        coarser = (do(CoarserLevel(*source, sizes, radius, level)).folder, *coarser)
    finest = {POINTS: partition.folder, NEIGHBOURS: neighbours, SIZES: needed.folder if needed else partition.folder}
    points, near, sized = (
        do(Levels(part, finest[part], coarser, radius, *((sizes is None, SLIM, bits) if part == SIZES else ())))
        for part in PARTS
    )
    return points, near.folder, sized.folder


def _turned(normal: np.ndarray, given: np.ndarray) -> np.ndarray:
    """The merged normals, turned as those that the scan gave of the middle ones; where it gave none that is usable,
    none."""
    usable, bad = usable_normals(given)
    side = np.where((normal * usable).sum(axis=1, keepdims=True) < 0, -1, 1)
    return np.where(bad[:, None], given, side * normal).astype(np.float32)
