"""Survey: for every cell of an eye's picture, which of the points that it sees is nearest to that cell.

A scan's edges are known to half a spacing: somewhere between the last point in front and the first one behind. Handing
every cell to its nearest point puts the edge in the middle.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import distance_transform_edt

from pipeline.effects.block import Sources
from pipeline.effects.cliplines.eyes import cell_of, eyes_of, seen_by_eye
from pipeline.execution.compiled import kernel
from pipeline.splats.boxes import boxes_of
from storage.work import arrays, tiles

CELLS_A_RADIUS = 3.0
UNKNOWN = np.float32(np.nan)


@dataclass(frozen=True)
class Scales:
    """Of the survey: the cells a unit of each eye's picture."""

    scale: tuple[float, ...]


@dataclass(frozen=True)
class EyeScaled:
    """What a task tells of its eye."""

    scale: float


@dataclass(frozen=True)
class NearestPoints:
    """A task an eye; it streams the blocks that may lie in its picture. Tiles nearest_<i> (h, w, 3) float32: the
    position, against the scan's origin, of the point nearest to each cell of eye i, or NaN throughout where it sees
    nothing."""

    sources: Sources
    tile_px: int = tiles.TILE  # so that a work folder of other tiles is not taken for this one's
    name = "nearest-points"

    def init(self, folder: Path) -> int:
        return len(eyes_of(self.sources))

    def run(self, folder: Path, index: int) -> EyeScaled:
        s = self.sources
        eye = eyes_of(s)[index]
        scale = eye.scale_for(self._median_distance(index), s.radius, CELLS_A_RADIUS)
        position = np.full((*eye.shape(scale), 3), UNKNOWN, np.float32)
        distance = np.full(eye.shape(scale), np.inf)
        low, high = (corner + s.origin for corner in boxes_of(s.partition))
        for block in (s.block(i) for i in range(arrays.n_blocks(s.n_splats)) if eye.may_see(low[i], high[i])):
            _keep_nearest(
                position, distance, eye.numbers, eye.around, scale, block.position, s.origin, seen_by_eye(block, index)
            )
        if np.isfinite(distance).any():
            row, column = distance_transform_edt(~np.isfinite(distance), return_distances=False, return_indices=True)
            position = position[row, column]
        tiles.store_tiles(folder, f"nearest_{index}", position)
        return EyeScaled(scale=scale)

    def finalise(self, folder: Path, results: list[EyeScaled]) -> Scales:
        return Scales(tuple(r.scale for r in results))

    def _median_distance(self, index: int) -> float:
        """Of the middles of the blocks that lie in the eye's picture; 1 where none does."""
        low, high = boxes_of(self.sources.partition)
        middle = (low + high) / 2 + self.sources.origin
        distance = eyes_of(self.sources)[index].distances(middle)
        return float(np.nanmedian(distance)) if np.isfinite(distance).any() else 1.0


@kernel()
def _keep_nearest(position, distance, eye, around, scale, points, origin, seen):
    """Let each cell have, of the points that fall into it, the one nearest to the eye; the first of equals."""
    height, width = distance.shape
    for i in range(len(points)):
        if not seen[i]:
            continue
        p = points[i]
        row, column, away = cell_of(
            eye, around, scale, width, height, p[0] + origin[0], p[1] + origin[1], p[2] + origin[2]
        )
        if row >= 0 and away < distance[row, column]:
            distance[row, column] = away
            for k in range(3):
                position[row, column, k] = p[k]
