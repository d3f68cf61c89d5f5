"""Laser scans of a room, as a scanner makes them: rays in even steps from each station to the nearest wall or pillar.

The colour of a point is a known function of where it lies, so what a map or a patch should show is known too.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pye57

HALF = np.array([3.0, 2.5, 1.5])  # of the room, whose middle is zero
PILLAR = np.array([1.2, 0.4, 0.25])  # x and y of its middle, and its half width


@dataclass(frozen=True)
class Seen:
    """What one station saw. Rows correspond."""

    centre: np.ndarray  # (3,)
    position: np.ndarray  # (n, 3)
    normal: np.ndarray  # (n, 3), towards the room
    color: np.ndarray  # (n, 3) uint8


def room_color(position: np.ndarray) -> np.ndarray:
    """(n, 3) float64 in [0, 255]: smooth waves of about half a metre, of other phases on every channel."""
    phase = position @ np.array([[9.0, 4.0, 5.0], [3.0, 11.0, 7.0], [6.0, 5.0, 10.0]]).T
    return 128 + 90 * np.sin(phase)


def cast(centre: np.ndarray, direction: np.ndarray, pillar: bool = True) -> tuple[np.ndarray, np.ndarray]:
    """Where rays (n, 3) from a point in the room end, (n, 3), and the normals there."""
    with np.errstate(divide="ignore", invalid="ignore"):
        to_wall = (np.where(direction > 0, HALF, -HALF) - centre) / direction
    to_wall[~np.isfinite(to_wall)] = np.inf
    axis = to_wall.argmin(axis=1)
    away = to_wall[np.arange(len(axis)), axis]
    normal = -np.eye(3)[axis] * np.sign(direction[np.arange(len(axis)), axis])[:, None]
    if pillar:
        low, high = PILLAR[:2] - PILLAR[2], PILLAR[:2] + PILLAR[2]
        with np.errstate(divide="ignore", invalid="ignore"):
            near, far = (low - centre[:2]) / direction[:, :2], (high - centre[:2]) / direction[:, :2]
        near, far = np.minimum(near, far), np.maximum(near, far)
        enter = near.max(axis=1)
        hit = (enter > 0) & (enter < far.min(axis=1)) & (enter < away)
        side = near.argmax(axis=1)
        away = np.where(hit, enter, away)
        of_pillar = -np.eye(3)[side] * np.sign(direction[np.arange(len(side)), side])[:, None]
        normal = np.where(hit[:, None], of_pillar, normal)
    return centre + away[:, None] * direction, normal


def scanned(
    centre, step_degrees: float = 1.0, lowest_degrees: float = -90.0, pillar: bool = True, gain: float = 1.0
) -> Seen:
    """A scan from `centre`; `gain` is of sRGB levels."""
    rows = np.radians(np.arange(lowest_degrees + step_degrees / 2, 90, step_degrees))
    theta = [
        2 * np.pi * np.arange(n) / n for n in np.maximum(1, np.rint(360 / step_degrees * np.cos(rows))).astype(int)
    ]
    psi = np.repeat(rows, [len(t) for t in theta])
    theta = np.concatenate(theta)
    direction = np.stack([np.cos(psi) * np.cos(theta), np.cos(psi) * np.sin(theta), np.sin(psi)], axis=1)
    centre = np.asarray(centre, np.float64)
    position, normal = cast(centre, direction, pillar)
    return Seen(centre, position, normal, np.rint(np.clip(gain * room_color(position), 0, 255)).astype(np.uint8))


def write_e57(path: Path, *stations: Seen) -> Path:
    """Their points in their own frames, each with the pose that brings them back."""
    file = pye57.E57(str(path), mode="w")
    try:
        for seen in stations:
            local = seen.position - seen.centre
            data = {f"cartesian{axis}": local[:, k] for k, axis in enumerate("XYZ")}
            data |= {f"color{name}": seen.color[:, k] for k, name in enumerate(("Red", "Green", "Blue"))}
            file.write_scan_raw(data, rotation=np.array([1.0, 0, 0, 0]), translation=seen.centre)
    finally:
        file.close()
    return path
