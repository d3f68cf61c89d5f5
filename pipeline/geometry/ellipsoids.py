"""Ellipsoids in 4 x 8 bits beside position and normal: the turn of the long axes about the normal, and three lengths.

The third axis is the splat's normal (normals.py, 16 bits), so a rotation takes 24 bits and an ellipsoid 32 more than a
disc. Lengths are steps of a logarithm of radii, the axes' turn is against the tangent frame of the decoded normal.
"""

from __future__ import annotations

import numpy as np

from pipeline.geometry.frame import Direction, tangent_frames

TURNS = 256  # of half a turn: an axis has no direction
STEPS_AN_OCTAVE = 32
LONGEST_STEP = 255
MEAN_HEIGHT = 2 / 3  # of half a ball over its disc
ONE_RADIUS = 191  # so from 2^-5.97 to 2^2 radii
LONGEST_RADII = 2.0 ** ((LONGEST_STEP - ONE_RADIUS) / STEPS_AN_OCTAVE)
SHORTEST_RADII = 2.0 ** (-ONE_RADIUS / STEPS_AN_OCTAVE)


def encode_ellipsoids(
    normal_code: np.ndarray, up: Direction, ahead: Direction, axes: np.ndarray, radius: float | np.ndarray
) -> np.ndarray:
    """Fields (n, 4) uint8: turn, then the steps of the three lengths. `axes` (n, 3, 3): rows along the normal's
    tangents, across them and along the normal, as long as the half axes. `radius` here and below: of each splat (n,),
    or of all.

    Guarantees: every value of every field decodes; the decoded first axis is within 0.36 degrees of the projection of
    the given one onto the decoded tangent plane; lengths between SHORTEST_RADII and LONGEST_RADII come back within
    1.1 %, others as the nearer bound.
    """
    u, v, _ = tangent_frames(normal_code, up, ahead)
    angle = np.arctan2((axes[:, 0] * v).sum(axis=1), (axes[:, 0] * u).sum(axis=1))
    turn = np.round(angle * TURNS / np.pi).astype(np.int64) % TURNS
    length = np.linalg.norm(axes, axis=2) / np.reshape(radius, (-1, 1))
    step = np.round(ONE_RADIUS + STEPS_AN_OCTAVE * np.log2(np.clip(length, SHORTEST_RADII, LONGEST_RADII)))
    return np.column_stack([turn, step]).astype(np.uint8)


def decode_ellipsoids(
    fields: np.ndarray, normal_code: np.ndarray, up: Direction, ahead: Direction, radius: float | np.ndarray
) -> np.ndarray:
    """Half axes as rows (n, 3, 3) float64: at right angles, right-handed, the third along the decoded normal."""
    u, v, normal = tangent_frames(normal_code, up, ahead)
    angle = fields[:, :1] * (np.pi / TURNS)
    first = np.cos(angle) * u + np.sin(angle) * v
    second = np.cos(angle) * v - np.sin(angle) * u
    return np.stack([first, second, normal], axis=1) * lengths_of(fields, radius)[..., None]


def squares_of(
    centre: np.ndarray,
    u: np.ndarray,
    v: np.ndarray,
    ellipsoid: np.ndarray,
    axes: np.ndarray,
    radius: float | np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Middles and tangents (n, 3), these in radii, of the squares that splats are textured on.

    `centre`, `u`, `v` are those of discs; `ellipsoid` (m,) which are ellipsoids, `axes` (m, 3, 3) their half axes.
    Their square spans the first two, as far towards the side that the normal looks to as the surface lies on average.
    """
    centre, u, v = centre.copy(), u.copy(), v.copy()
    centre[ellipsoid] += MEAN_HEIGHT * axes[:, 2]
    in_radii = axes[:, :2] / np.reshape(radius, (-1, 1, 1))
    u[ellipsoid], v[ellipsoid] = in_radii[:, 0], in_radii[:, 1]
    return centre, u, v


def lengths_of(fields: np.ndarray, radius: float | np.ndarray) -> np.ndarray:
    """The three half axes' lengths (n, 3) float64."""
    return np.reshape(radius, (-1, 1)) * 2.0 ** ((fields[:, 1:].astype(np.float64) - ONE_RADIUS) / STEPS_AN_OCTAVE)
