"""Patches' averages -> the colours that the packed file has of them, against which texture is coded."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.numerics.accuracy import psnr_db
from pipeline.stages.texture.contrast_octaves import census
from pipeline.stages.texture.resample import n_coarser_of
from pipeline.summaries import AverageColors
from pipeline.texture.colors import ColorBoxes, decode_colors, encode_colors, fit_color_boxes
from pipeline.texture.resample import PATCH_DIM
from storage.packed.schema import BY_NAME, CHUNK, COLOR_BOXES
from storage.work import arrays, work

STEP = "step.json"  # the code of the largest cell of boxes


@dataclass(frozen=True)
class ColorsBlock:
    """What a task tells of its block: what colours lose, and splats by octave of what these leave."""

    n_splats: int
    lost: float
    census: list[int]


@dataclass(frozen=True)
class Colors:
    """A task a block. Arrays by splat: energy (n,) float32, squared norm of the patch less its average colour as it is
    decoded (`average_colors`); with boxes color_code (n,) uint32, and by chunk color_low (c, 3) int16, color_size (c,
    3) uint8, color_turn (c, 3) int8; without average (n, 3) float32. The census, of octaves of energy, is of the finest
    level."""

    patches: Path
    step: int  # code of the largest cell of boxes; 0: averages are whole bytes
    name = "colors"

    def init(self, folder: Path) -> int:
        n = arrays.layout_of(self.patches, "energy").shape[0]
        arrays.create(folder, "energy", (n,), "float32")
        work.write_json(folder / STEP, self.step)
        if not self.step:
            arrays.create(folder, "average", (n, 3), "float32")
        else:
            arrays.create(folder, "color_code", (n,), "uint32")
            for name in COLOR_BOXES:
                arrays.create(folder, name, (-(-n // CHUNK), 3), BY_NAME[name].dtype, (arrays.BLOCK // CHUNK, 3))
        return arrays.n_blocks(n)

    def run(self, folder: Path, index: int) -> ColorsBlock:
        start, stop = arrays.block_range(index, arrays.layout_of(self.patches, "energy").shape[0])
        exact = arrays.read(self.patches, "average", start, stop).astype(np.float64)
        average = self._in_boxes(folder, start, exact) if self.step else np.floor(exact + 0.5).astype(np.float32)
        if not self.step:
            arrays.write(folder, "average", start, average)
        lost = ((average - exact) ** 2).sum(axis=1) * (PATCH_DIM // 3 / 255**2)
        energy = (arrays.read(self.patches, "energy", start, stop) + lost).astype(np.float32)
        finest = max(0, n_coarser_of(self.patches) - start)
        arrays.write(folder, "energy", start, energy)
        return ColorsBlock(n_splats=stop - start, lost=float(lost.sum()), census=census(energy[finest:]).tolist())

    def finalise(self, folder: Path, results: list[ColorsBlock]) -> AverageColors:
        n = sum(r.n_splats for r in results)
        census = np.sum([r.census for r in results], axis=0).tolist()
        return AverageColors(n, psnr_db(sum(r.lost for r in results), n * PATCH_DIM), tuple(census))

    def _in_boxes(self, folder: Path, start: int, exact: np.ndarray) -> np.ndarray:
        boxes = fit_color_boxes(exact, self.step)
        code = encode_colors(exact, boxes)
        arrays.write(folder, "color_code", start, code)
        for name, rows in boxes.arrays().items():
            arrays.write(folder, name, start // CHUNK, rows)
        return decode_colors(code, boxes)


def average_colors(colors: Path, start: int, stop: int) -> np.ndarray:
    """Average colours (m, 3) float32 in 255ths of splats start..stop, as they are decoded."""
    if arrays.exists(colors, "average"):
        return arrays.read(colors, "average", start, stop)
    first, end = start // CHUNK, -(-stop // CHUNK)
    of_chunks = {name: arrays.read(colors, name, first, end) for name in COLOR_BOXES}
    code, step = arrays.read(colors, "color_code", first * CHUNK, stop), work.read_json(colors / STEP)
    return decode_colors(code, ColorBoxes.of_arrays(of_chunks, step))[start - first * CHUNK :]
