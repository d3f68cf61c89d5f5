"""The tangent frame of a splat, from its decoded normal and the two directions that the scan is aligned with.

Paper: HPG 2021, section 3.2: the choice is free, "but must be consistent between splat resampling and rendering",
for example from "its alignment with the global coordinate axes". Here the directions are the scan's own, so that a
scan that is turned takes its textures with it. Every branch is decided in whole numbers, so that the shader takes the
same one (renderer/shaders/splat_geometry.glsl).
"""

from __future__ import annotations

from collections.abc import Sequence
from math import gcd

import numpy as np

from pipeline.geometry.normals import octahedron_of
from storage.packed.schema import DEFAULT_AHEAD, DEFAULT_UP, LONGEST_DIRECTION, Camera

Direction = tuple[int, int, int]


def tangent_frames(
    normal_code: np.ndarray, up: Direction, ahead: Direction
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Tangent u, tangent v and normal of each splat, three (n, 3) float64, orthonormal and right-handed.

    `normal_code` (n, 2) int8; `up` and `ahead` as in the packed file's header. v points up on a wall; where the normal
    is within 26 degrees of `up` or its opposite (cosine above 0.9), v points ahead.
    """
    point = octahedron_of(normal_code).astype(np.int64)
    along_up = point @ np.array(up)
    near_pole = 100 * along_up**2 > 81 * (point**2).sum(axis=1) * np.dot(up, up)
    reference = np.where(near_pole[:, None], _unit(ahead), _unit(up))
    normal = point / np.linalg.norm(point, axis=1, keepdims=True)
    u = np.cross(reference, normal)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    return u, np.cross(normal, u), normal


def directions_of(cameras: Sequence[Camera]) -> tuple[Direction, Direction]:
    """The directions `up` and `ahead` of a scan with these cameras.

    Up is the line that the photographs' columns follow best, so that patches stand upright as in the photographs, and
    edges that run along their rows and columns stay so; ahead is the line at right angles to it that they look along.
    Both turn with the scan, to 1.2 degrees, which is what whole numbers of this length tell apart.
    """
    if not cameras:
        return DEFAULT_UP, DEFAULT_AHEAD
    rotation = np.array([camera.rotation for camera in cameras], np.float64)  # (n, 3, 3)
    up = whole_direction(_leading(-rotation[:, 1]))
    level = np.eye(3) - np.outer(_unit(up), _unit(up))
    return up, whole_direction(
        level @ _leading(rotation[:, 2] @ level)
    )  # which is not 0: up is no photograph's z alone


def whole_direction(direction: np.ndarray) -> Direction:
    """The whole numbers, LONGEST_DIRECTION long at most, that point most nearly along a vector (3,)."""
    unit = _unit(direction)
    points = np.rint(np.arange(1, LONGEST_DIRECTION + 1)[:, None] * unit)
    length = np.linalg.norm(points, axis=1)
    cosine = np.where((length > 0) & (length <= LONGEST_DIRECTION), points @ unit / np.maximum(length, 1), -1)
    found = points[np.argmax(np.round(cosine, 12))].astype(int)
    return tuple((found // gcd(*found.tolist())).tolist())


def _leading(vectors: np.ndarray) -> np.ndarray:
    """The line that vectors (n, 3) follow best, turned to where most of them point."""
    line = np.linalg.eigh(vectors.T @ vectors)[1][:, -1]
    along = vectors.sum(axis=0) @ line
    if abs(along) < 1e-9 * len(vectors):
        along = line[np.abs(line).argmax()]
    return line * np.sign(along)


def _unit(vector) -> np.ndarray:
    return np.asarray(vector, np.float64) / np.linalg.norm(vector)
