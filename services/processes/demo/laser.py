"""The demo's scan of points alone: a knot on a paved floor as a laser scanner's file has it, made from formulas.

A LAS file of coloured points with a scanner's noise and without normals, so that what `compress` does for scans of
points alone (normals estimated, one colour a splat) can be tried on it.
"""

from __future__ import annotations

from datetime import date
from pathlib import Path

import numpy as np

N_KNOT, N_FLOOR = 110_000, 70_000
TUBE_M, KNOT_M, FLOOR_M = 0.16, 0.5, 1.6  # radius of the tube, size of the knot, radius of the floor
NOISE_M = 0.0005
SLAB_M, JOINT_M = 0.32, 0.012  # of the paving
STEP_M = 1e-4  # of the file's whole numbers


def write_laser_scan(folder: Path) -> Path:
    """Write `scan.las` into `folder`; returns its path."""
    import laspy

    choice = np.random.default_rng(0)
    parts = [_knot(), _floor()]
    position, color = (np.concatenate([part[i] for part in parts]) for i in (0, 1))
    position = position + choice.normal(0, NOISE_M, position.shape)
    header = laspy.LasHeader(point_format=2, version="1.2")
    header.scales, header.offsets = np.full(3, STEP_M), np.zeros(3)
    header.creation_date = date(2026, 1, 1)
    las = laspy.LasData(header)
    las.x, las.y, las.z = position.T
    las.red, las.green, las.blue = (color * 65535).round().astype(np.uint16).T
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "scan.las"
    las.write(path)
    return path


def _knot() -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) of a tube around a trefoil knot, and their colours (n, 3) in [0, 1]."""
    along, around = 2 * np.pi * _even(N_KNOT)
    centre, step = _trefoil(along), 1e-4
    tangent = _unit(_trefoil(along + step) - centre)
    side = _unit(np.cross(tangent, [0.0, 0.0, 1.0]))
    up = np.cross(side, tangent)
    position = centre + TUBE_M * (np.cos(around)[:, None] * side + np.sin(around)[:, None] * up)
    band = 0.5 + 0.5 * np.cos(24 * along + 2 * around)
    warm = 0.5 + 0.5 * np.cos(along[:, None] + np.array([0.0, 2.1, 4.2]))
    return position, 0.2 + 0.7 * (0.35 + 0.65 * (band > 0.5))[:, None] * warm


def _trefoil(t: np.ndarray) -> np.ndarray:
    """The knot's centre line at t, (n, 3) metres, above a floor at 0."""
    flat = np.stack([np.sin(t) + 2 * np.sin(2 * t), np.cos(t) - 2 * np.cos(2 * t)], axis=1) * KNOT_M / 1.5
    return np.column_stack([flat, 0.45 - 0.27 * np.sin(3 * t)])


def _floor() -> tuple[np.ndarray, np.ndarray]:
    """Points of a paved disc, each slab a little lighter or darker than the next, and their colours."""
    share, turn = _even(N_FLOOR)
    radius, angle = FLOOR_M * np.sqrt(share), 2 * np.pi * turn
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    slab = np.stack([np.floor(x / SLAB_M), np.floor(y / SLAB_M)])
    lightness = 0.55 + 0.12 * np.sin(12.9898 * slab[0] + 78.233 * slab[1])
    joint = (np.minimum(x % SLAB_M, y % SLAB_M)) < JOINT_M
    grey = np.where(joint, 0.25, lightness)
    return np.column_stack([x, y, np.zeros(N_FLOOR)]), grey[:, None] * np.array([1.0, 0.96, 0.9])


def _even(n: int) -> np.ndarray:
    """n points of the unit square, (2, n), evenly spread: additive recurrence by the powers of the plastic number."""
    plastic = 1.32471795724474602596
    return (0.5 + np.arange(n) * np.array([[1 / plastic], [1 / plastic**2]])) % 1


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v, axis=1, keepdims=True)
