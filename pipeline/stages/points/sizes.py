"""Spacing -> a radius for each splat, in steps of its chunk's scale; and whether one radius would do."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pipeline.geometry.sizes import decode_sizes, encode_sizes, fit_scales
from pipeline.splats.sizes import areas, needed_sizes
from pipeline.summaries import Points, SizesNeeded
from storage.packed.schema import CHUNK
from storage.work import arrays, work


@dataclass(frozen=True)
class Sizes:
    """A task a block. Arrays: size_code (n,) uint8 and, by chunk, size_scale (c, 2) uint8. The summary has the share of the
    surface whose splats need to be LARGE."""

    partition: Path
    neighbours: Path
    radius: float
    name = "sizes"

    def init(self, folder: Path) -> int:
        n = work.summary(self.partition, Points).n_splats
        create_sizes(folder, n)
        return arrays.n_blocks(n)

    def run(self, folder: Path, index: int) -> dict:
        start, stop = arrays.block_range(index, work.summary(self.partition, Points).n_splats)
        position = arrays.read(self.partition, "position", start, stop)
        size = needed_sizes(position, arrays.read(self.neighbours, "spacing", start, stop), self.radius)
        scales = fit_scales(size, self.radius)
        code = encode_sizes(size, scales)
        arrays.write(folder, "size_code", start, code)
        arrays.write(folder, "size_scale", start // CHUNK, scales.step)
        area, large = areas(size, self.radius)
        made = decode_sizes(code, scales)
        return {
            "n_splats": stop - start,
            "area": area,
            "large_area": large,
            "made_area": areas(made, self.radius)[0],
            "n_too_small": int((made < size * (1 - 1e-6)).sum()),
        }

    def finalise(self, folder: Path, results: list[dict]) -> SizesNeeded:
        n, area, large, made, n_too_small = (
            sum(r[k] for r in results) for k in ("n_splats", "area", "large_area", "made_area", "n_too_small")
        )
        return SizesNeeded(n, large / area, made / area, n_too_small)


def create_sizes(folder: Path, n_splats: int) -> None:
    """The arrays that `pipeline.splats.decoded.splat_radii` reads, in a folder of a stage."""
    arrays.create(folder, "size_code", (n_splats,), "uint8")
    arrays.create(folder, "size_scale", (-(-n_splats // CHUNK), 2), "uint8", (arrays.BLOCK // CHUNK, 2))
