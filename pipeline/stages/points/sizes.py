"""Spacing and gaps -> a radius for each splat, in steps of its chunk's scale; and whether one radius would do."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.geometry.sizes import BITS, MOST_MEDIANS, Scales, decode_sizes, encode_sizes, fit_scales
from pipeline.splats.gaps import MOST, gap_radii, neighbours_in_reach
from pipeline.splats.neighbours import points_around
from pipeline.splats.sizes import areas, needed_sizes
from pipeline.stages.points.neighbours import blocks_of
from pipeline.summaries import Points, SizesNeeded
from storage.packed.schema import CHUNK
from storage.work import arrays, work


@dataclass(frozen=True)
class SizesBlock:
    """What a task tells of its block: the area that splats need, that of large ones, and what their codes come to."""

    n_splats: int
    area: float
    large_area: float
    made_area: float
    n_too_small: int


@dataclass(frozen=True)
class Sizes:
    """A task a block. Arrays: size_code (n,) uint8 and, by chunk, size_scale (c, 2) and size_cells (c,) uint8. The summary
    has the share of the surface whose splats need to be LARGE, before any is made to close a gap."""

    partition: Path
    neighbours: Path
    radius: float
    closed: float = MOST  # times its size: gaps that a splat grows to close
    bits: int | None = BITS  # of a code; None: for quadrics
    name = "sizes"

    def init(self, folder: Path) -> int:
        n = work.summary(self.partition, Points).n_splats
        create_sizes(folder, n)
        return arrays.n_blocks(n)

    def run(self, folder: Path, index: int) -> SizesBlock:
        start, stop = arrays.block_range(index, work.summary(self.partition, Points).n_splats)
        position = arrays.read(self.partition, "position", start, stop)
        size = needed_sizes(position, arrays.read(self.neighbours, "spacing", start, stop), self.radius)
        closing = np.maximum(size, self._gaps(index, position, size))
        scales = fit_scales(closing, self.radius, self.bits)
        code = encode_sizes(closing, scales)
        write_sizes(folder, start, code, scales)
        area, large = areas(size, self.radius)
        made = decode_sizes(code, scales)
        return SizesBlock(
            n_splats=stop - start,
            area=area,
            large_area=large,
            made_area=areas(made, self.radius)[0],
            n_too_small=int((made < closing * (1 - 1e-6)).sum()),
        )

    def _gaps(self, index: int, position: np.ndarray, size: np.ndarray) -> np.ndarray:
        start, stop = arrays.block_range(index, work.summary(self.partition, Points).n_splats)
        reach = 2 * self.closed * min(size.max(), MOST_MEDIANS * np.median(size))
        around = points_around(index, reach, blocks_of(self.partition))
        normal = arrays.read(self.neighbours, "normal", start, stop).astype(np.float64)
        return gap_radii(*neighbours_in_reach(position, around), normal, size, self.closed)

    def finalise(self, folder: Path, results: list[SizesBlock]) -> SizesNeeded:
        n, area, large, made, n_too_small = (
            sum(getattr(r, k) for r in results) for k in ("n_splats", "area", "large_area", "made_area", "n_too_small")
        )
        return SizesNeeded(n, large / area, made / area, n_too_small)


def create_sizes(folder: Path, n_splats: int) -> None:
    """The arrays that `pipeline.splats.decoded.splat_radii` reads, in a folder of a stage."""
    n_chunks, block = -(-n_splats // CHUNK), arrays.BLOCK // CHUNK
    arrays.create(folder, "size_code", (n_splats,), "uint8")
    arrays.create(folder, "size_scale", (n_chunks, 2), "uint8", (block, 2))
    arrays.create(folder, "size_cells", (n_chunks,), "uint8", (block,))


def write_sizes(folder: Path, start: int, code: np.ndarray, scales: Scales) -> None:
    """Codes (n,) and scales of the splats from `start` on, which begins a chunk."""
    arrays.write(folder, "size_code", start, code)
    arrays.write(folder, "size_scale", start // CHUNK, scales.step)
    arrays.write(folder, "size_cells", start // CHUNK, scales.cells)
