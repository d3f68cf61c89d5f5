"""Smooth closed surfaces sampled as scanners and meshes do it, for `benchmarks/runs.py`: nobody tuned anything on them.

`torus` and `bust` (a head on shoulders: a smooth union of balls and a neck) are implicit surfaces. They are sampled
`even`, by random points pushed apart until they are spread like a scan that was resampled; `grid`, by depth pictures of
six directions with noise along the view, each point kept where no picture before it has one as near; and `mesh`, the
vertices of marching cubes.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial import cKDTree

Field = Callable[[np.ndarray], np.ndarray]  # (n, 3) -> (n,), above 0 inside, about the distance near the surface

RADIUS, TUBE = 0.7, 0.28
N_POINTS = 100_000
NOISE = 0.1  # of the spacing
ROUNDS = 8


def torus(p: np.ndarray) -> np.ndarray:
    ring = np.hypot(p[:, 0], p[:, 1]) - RADIUS
    return TUBE - np.hypot(ring, p[:, 2])


def bust(p: np.ndarray) -> np.ndarray:
    balls = [((0, 0, 0.45), 0.38), ((0, -0.28, 0.42), 0.14), ((0, -0.40, 0.40), 0.06), ((0.17, -0.25, 0.55), 0.07), ((-0.17, -0.25, 0.55), 0.07),
             ((0.38, 0, 0.45), 0.10), ((-0.38, 0, 0.45), 0.10), ((0, 0, 0.05), 0.2), ((0.3, 0, -0.35), 0.28), ((-0.3, 0, -0.35), 0.28), ((0, 0, -0.4), 0.35)]  # fmt: skip
    sharp = 18.0
    far = np.stack([r - np.linalg.norm(p - np.array(c), axis=1) for c, r in balls])
    return np.log(np.exp(sharp * far).sum(axis=0)) / sharp


SHAPES: dict[str, Field] = {"torus": torus, "bust": bust}


def made(shape: str, how: str, n: int = N_POINTS, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Points and unit normals outwards, about `n` of each."""
    field, rng = SHAPES[shape], np.random.default_rng(seed)
    points = {"even": _even, "grid": _grid, "mesh": _mesh}[how](field, n, rng)
    return points, -_gradient(field, points)


def _gradient(field: Field, p: np.ndarray, step: float = 1e-5) -> np.ndarray:
    steps = step * np.eye(3)
    g = np.stack([field(p + s) - field(p - s) for s in steps], axis=1) / (2 * step)
    return g / np.linalg.norm(g, axis=1, keepdims=True)


def _onto(field: Field, p: np.ndarray) -> np.ndarray:
    for _ in range(3):
        p = p - field(p)[:, None] * _gradient(field, p)
    return p


def _even(field: Field, n: int, rng: np.random.Generator) -> np.ndarray:
    p = _onto(field, _mesh(field, 2 * n, rng))
    p = p[rng.choice(len(p), min(n, len(p)), replace=False)]
    for _ in range(ROUNDS):
        far, near = cKDTree(p).query(p, 7)
        away = p[:, None] - p[near[:, 1:]]
        weight = np.clip(1.6 * np.median(far[:, 1:]) / far[:, 1:] - 1, 0, 4)[..., None]
        p = _onto(field, p + 0.15 * (weight * away).sum(axis=1))
    return p


def _grid(field: Field, n: int, rng: np.random.Generator) -> np.ndarray:
    side = int(np.sqrt(n / 3.2))
    spacing = 2.2 / side
    a, b = (x.ravel() for x in np.meshgrid(*2 * [(np.arange(side) + 0.5) / side * 2.2 - 1.1]))
    kept = np.zeros((0, 3))
    for axis in range(3):
        for sign in (1.0, -1.0):
            depth, found = np.full(len(a), 1.2), np.zeros(len(a), bool)
            for _ in range(120):  # sphere tracing, shy of the surface
                p = np.roll(np.column_stack([sign * depth, a, b]), axis, axis=1)
                inside = field(p)
                found |= inside > -1e-6
                depth = np.where(found | (depth < -1.2), depth, depth + np.minimum(0.7 * inside, -1e-4))
            depth = depth[found] + NOISE * spacing * rng.normal(size=found.sum())
            p = np.roll(np.column_stack([sign * depth, a[found], b[found]]), axis, axis=1)
            kept = p if not len(kept) else np.concatenate([kept, p[cKDTree(kept).query(p)[0] > 0.8 * spacing]])
    return kept


def _mesh(field: Field, n: int, rng: np.random.Generator) -> np.ndarray:
    from skimage.measure import marching_cubes

    side = int(np.sqrt(n / 2.2))
    axis = np.linspace(-1.1, 1.1, side)
    values = field(np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)).reshape(3 * (side,))
    corners, *_ = marching_cubes(values.astype(np.float32), 0.0)
    return corners.astype(np.float64) * (axis[1] - axis[0]) - 1.1
