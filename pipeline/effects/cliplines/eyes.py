"""What a scan was seen from, a camera or a laser's station, as one thing: a picture that points fall into."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi

import numpy as np

from pipeline.effects.block import Block, Sources
from pipeline.execution.compiled import kernel
from pipeline.splats.visibility import seen_points
from storage.packed.schema import Camera
from storage.work import arrays

STATION_CELLS = 4096  # around the whole circle, at most: 1.5 mm at a metre, finer than scanners step


@dataclass(frozen=True)
class Eye:
    """A camera, or a station that looks all around: what is seen falls into cells (x, y), at a scale of 1."""

    numbers: np.ndarray  # (16,) float64, of `project`: centre, rotation row by row, focal lengths and middle in cells
    around: bool  # azimuth along x and elevation along y, as a scanner steps, from the centre alone
    width: int
    height: int
    cells_a_unit: float  # how many cells a unit of length spans at a distance of 1

    def scale_for(self, distance: float, radius: float, cells_a_radius: float) -> float:
        """How much coarser a picture may be for a radius at this distance to span so many cells; at most 1."""
        return float(min(1.0, cells_a_radius * distance / (radius * self.cells_a_unit)))

    def shape(self, scale: float) -> tuple[int, int]:
        return max(1, int(self.height * scale)), max(1, int(self.width * scale))

    def distances(self, points: np.ndarray) -> np.ndarray:
        """Of points (n, 3), absolute, from the eye; NaN for what is not seen."""
        return np.array([project(self.numbers, self.around, *point)[2] for point in points.tolist()])

    def may_see(self, low: np.ndarray, high: np.ndarray) -> bool:
        """Whether any point of a box, absolute, may fall into the picture: not if one of its sides leaves out all
        corners."""
        if self.around:
            return True
        corners = np.stack(np.meshgrid(*zip(low, high)), axis=-1).reshape(-1, 3)
        x, y, depth = ((corners - self.numbers[:3]) @ self.numbers[3:12].reshape(3, 3).T).T
        fx, fy, cx, cy = self.numbers[12:]
        left, top = fx * x + cx * depth, fy * y + cy * depth
        outside = (depth, left, top, self.width * depth - left, self.height * depth - top)
        return not any((side < 0).all() for side in outside)


def eyes_of(sources: Sources) -> tuple[Eye, ...]:
    """The cameras of a scan, or without any its stations."""
    if sources.cameras:
        return tuple(_camera_eye(camera) for camera in sources.cameras)
    return tuple(_station_eye(np.array(station)) for station in sources.scan.stations)


def eye_of_splats(block: Block) -> np.ndarray:
    """The eye that each splat was seen from best, (n,) int64; -1 for none."""
    s = block.sources
    if s.cameras:
        return np.where(block.has_camera, block.camera.astype(np.int64), -1)
    return block.station


def seen_by_eye(block: Block, eye: int) -> np.ndarray:
    """Which splats of a block an eye sees, (n,) bool; column `eye` of `block.seen`, without the other cameras'."""
    s = block.sources
    if not s.cameras:
        return block.station == eye
    if s.depth_maps is None:
        return (block.read(s.partition, "candidate") == eye).any(axis=1)
    depth_map = arrays.read(s.depth_maps, f"depth_{eye}")
    return seen_points(depth_map, s.cameras[eye], block.centre + s.origin, block.frame[2], block.radius)


@kernel()
def project(eye, around, px, py, pz):
    """Cell x and y at a scale of 1, and distance, of an absolute point; NaN for what an eye (its `numbers`) does not
    see."""
    x, y, z = px - eye[0], py - eye[1], pz - eye[2]
    if around:
        distance = np.sqrt(x * x + y * y + z * z)
        if not distance > 0:
            return np.nan, np.nan, np.nan
        elevation = np.arccos(min(1.0, max(-1.0, z / distance)))
        return (np.arctan2(y, x) + pi) * eye[12], elevation * eye[13], distance
    depth = eye[9] * x + eye[10] * y + eye[11] * z
    if not depth > 0:
        return np.nan, np.nan, np.nan
    across, down = eye[3] * x + eye[4] * y + eye[5] * z, eye[6] * x + eye[7] * y + eye[8] * z
    return across / depth * eye[12] + eye[14], down / depth * eye[13] + eye[15], depth


@kernel()
def cell_of(eye, around, scale, width, height, px, py, pz):
    """Row and column of the cell of a picture that an absolute point falls into, and its distance; -1 for none."""
    x, y, distance = project(eye, around, px, py, pz)
    column, row = np.floor(x * scale), np.floor(y * scale)
    if not (column >= 0 and row >= 0 and column < width and row < height):
        return -1, -1, np.nan
    return int(row), int(column), distance


def _camera_eye(camera: Camera) -> Eye:
    numbers = (*camera.centre, *np.ravel(camera.rotation), camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px)
    return Eye(np.array(numbers, np.float64), False, camera.width_px, camera.height_px, max(camera.fx_px, camera.fy_px))


def _station_eye(centre: np.ndarray) -> Eye:
    """Its seam and its poles are edges of the picture."""
    cells = STATION_CELLS / (2 * pi)
    numbers = np.array([*centre, *np.eye(3).ravel(), cells, cells, 0, 0], np.float64)
    return Eye(numbers, True, STATION_CELLS, STATION_CELLS // 2, cells)
