"""A scene of ropes, small balls and flat things with edges, as a laser scanner sees it, with the true answer.

Everything is cast exactly: what a ray hits first, how far away, and on what. So the same shapes give the scan (rays of
a scanner's grid, with noise along the ray) and the true silhouettes from anywhere.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from storage.packed.schema import Camera

NOTHING, FLAT, THICK, ROPE, BALL = range(5)
THIN = (ROPE, BALL)


@dataclass(frozen=True)
class Shapes:
    """Rectangles (corner and two edges), capsules (two ends and a radius; a ball's ends are equal), and their kinds."""

    corner: np.ndarray  # (r, 3)
    edges: np.ndarray  # (r, 2, 3)
    start: np.ndarray  # (c, 3)
    end: np.ndarray  # (c, 3)
    radius: np.ndarray  # (c,)
    kind: np.ndarray  # (c,) of the capsules


@dataclass(frozen=True)
class ThinScan:
    """Points with their kinds. Rows correspond."""

    position: np.ndarray  # (n, 3)
    kind: np.ndarray  # (n,)
    scanner: np.ndarray  # (n, 3): where each was seen from


def cast(shapes: Shapes, eye: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distances (n,), inf where nothing is hit, and kinds (n,) of the first hits of unit `direction` (n, 3)."""
    distance, kind = np.full(len(direction), np.inf), np.full(len(direction), NOTHING)
    for corner, (a, b) in zip(shapes.corner, shapes.edges, strict=True):
        _keep_nearer(distance, kind, _hit_rectangle(corner - eye, a, b, direction), FLAT)
    for start, end, radius, what in zip(shapes.start, shapes.end, shapes.radius, shapes.kind, strict=True):
        near = np.flatnonzero(_passes_near(start - eye, end - eye, radius, direction))
        hit = np.full(len(direction), np.inf)
        hit[near] = _hit_capsule(start - eye, end - eye, radius, direction[near])
        _keep_nearer(distance, kind, hit, what)
    return distance, kind


def scan(
    shapes: Shapes, eye, step: float, noise: float, rng: np.random.Generator, aim=(0, 0, 0.4), half_angle=0.7
) -> ThinScan:
    """What a scanner at `eye` sees: rays `step` radians apart, columns 1.5 times as far apart as rows, jittered by a
    tenth of a step; `noise` (a length) is the deviation along the ray."""
    forward = np.subtract(aim, eye) / np.linalg.norm(np.subtract(aim, eye))
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    across, along = np.arange(-half_angle, half_angle, 1.5 * step), np.arange(-half_angle, half_angle, step)
    a, b = (x.ravel() for x in np.meshgrid(across, along))
    a, b = (x + rng.normal(0, 0.1 * step, len(x)) for x in (a, b))
    direction = (
        (np.cos(a) * np.cos(b))[:, None] * forward + (np.sin(a) * np.cos(b))[:, None] * right + np.sin(b)[:, None] * up
    )
    distance, kind = cast(shapes, np.asarray(eye, float), direction)
    seen = np.isfinite(distance)
    far = distance[seen] + rng.normal(0, noise, seen.sum())
    return ThinScan(eye + direction[seen] * far[:, None], kind[seen], np.tile(np.asarray(eye, float), (seen.sum(), 1)))


def joined(scans: list[ThinScan]) -> ThinScan:
    return ThinScan(*(np.concatenate([getattr(s, name) for s in scans]) for name in ("position", "kind", "scanner")))


def silhouette(shapes: Shapes, view: Camera) -> np.ndarray:
    """(height, width) kinds of what the middle of each pixel shows."""
    column, row = np.meshgrid(np.arange(view.width_px) + 0.5, np.arange(view.height_px) + 0.5)
    ray = np.stack(
        [(column - view.cx_px) / view.fx_px, (row - view.cy_px) / view.fy_px, np.ones(column.shape)], axis=-1
    )
    ray = ray.reshape(-1, 3) @ np.array(view.rotation)
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    return cast(shapes, np.array(view.centre), ray)[1].reshape(column.shape)


def rope(start, end, sag: float, radius: float, n: int = 14) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Capsules along a hanging rope: starts, ends, radii."""
    share = np.linspace(0, 1, n + 1)[:, None]
    path = np.asarray(start) * (1 - share) + np.asarray(end) * share - np.array([0, 0, 4 * sag]) * share * (1 - share)
    return path[:-1], path[1:], np.full(n, radius)


def box(low, size) -> list[tuple[np.ndarray, np.ndarray]]:
    """The six sides of a box."""
    low, size = np.asarray(low, float), np.diag(np.asarray(size, float))
    sides = []
    for axis in range(3):
        a, b = size[(axis + 1) % 3], size[(axis + 2) % 3]
        sides += [(low, np.stack([a, b])), (low + size[axis], np.stack([a, b]))]
    return sides


def room(rng: np.random.Generator, rope_radius=(0.006, 0.010), ball_radius=(0.014, 0.020)) -> Shapes:
    """A floor, a leaning board, two boxes and steps; a thick pipe; seven ropes and twelve balls in the air."""
    sides = [
        (np.array([-1.2, -1.2, 0]), np.array([[2.4, 0, 0], [0, 2.4, 0]])),
        (np.array([-1.0, 0.9, 0.05]), np.array([[1.2, 0.1, 0], [0.0, 0.25, 0.9]])),
    ]
    sides += box([0.35, 0.2, 0.0], [0.4, 0.3, 0.35]) + box([-0.8, -0.3, 0.0], [0.25, 0.4, 0.2])
    for k in range(3):
        sides += box([0.3, -0.7 + 0.15 * k, 0], [0.6, 0.15, 0.08 * (k + 1)])
    thick = (np.array([[-0.3, 0.45, 0.15]]), np.array([[-0.3, 0.45, 0.95]]), np.array([0.11]))
    parts, kinds = [thick], [THICK]
    for _ in range(7):
        low, high = rng.uniform([-0.9, -0.6, 0.55], [-0.4, 0.6, 1.0]), rng.uniform([0.3, -0.6, 0.6], [0.9, 0.6, 1.0])
        parts.append(rope(low, high, rng.uniform(0.02, 0.12), rng.uniform(*rope_radius)))
        kinds += [ROPE] * len(parts[-1][0])
    middle = np.array([[x, y, 0.45] for x in (-0.6, -0.2, 0.2, 0.6) for y in (-0.8, -0.45, 0.1)])
    middle += rng.uniform(-0.05, 0.05, middle.shape)
    parts.append((middle, middle, rng.uniform(*ball_radius, len(middle))))
    kinds += [BALL] * len(middle)
    start, end, radius = (np.concatenate([part[i] for part in parts]) for i in range(3))
    corner, edges = (np.stack(x) for x in zip(*sides, strict=True))
    return Shapes(corner, edges, start, end, radius, np.array(kinds))


def _keep_nearer(distance: np.ndarray, kind: np.ndarray, hit: np.ndarray, what: int) -> None:
    nearer = hit < distance
    distance[nearer], kind[nearer] = hit[nearer], what


def _hit_rectangle(corner: np.ndarray, a: np.ndarray, b: np.ndarray, direction: np.ndarray) -> np.ndarray:
    normal = np.cross(a, b)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (corner @ normal) / (direction @ normal)
        at = direction * t[:, None] - corner
        dual = np.linalg.inv(np.stack([a, b, normal]).T)[:2]
        share = at @ dual.T
        inside = (t > 0) & ((share >= 0) & (share <= 1)).all(axis=1)
    return np.where(inside, t, np.inf)


def _passes_near(start: np.ndarray, end: np.ndarray, radius: float, direction: np.ndarray) -> np.ndarray:
    middle, reach = (start + end) / 2, np.linalg.norm(end - start) / 2 + radius
    along = direction @ middle
    return middle @ middle - np.sign(along) * along**2 <= reach**2


def _hit_capsule(start: np.ndarray, end: np.ndarray, radius: float, direction: np.ndarray) -> np.ndarray:
    """The nearest of the hits of two balls and the tube between them."""
    hit = np.minimum(_hit_ball(start, radius, direction), _hit_ball(end, radius, direction))
    axis = end - start
    length = np.linalg.norm(axis)
    if length == 0:
        return hit
    axis = axis / length
    d, s = direction - (direction @ axis)[:, None] * axis, start - (start @ axis) * axis
    t = _nearer_root((d * d).sum(axis=1), d @ s, s @ s - radius**2)
    with np.errstate(invalid="ignore"):
        at = t * (direction @ axis) - start @ axis
        return np.where((at >= 0) & (at <= length), np.minimum(hit, t), hit)


def _hit_ball(middle: np.ndarray, radius: float, direction: np.ndarray) -> np.ndarray:
    return _nearer_root(np.ones(len(direction)), direction @ middle, middle @ middle - radius**2)


def _nearer_root(a: np.ndarray, b: np.ndarray, c: float) -> np.ndarray:
    """The smaller root of a t^2 - 2 b t + c, inf where there is none ahead."""
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (b - np.sqrt(b * b - a * c)) / a
        return np.where(t > 0, t, np.inf)
