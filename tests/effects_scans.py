"""Small scans that call for one effect and no other: what each has is known in closed form."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenImageIO as oiio

from tests.pipeline.readers.workspace import (
    DISTANCE,
    centre_of,
    texture,
    write_photo,
    write_ply,
    write_vis,
    write_workspace,
)

SIZE_PX, PARAMS = (320, 240), (400.0, 400.0, 160.0, 120.0)
STEP = 0.5  # how far the near half of `step_scan` stands before the far one
N_CAMERAS = 3


def wall_scan(path: Path, n_side: int = 90, gain: tuple[float, ...] = (1.0, 1.0, 1.0)) -> Path:
    """A flat wall with a smooth texture, seen whole by three photographs; `gain` is what each one's light is times."""
    write_workspace(path, n_side=n_side, params=PARAMS, size_px=SIZE_PX)
    points = np.stack(_grid(n_side), axis=1)
    _write_points(path, points, np.ones((len(points), N_CAMERAS), bool))
    for i, photo in enumerate(sorted((path / "images").iterdir())):
        if gain[i] != 1:
            pixels = oiio.ImageBuf(str(photo)).get_pixels(oiio.UINT8) / 255.0
            write_photo(photo, np.round(255 * _encoded(gain[i] * _linear(pixels))).astype(np.uint8))
    return path


def step_scan(path: Path, n_side: int = 91) -> Path:
    """A wall, and where x > 0 half a wall that stands STEP before it. Every point names the cameras that see it."""
    write_workspace(path, n_side=n_side, params=PARAMS, size_px=SIZE_PX)
    x, y, z = _grid(n_side)
    points = np.concatenate([np.stack([x, y, z], axis=1), np.stack([x, y, z - STEP], axis=1)[x > 0]])
    seen = np.ones((len(points), N_CAMERAS), bool)
    for i in range(N_CAMERAS):
        centre = centre_of(i, N_CAMERAS)
        share = (-STEP - centre[2]) / (
            points[:, 2] - centre[2]
        )  # of the way to each point, where the near plane is crossed
        crossing = centre[0] + share * (points[:, 0] - centre[0])
        seen[:, i] = (points[:, 2] < 0) | (crossing <= 0)
    _write_points(path, points, seen)
    return path


def _grid(n_side: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points of a wall, a little out of line so that no distances tie."""
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(-0.8, 0.8, n_side), np.linspace(-0.6, 0.6, n_side * 3 // 4)))
    jitter = np.random.default_rng(5).uniform(-0.1, 0.1, (2, len(x))) * 1.6 / n_side
    return x + jitter[0], y + jitter[1], np.zeros_like(x)


def _write_points(path: Path, points: np.ndarray, seen: np.ndarray) -> None:
    normal = np.tile(np.float32([0, 0, -1]), (len(points), 1))
    write_ply(path / "fused.ply", points.astype(np.float32), normal, texture(points[:, 0], points[:, 1]))
    write_vis(path / "fused.ply.vis", tuple(tuple(np.flatnonzero(row).tolist()) for row in seen))


def _linear(srgb: np.ndarray) -> np.ndarray:
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def _encoded(linear: np.ndarray) -> np.ndarray:
    linear = np.clip(linear, 0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


assert DISTANCE > STEP
