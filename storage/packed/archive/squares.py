"""Where the squares of splats lie on the plane of their chunk, what their sides are, and how light their averages are:
what the textures of neighbours are continued by. All is near what "Square" and "Color" of docs/FORMAT.md say, not just
that: by sums in a given order of numbers that every machine finds alike.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from storage.packed.archive.coder import compiled
from storage.packed.schema import BOXES, COLOR_TURN_W, TURN_W, Header, color_bits, normal_steps, steps_of

PLANES = np.array([[1, 2, 0], [0, 2, 1], [0, 1, 2]])  # by the axis of heights: those of the plane, and it
SIZES = 16  # of a chunk
_SHARPEST = 127  # of normals' bytes
_STEPS = 16  # of an octave
_ROOTS = np.rint(65536 * 2.0 ** (np.arange(_STEPS) / _STEPS)) / 65536
_THIRD = 0.57735  # of what lies on the axis of luma, a channel
_LEAST, _MOST = 2.0**-40, 2.0**40


@dataclass(frozen=True)
class Squares:
    """Of c chunks, lengths in sides of their cells' longest."""

    along: np.ndarray  # (c, 3, 3) float64: both axes of the plane and that of heights
    maps: np.ndarray  # (c, 8) int64: steps of the octahedral map, where both steps of normals begin, four slopes, lean
    radii: np.ndarray  # (c, SIZES) float64: by the size of a splat
    lights: np.ndarray  # (c, 4) float64: halves of a 255th of a colour of cells 0, and of a cell more each
    upright: np.ndarray  # (2, 3) float64: up, ahead

    @property
    def arrays(self) -> tuple[np.ndarray, ...]:
        """What compiled loops take."""
        return self.along, self.maps, self.radii, self.lights, self.upright


def power_of_steps(steps: np.ndarray) -> np.ndarray:
    """2^(steps / 16), to 1 in 65,536."""
    return np.ldexp(_ROOTS[steps % _STEPS], (steps // _STEPS).astype(np.int32))


def squares_of(header: Header, tables: dict[str, np.ndarray], axis: np.ndarray, n_sizes: np.ndarray) -> Squares:
    """Of a group's chunks; `axis` (c,) is that of heights, of boxes, `n_sizes` (c,) how many values sizes have."""
    c, lights, maps = header.n_chunks, np.zeros((header.n_chunks, 4)), np.zeros((header.n_chunks, 8), np.int64)
    if header.geometry == BOXES:
        along, maps[:, :3] = np.eye(3)[PLANES[axis]], (_SHARPEST, -_SHARPEST, -_SHARPEST)
        side = (tables["box_size"].astype(np.float64) / 2.0 ** tables["box_bits"].astype(np.int64)).max(axis=1)
    else:
        side = steps_of(tables["frame_step"])
        along = _rows_of(tables["frame_turn"], TURN_W)
        maps[:, 0], maps[:, 1:3] = normal_steps(tables["normal_grid"]), tables["normal_low"]
        maps[:, 3:7], maps[:, 7] = tables["normal_slope"], tables["normal_lean"]
    size = np.full((c, SIZES), 8 * _STEPS)
    if header.size_bits:
        low, high = tables["size_scale"].astype(np.int64).T[:, :, None]
        most = np.maximum(n_sizes - 1, 1)[:, None]
        size = (2 * (low * most + (high - low) * np.arange(SIZES)) + most) // (2 * most)
    longest = np.where((side > 0) & np.isfinite(side), side, 1)[:, None]
    radii = (header.radius * power_of_steps(size - 8 * _STEPS) / longest).clip(_LEAST, _MOST)
    if header.color_step:
        extent = power_of_steps(tables["color_size"].astype(np.int64) - 6 * _STEPS)
        cell = extent / 2.0 ** color_bits(tables["color_size"], header.color_step)
        least, turn = tables["color_low"] / 32 + cell / 2, _rows_of(tables["color_turn"], COLOR_TURN_W)[:, :, 0]
        first = least[:, 0] * turn[:, 0] + least[:, 1] * turn[:, 1] + least[:, 2] * turn[:, 2]
        lights = 2 * _THIRD * np.concatenate([first[:, None], cell * turn], axis=1)
    return Squares(along, maps, radii, lights, np.array([header.up, header.ahead], np.float64))


def _rows_of(turn: np.ndarray, w: int) -> np.ndarray:
    """The axes (c, 3, 3), as rows, of quaternions with whole x, y, z (c, 3) and w, of any length."""
    x, y, z = turn.astype(np.float64).T
    square = x * x + y * y + z * z + w * w
    rows = [
        [square - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)],
        [2 * (x * y - z * w), square - 2 * (x * x + z * z), 2 * (y * z + x * w)],
        [2 * (x * z + y * w), 2 * (y * z - x * w), square - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=1) / square[:, None] for row in rows], axis=1)


@compiled
def octahedral(a, b, steps):
    """The point of the octahedron of `steps` that coordinates name, in whole numbers."""
    if abs(a) > steps:
        a, b = 2 * steps * (1 if a > 0 else -1) - a, -b
    if abs(b) > steps:
        a, b = -a, 2 * steps * (1 if b > 0 else -1) - b
    c = steps - abs(a) - abs(b)
    if c >= 0:
        return a, b, c
    return (steps - abs(b)) * (1 if a >= 0 else -1), (steps - abs(a)) * (1 if b >= 0 else -1), c


@compiled
def axes_of(a, b, u, v, map_, along, upright, found):
    """The axes of the square of a splat, first both parts of u, then of v, along the plane's and that of heights, in
    `found` (6,): `a` and `b` are the steps of its normal, `u` and `v` the half cells that it lies from the middle."""
    steps = map_[0]
    b += map_[2] + ((map_[5] * u + map_[6] * v) >> 8) + ((map_[7] * a) >> 6)
    a += map_[1] + ((map_[3] * u + map_[4] * v) >> 8)
    a, b = min(max(a, -2 * steps), 2 * steps), min(max(b, -2 * steps), 2 * steps)
    n0, n1, n2 = octahedral(a, b, steps)
    x, y, z = np.float64(n0), np.float64(n1), np.float64(n2)
    up, square = upright[0], x * x + y * y + z * z
    rises = x * up[0] + y * up[1] + z * up[2]
    level = 100 * rises * rises > 81 * square * (up[0] * up[0] + up[1] * up[1] + up[2] * up[2])
    r = upright[1] if level else up
    u0, u1, u2 = r[1] * z - r[2] * y, r[2] * x - r[0] * z, r[0] * y - r[1] * x
    by = 1 / (np.sqrt(u0 * u0 + u1 * u1 + u2 * u2) + 1e-30)
    u0, u1, u2, by = u0 * by, u1 * by, u2 * by, 1 / (np.sqrt(square) + 1e-30)
    v0, v1, v2 = (y * u2 - z * u1) * by, (z * u0 - x * u2) * by, (x * u1 - y * u0) * by
    for k in range(3):
        found[k] = u0 * along[k, 0] + u1 * along[k, 1] + u2 * along[k, 2]
        found[3 + k] = v0 * along[k, 0] + v1 * along[k, 1] + v2 * along[k, 2]
