"""The texels of patches that `Resample` or `ResampleMaps` made: read where they were kept, else made again."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from pipeline.stages.texture.resample import Resample
from pipeline.texture.resample import PATCH_DIM
from storage.work import arrays


def texel_pieces(patches: Path, start: int, stop: int, rows: int) -> Iterator[tuple[int, np.ndarray]]:
    """Texels (m, PATCH_DIM) uint8 of splats start..stop, `rows` at a time and less at the end of a block, each with its
    first splat; not to be written to, and good until the next is asked for."""
    if _kept(patches):
        yield from arrays.pieces(patches, "texel", start, stop, rows)
        return
    stage = Resample.of(patches)
    for block in range(start // arrays.BLOCK, -(-stop // arrays.BLOCK)):
        first, end = max(start, block * arrays.BLOCK), min(stop, (block + 1) * arrays.BLOCK)
        texel = stage.again(block, np.arange(first, end) - block * arrays.BLOCK)
        for at in range(first, end, rows):
            yield at, texel[at - first : min(at + rows, end) - first]


def texel_rows(patches: Path, rows: np.ndarray) -> np.ndarray:
    """Texels (m, PATCH_DIM) uint8 of the splats `rows` (m,), ascending."""
    if _kept(patches):
        return arrays.read_rows(patches, "texel", rows)
    stage, texel = Resample.of(patches), np.empty((len(rows), PATCH_DIM), np.uint8)
    blocks, firsts = np.unique(rows // arrays.BLOCK, return_index=True)
    for block, first, end in zip(blocks.tolist(), firsts, [*firsts[1:], len(rows)]):
        texel[first:end] = stage.again(block, rows[first:end] - block * arrays.BLOCK)
    return texel


def points_of(patches: Path, start: int = 0, stop: int | None = None) -> np.ndarray:
    """Places of splats start..stop in the scan's files, (m,) int64 or uint32."""
    return arrays.read(patches if _kept(patches) else Resample.of(patches).partition, "point", start, stop)


def _kept(patches: Path) -> bool:
    return arrays.exists(patches, "texel")
