"""What a scan was seen from, a camera or a laser's station, as one thing: a picture that points fall into."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pipeline.effects.block import Block, Sources
from storage.schema import Camera

STATION_CELLS = 4096  # around the whole circle, at most: 1.5 mm at a metre, finer than scanners step


@dataclass(frozen=True)
class Eye:
    """`project` maps points (n, 3), absolute, to cells (x, y) at a scale of 1 and to distances from the eye; what is not
    seen has a distance of NaN. `cells_a_unit` is how many cells a unit of length spans at a distance of 1."""

    project: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]
    width: int
    height: int
    cells_a_unit: float

    def scale_for(self, distance: float, radius: float, cells_a_radius: float) -> float:
        """How much coarser a picture may be for a radius at this distance to span so many cells; at most 1."""
        return float(min(1.0, cells_a_radius * distance / (radius * self.cells_a_unit)))

    def shape(self, scale: float) -> tuple[int, int]:
        return max(1, int(self.height * scale)), max(1, int(self.width * scale))


def eyes_of(sources: Sources) -> tuple[Eye, ...]:
    """The cameras of a scan, or without any its stations."""
    if sources.cameras:
        return tuple(_camera_eye(camera) for camera in sources.cameras)
    return tuple(_station_eye(np.array(station)) for station in sources.scan["stations"])


def eye_of_splats(block: Block) -> np.ndarray:
    """The eye that each splat was seen from best, (n,) int64; -1 for none."""
    s = block.sources
    if s.cameras:
        return np.where(block.has_camera, block.camera.astype(np.int64), -1)
    return block.station


def seen_by_eye(block: Block, eye: int) -> np.ndarray:
    """Which splats of a block an eye sees, (n,) bool."""
    return block.seen[:, eye] if block.sources.cameras else block.station == eye


def cells_of(eye: Eye, scale: float, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Row and column (n,) int64, clamped to the picture, and whether each point lies in it."""
    x, y, distance = eye.project(points)
    height, width = eye.shape(scale)
    with np.errstate(invalid="ignore"):
        column, row = np.floor(np.nan_to_num(x * scale, nan=-1)), np.floor(np.nan_to_num(y * scale, nan=-1))
        inside = (distance > 0) & (column >= 0) & (row >= 0) & (column < width) & (row < height)
    return np.clip(row, 0, height - 1).astype(np.int64), np.clip(column, 0, width - 1).astype(np.int64), inside


def _camera_eye(camera: Camera) -> Eye:
    rotation, centre = np.asarray(camera.rotation), np.asarray(camera.centre)

    def project(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        local = (points - centre) @ rotation.T
        depth = np.where(local[:, 2] > 0, local[:, 2], np.nan)
        return local[:, 0] / depth * camera.fx_px + camera.cx_px, local[:, 1] / depth * camera.fy_px + camera.cy_px, depth

    return Eye(project, camera.width_px, camera.height_px, max(camera.fx_px, camera.fy_px))


def _station_eye(centre: np.ndarray) -> Eye:
    """Azimuth along x, elevation along y, as a scanner steps. Its seam and its poles are edges of the picture."""
    cells = STATION_CELLS / (2 * np.pi)

    def project(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        local = points - centre
        distance = np.linalg.norm(local, axis=1)
        distance = np.where(distance > 0, distance, np.nan)
        azimuth = np.arctan2(local[:, 1], local[:, 0]) + np.pi
        return azimuth * cells, np.arccos(np.clip(local[:, 2] / distance, -1, 1)) * cells, distance

    return Eye(project, STATION_CELLS, STATION_CELLS // 2, cells)
