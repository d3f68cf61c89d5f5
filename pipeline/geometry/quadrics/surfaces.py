"""Chunks as pieces of surfaces: a frame of the smallest area, a quadric over it, and planes that their normals follow.

What numbers take is how far the outermost splats are apart, not how far all are from the mean: so surfaces are those
whose largest residual is the smallest, by Lawson's reweighted least squares.

Paper: Lawson, "Contributions to the theory of linear least maximum approximation", thesis, UCLA 1961.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from pipeline.geometry.normals import decode_normals, encode_normals, octahedron_of
from pipeline.geometry.quadrics.frames import wrapped
from pipeline.geometry.quadrics.quaternions import axes_of, quaternions_of
from storage.packed.schema import NORMAL_GRIDS, normal_steps

ANGLES = np.radians(np.arange(0, 90, 5.625))  # of U about N, of which that of the smallest area is taken
SMALLEST_STEP = 1e-30
LEAST_WEIGHT = 1e-9  # of all: what was near once may be far again
ROUNDS = 8  # of reweighting: half of them leave .03 bits of a quadric, twice as many take .01
STEEPEST = 1.0  # slope by which frames are turned from a chunk's plane of least squares
WHOLE, WIDEST = 6, 200  # the finest map whose 255 codes along an axis a byte counts; what normals of finer ones span


@dataclass(frozen=True)
class Surface:
    """Chunks as they lie in their frames."""

    point: np.ndarray  # (c, CHUNK, 3)
    grid: np.ndarray  # (c,) uint8: the octahedral map of normals, see normal_steps
    normal: np.ndarray  # (c, CHUNK, 2) int64 octahedral codes
    unfolded: (
        np.ndarray
    )  # (c, CHUNK, 2) the same next to the chunk's middle one, beyond the map's edges where that is nearer
    turn: np.ndarray  # (c, 3) int8
    middle: np.ndarray  # (c, 3) of the chunk's extents along the first two axes
    along: np.ndarray  # (c, CHUNK, 3) from that middle, along its frame's axes
    quadric: np.ndarray  # (c, 3) of a^2, a b, b^2
    plane: np.ndarray  # (c, 2, 2) slopes of both octahedral coordinates along a and b
    lean: np.ndarray  # (c,) how the second follows what the first's plane leaves
    extent: np.ndarray  # (c, 3) along the axes, the third over the quadric
    smallest: np.ndarray  # (c,) step below which float32 origins have no say
    size: np.ndarray  # (c, CHUNK) int64 codes of sizes
    sizes: np.ndarray  # (c,) uint8: how many values these have
    unit: np.ndarray  # (c,) of which origins are whole multiples at least, or 0

    def at(self, rows: np.ndarray) -> Surface:
        """Some chunks."""
        return replace(self, **{field.name: getattr(self, field.name)[rows] for field in fields(self)})


def surface(
    point: np.ndarray,
    direction: np.ndarray,
    normal_error: float,
    size: np.ndarray,
    sizes: np.ndarray,
    unit: np.ndarray,
) -> Surface:
    """Chunks of points (c, CHUNK, 3) float64 with unit normals (c, CHUNK, 3) that may be off by `normal_error` degrees
    on average, whatever they are a piece of; and with codes of sizes (c, CHUNK), of so many values (c,), and what
    origins are multiples of (c,)."""
    turn, grid = _turns(point), _grids(direction, normal_error)
    normal, unfolded = _coded(direction, grid)
    wide = (grid < WHOLE) & ((np.ptp(unfolded, axis=1) > WIDEST) | (np.abs(unfolded).max(axis=1) > WIDEST)).any(axis=1)
    grid[wide] = WHOLE
    normal[wide], unfolded[wide] = _coded(direction[wide], grid[wide])
    middle, along = _about_middle(point, axes_of(turn))
    scale = _scale(along)
    a, b = along[..., 0] / scale, along[..., 1] / scale
    ones = np.ones_like(a)
    quadric = _closest(np.stack([a * a, a * b, b * b, ones], axis=2), along[..., 2])[:, :3] / scale**2
    level = np.stack([a, b, ones], axis=2)
    first, second = (unfolded[..., k].astype(np.float64) for k in (0, 1))
    of_first = _closest(level, first)
    left = (first - np.einsum("cmp,cp->cm", level, of_first)) / WIDEST
    of_second = _closest(np.concatenate([level, left[..., None]], axis=2), second)
    plane, lean = np.stack([of_first[:, :2], of_second[:, :2]], axis=1), of_second[:, 3] / WIDEST
    a, b = along[..., 0], along[..., 1]
    over = along[..., 2] - (quadric[:, :1] * a * a + quadric[:, 1:2] * a * b + quadric[:, 2:] * b * b)
    extent = np.stack([np.ptp(a, axis=1), np.ptp(b, axis=1), np.ptp(over, axis=1)], axis=1)
    smallest = np.maximum(2.0**-22 * np.abs(point).max(axis=(1, 2)), SMALLEST_STEP)
    slope = plane / scale[..., None]
    folded = grid, normal, unfolded
    return Surface(point, *folded, turn, middle, along, quadric, slope, lean, extent, smallest, size, sizes, unit)


def _about_middle(point: np.ndarray, axes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The middles (c, 3) of chunks' extents along the first two axes (c, 3, 3), and points (c, CHUNK, 3) from there,
    along all."""
    mean = point.mean(axis=1)
    along = np.einsum("cij,ckj->cik", point - mean[:, None], axes)
    off = (along.min(axis=1) + along.max(axis=1)) / 2
    off[:, 2] = 0
    return mean + np.einsum("ci,cij->cj", off, axes), along - off[:, None]


def _scale(along: np.ndarray) -> np.ndarray:
    """The longest coordinate along the first two axes, (c, 1), positive."""
    return np.maximum(np.abs(along[..., :2]).max(axis=(1, 2)), SMALLEST_STEP)[:, None]


def _turns(point: np.ndarray) -> np.ndarray:
    """Quaternions (c, 3) int8 of frames whose third axis is across the quadric in their middle, with the smallest area
    about it."""
    off = point - point.mean(axis=1, keepdims=True)
    _, vectors = np.linalg.eigh(np.einsum("cij,cik->cjk", off, off))
    u = _least_area(off, vectors[:, :, 2], vectors[:, :, 1])
    axes = np.stack([u, np.cross(vectors[:, :, 0], u), vectors[:, :, 0]], axis=1)
    _, along = _about_middle(point, axes)
    scale = _scale(along)
    a, b = along[..., 0] / scale, along[..., 1] / scale
    tilt = _closest(np.stack([a, b, a * a, a * b, b * b, np.ones_like(a)], axis=2), along[..., 2])[:, :2] / scale
    steep = np.hypot(*tilt.T)
    tilt *= np.where(steep > STEEPEST, 0, 1)[:, None]
    across = axes[:, 2] - tilt[:, :1] * axes[:, 0] - tilt[:, 1:] * axes[:, 1]
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    u = axes[:, 0] - (axes[:, 0] * across).sum(axis=1, keepdims=True) * across
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    return quaternions_of(_least_area(off, u, np.cross(across, u)), across)


def _least_area(off: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """The direction (c, 3) in the planes of the axes `u` and `v` (c, 3), along which chunks have the smallest area."""
    x, y = np.einsum("cij,cj->ci", off, u), np.einsum("cij,cj->ci", off, v)
    best, area = np.zeros(len(off)), np.full(len(off), np.inf)
    for angle in ANGLES:
        cosine, sine = np.cos(angle), np.sin(angle)
        found = np.ptp(cosine * x + sine * y, axis=1) * np.ptp(cosine * y - sine * x, axis=1)
        best, area = np.where(found < area, angle, best), np.minimum(found, area)
    return np.cos(best)[:, None] * u + np.sin(best)[:, None] * v


def _grids(direction: np.ndarray, error: float) -> np.ndarray:
    """The map (c,) uint8 on which the normals of each chunk are `error` degrees off on average.

    Codes of s steps lie on a face of the octahedron in a hexagonal grid sqrt(2) apart, of whose cells a point is 0.351
    spacings from the middle on average. With m = |x| + |y| + |z| of a unit normal the face lies s / m from the centre,
    and is seen along one of its axes by m / sqrt(3): 0.351 sqrt(2) (m / s) (1 + m / sqrt(3)) / 2 radians.
    """
    m = np.abs(direction).sum(axis=2)
    steps = (0.351 * np.sqrt(0.5) * m * (1 + m / np.sqrt(3))).mean(axis=1) / np.radians(error)
    return np.floor((normal_steps(np.zeros(1)) - steps) / 8 + 0.5).clip(0, NORMAL_GRIDS - 1).astype(np.uint8)


def _coded(direction: np.ndarray, grid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Octahedral codes (c, CHUNK, 2) int64, and these unfolded."""
    shape, steps = direction.shape[:2], normal_steps(grid)
    code = encode_normals(direction.reshape(-1, 3), np.repeat(steps, shape[1]))
    normal = code.reshape(*shape, 2).astype(np.int64)
    return normal, _unfolded(normal, steps)


def _points(code: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """On the octahedron (..., 3), where two codes on an edge of the map may be one."""
    each = np.broadcast_to(steps, code.shape[:-1]).ravel()
    return octahedron_of(code.reshape(-1, 2), each).reshape(*code.shape[:-1], 3)


def _closest(design: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """What (c, p) of designs (c, m, p) leaves residuals of (c, m) that are nearest together, their smallest and largest;
    a little towards 0, so that it is there for any."""
    level = 1e-8 * np.eye(design.shape[2])
    weight = np.full(wanted.shape, 1 / wanted.shape[1])
    best, spread = np.zeros((len(design), design.shape[2])), np.full(len(design), np.inf)
    for _ in range(ROUNDS + 1):
        weighed = (design * weight[..., None]).transpose(0, 2, 1)
        found = np.linalg.solve(weighed @ design + level, weighed @ wanted[..., None])[..., 0]
        left = wanted - np.einsum("cmp,cp->cm", design, found)
        apart = np.ptp(left, axis=1)
        better = apart < spread
        best[better], spread[better] = found[better], apart[better]
        weight = weight * (np.abs(left) + 1e-9 * np.maximum(apart, SMALLEST_STEP)[:, None])
        weight = np.maximum(weight / weight.sum(axis=1, keepdims=True), LEAST_WEIGHT)
    return best


def _unfolded(normal: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Octahedral codes (c, CHUNK, 2) as they lie next to that of the chunk's mean normal, beyond the map's edges where
    that is nearer."""
    point, end = _points(normal, steps[:, None]), 2 * steps[:, None]
    mean = decode_normals(point.reshape(-1, 3)).reshape(point.shape).sum(axis=1)
    mean[np.linalg.norm(mean, axis=1) < 1e-6] = (0, 0, 1)
    middle = encode_normals(mean / np.linalg.norm(mean, axis=1, keepdims=True), steps).astype(np.int64)[:, None]
    best, off = normal, np.abs(normal - middle).sum(axis=2)
    a, b = normal[..., 0], normal[..., 1]
    for s in (-end, end):
        for other in ((s - a, -b), (-a, s - b), (s + a, end + b), (s + a, b - end)):
            place = np.stack(other, axis=2)
            distance = np.abs(place - middle).sum(axis=2)
            nearer = (
                (np.abs(place).max(axis=2) <= end)
                & (distance < off)
                & (_points(wrapped(place, steps[:, None]), steps[:, None]) == point).all(axis=2)
            )
            best, off = np.where(nearer[..., None], place, best), np.where(nearer, distance, off)
    return best
