"""The demo's volume: a gyroid within a ball, as a CT would have it: 8-bit grey values in a NRRD file."""

from __future__ import annotations

from pathlib import Path

import numpy as np

N_SIDE, SPACING_MM = 112, 0.5
PERIODS, BALL = 1.6, 0.86  # of the gyroid from the middle to the border; the ball's radius, of the same
ISO = 128  # that the demo asks for; values are of the solid from there on
STEEPNESS = 60.0  # grey values a unit of the gyroid's formula
BALL_STEEPNESS = 400.0  # the same of the distance from the ball


def write_volume(folder: Path) -> Path:
    """Write `scan.nrrd` into `folder`; returns its path."""
    import nrrd

    side = np.linspace(-1, 1, N_SIDE)
    x, y, z = np.meshgrid(side, side, side, indexing="ij")
    a, b, c = (np.pi * 2 * PERIODS * axis for axis in (x, y, z))
    gyroid = np.sin(a) * np.cos(b) + np.sin(b) * np.cos(c) + np.sin(c) * np.cos(a)
    within = BALL - np.sqrt(x * x + y * y + z * z)
    value = ISO - STEEPNESS * 0.13 + _smaller(STEEPNESS * gyroid, BALL_STEEPNESS * within)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "scan.nrrd"
    nrrd.write(
        str(path),
        np.clip(value, 0, 255).astype(np.uint8),
        {"spacings": [SPACING_MM] * 3, "space units": ["mm"] * 3, "space dimension": 3},
    )
    return path


def _smaller(a: np.ndarray, b: np.ndarray, width: float = 12.0) -> np.ndarray:
    """The smaller of two, rounded where they are about the same: edges of the solid are no sharper than voxels."""
    share = np.clip(0.5 + 0.5 * (b - a) / width, 0, 1)
    return a * share + b * (1 - share) - width * share * (1 - share)
