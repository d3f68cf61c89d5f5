"""Depth maps of the cameras, for scans whose photographs do not say what they see."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.splats.boxes import boxes_of
from pipeline.splats.decoded import splat_radii
from pipeline.splats.visibility import draw_points, empty_map, map_scale
from pipeline.summaries import Points, ScanRead
from storage.packed.schema import Camera
from storage.work import arrays, work


@dataclass(frozen=True)
class DepthMaps:
    """A task a camera; it streams all points. Arrays: depth_<i> (height, width) float32, inf where nothing is."""

    ingest: Path
    partition: Path
    radius: float
    sizes: Path | None = None  # size_code and size_scale: each splat is as large as it is drawn
    name = "depth-maps"

    def init(self, folder: Path) -> int:
        return len(work.summary(self.ingest, ScanRead).cameras)

    def run(self, folder: Path, index: int) -> None:
        points = work.summary(self.partition, Points)
        camera = work.summary(self.ingest, ScanRead).cameras[index]
        depth_map = empty_map(camera, map_scale(camera, self._median_depth(points, camera), self.radius))
        for block in range(arrays.n_blocks(points.n_splats)):
            rows = arrays.block_range(block, points.n_splats)
            position = arrays.read(self.partition, "position", *rows)
            draw_points(depth_map, camera, position + points.origin, splat_radii(self.sizes, self.radius, *rows))
        arrays.store(folder, f"depth_{index}", depth_map.astype(np.float32, copy=False), depth_map.shape)

    def finalise(self, folder: Path, results: list[None]) -> None:
        """Nothing is told but the arrays."""

    def _median_depth(self, points: Points, camera: Camera) -> float:
        """Of the middles of the blocks in front of the camera."""
        low, high = boxes_of(self.partition)
        middle = (low + high) / 2 + points.origin
        depth = (middle - camera.centre) @ np.array(camera.rotation)[2]
        return float(np.median(depth[depth > 0])) if (depth > 0).any() else 1.0
