"""Chunks as pieces of surfaces: a frame of the smallest area, a quadric over it, and a plane that their normals
follow."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from pipeline.geometry.normals import STEPS, decode_normals, encode_normals, octahedron_of
from pipeline.geometry.quadrics.frames import wrapped
from pipeline.geometry.quadrics.quaternions import axes_of, quaternions_of

ANGLES = np.radians(np.arange(0, 90, 5.625))  # of U about N, of which that of the smallest area is taken
SMALLEST_STEP = 1e-30


@dataclass(frozen=True)
class Surface:
    """Chunks as they lie in their frames."""

    point: np.ndarray  # (c, CHUNK, 3)
    normal: np.ndarray  # (c, CHUNK, 2) int64 octahedral codes
    unfolded: (
        np.ndarray
    )  # (c, CHUNK, 2) the same next to the chunk's middle one, beyond the map's edges where that is nearer
    turn: np.ndarray  # (c, 3) int8
    along: np.ndarray  # (c, CHUNK, 3) from the chunk's mean, along its frame's axes
    quadric: np.ndarray  # (c, 3) of a^2, a b, b^2
    plane: np.ndarray  # (c, 2, 2) slopes of both octahedral coordinates along a and b
    extent: np.ndarray  # (c, 3) along the axes, the third over the quadric
    smallest: np.ndarray  # (c,) step below which float32 origins have no say

    def at(self, rows: np.ndarray) -> Surface:
        """Some chunks."""
        return replace(self, **{field.name: getattr(self, field.name)[rows] for field in fields(self)})


def surface(point: np.ndarray, normal: np.ndarray) -> Surface:
    """Chunks of points (c, CHUNK, 3) float64 with octahedral normals (c, CHUNK, 2) int64, whatever they are a piece
    of."""
    turn, unfolded = _turns(point), _unfolded(normal)
    along = np.einsum("cij,ckj->cik", point - point.mean(axis=1, keepdims=True), axes_of(turn))
    scale = np.maximum(np.abs(along[..., :2]).max(axis=(1, 2)), SMALLEST_STEP)[:, None]
    a, b = along[..., 0] / scale, along[..., 1] / scale
    ones = np.ones_like(a)
    quadric = _least_squares(np.stack([a * a, a * b, b * b, a, b, ones], axis=2), along[..., 2:])[:, :3, 0] / scale**2
    plane = _least_squares(np.stack([a, b, ones], axis=2), unfolded.astype(np.float64))[:, :2].transpose(0, 2, 1)
    a, b = along[..., 0], along[..., 1]
    over = along[..., 2] - (quadric[:, :1] * a * a + quadric[:, 1:2] * a * b + quadric[:, 2:] * b * b)
    extent = np.stack([np.ptp(a, axis=1), np.ptp(b, axis=1), np.ptp(over, axis=1)], axis=1)
    smallest = np.maximum(2.0**-22 * np.abs(point).max(axis=(1, 2)), SMALLEST_STEP)
    return Surface(point, normal, unfolded, turn, along, quadric, plane / scale[..., None], extent, smallest)


def _turns(point: np.ndarray) -> np.ndarray:
    """Quaternions (c, 3) int8 of frames whose third axis is across the chunk's plane, with the smallest area in it."""
    off = point - point.mean(axis=1, keepdims=True)
    _, vectors = np.linalg.eigh(np.einsum("cij,cik->cjk", off, off))
    u, v = vectors[:, :, 2], vectors[:, :, 1]
    across = np.cross(u, v)
    x, y = np.einsum("cij,cj->ci", off, u), np.einsum("cij,cj->ci", off, v)
    best, area = np.zeros(len(point)), np.full(len(point), np.inf)
    for angle in ANGLES:
        cosine, sine = np.cos(angle), np.sin(angle)
        found = np.ptp(cosine * x + sine * y, axis=1) * np.ptp(cosine * y - sine * x, axis=1)
        best, area = np.where(found < area, angle, best), np.minimum(found, area)
    cosine, sine = np.cos(best)[:, None], np.sin(best)[:, None]
    return quaternions_of(cosine * u + sine * v, across)


def _points(code: np.ndarray) -> np.ndarray:
    """On the octahedron (..., 3), where two codes on an edge of the map may be one."""
    return octahedron_of(code.reshape(-1, 2)).reshape(*code.shape[:-1], 3)


def _least_squares(design: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """(c, p, q) of designs (c, m, p) and (c, m, q), a little towards 0, so that it is there for any."""
    normal = np.einsum("cmp,cmq->cpq", design, design) + 1e-6 * np.eye(design.shape[2])
    return np.linalg.solve(normal, np.einsum("cmp,cmq->cpq", design, wanted))


def _unfolded(normal: np.ndarray) -> np.ndarray:
    """Octahedral codes (c, CHUNK, 2) as they lie next to that of the chunk's mean normal, beyond the map's edges where
    that is nearer."""
    mean = decode_normals(normal.reshape(-1, 2)).reshape(*normal.shape[:2], 3).sum(axis=1)
    mean[np.linalg.norm(mean, axis=1) < 1e-6] = (0, 0, 1)
    middle = encode_normals(mean / np.linalg.norm(mean, axis=1, keepdims=True)).astype(np.int64)[:, None]
    best, off, point = normal, np.abs(normal - middle).sum(axis=2), _points(normal)
    a, b, end = normal[..., 0], normal[..., 1], 2 * STEPS
    for s in (-end, end):
        for other in ((s - a, -b), (-a, s - b), (s + a, end + b), (s + a, b - end)):
            place = np.stack(other, axis=2)
            distance = np.abs(place - middle).sum(axis=2)
            nearer = (
                (np.abs(place).max(axis=2) <= end) & (distance < off) & (_points(wrapped(place)) == point).all(axis=2)
            )
            best, off = np.where(nearer[..., None], place, best), np.where(nearer, distance, off)
    return best
