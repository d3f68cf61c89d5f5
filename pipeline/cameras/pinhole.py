"""The pinhole of a photograph: depth is measured along the optical axis."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.execution.compiled import kernel
from storage.packed.schema import Camera


@dataclass(frozen=True)
class Pinhole:
    """A `Projection` (camera.py): pixel = f * xy / z + c of x_cam = rotation @ (x - centre)."""

    camera: Camera

    @property
    def size(self) -> tuple[int, int]:
        return self.camera.width_px, self.camera.height_px

    @property
    def centre(self) -> tuple[float, float, float]:
        return self.camera.centre

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        pixels, depth = np.empty((len(points), 2)), np.empty(len(points))
        local = np.asarray(points, np.float64) - np.asarray(self.camera.centre)
        _project(local, self._rotation, self._calibration, pixels, depth)
        return pixels, depth

    def unproject(self, pixels: np.ndarray, depth: np.ndarray) -> np.ndarray:
        local = np.empty((len(pixels), 3))
        _unproject(np.asarray(pixels, np.float64), np.asarray(depth, np.float64), self._calibration, local)
        return local @ self._rotation + np.asarray(self.camera.centre)

    def footprint(self, pixels: np.ndarray) -> np.ndarray:
        """cos^3 of the angle to the optical axis, over fx fy."""
        fx, fy, cx, cy = self._calibration
        x, y = (np.asarray(pixels, np.float64) - (cx, cy)).T / [[fx], [fy]]
        return (1 + x * x + y * y) ** -1.5 / (fx * fy)

    @property
    def _rotation(self) -> np.ndarray:
        return np.array(self.camera.rotation, np.float64)

    @property
    def _calibration(self) -> np.ndarray:
        c = self.camera
        return np.array([c.fx_px, c.fy_px, c.cx_px, c.cy_px], np.float64)


@kernel()
def _project(local, rotation, calibration, pixels, depth):
    fx, fy, cx, cy = calibration
    for i in range(local.shape[0]):
        x, y, z = local[i]
        across = rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z
        down = rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z
        along = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z
        if along > 0:
            pixels[i, 0], pixels[i, 1], depth[i] = across / along * fx + cx, down / along * fy + cy, along
        else:
            pixels[i, 0], pixels[i, 1], depth[i] = np.nan, np.nan, np.nan


@kernel()
def _unproject(pixels, depth, calibration, local):
    fx, fy, cx, cy = calibration
    for i in range(pixels.shape[0]):
        local[i, 0] = (pixels[i, 0] - cx) / fx * depth[i]
        local[i, 1] = (pixels[i, 1] - cy) / fy * depth[i]
        local[i, 2] = depth[i]


def resized(camera: Camera, width_px: int, height_px: int) -> Camera:
    """The camera of the same picture at another size, of the same field of view.

    Guarantees: pixel edges map to pixel edges, so a picture at the photo's size lies on the photo pixel by pixel.
    """
    x, y = width_px / camera.width_px, height_px / camera.height_px
    return replace(
        camera,
        width_px=width_px,
        height_px=height_px,
        fx_px=camera.fx_px * x,
        cx_px=camera.cx_px * x,
        fy_px=camera.fy_px * y,
        cy_px=camera.cy_px * y,
    )
