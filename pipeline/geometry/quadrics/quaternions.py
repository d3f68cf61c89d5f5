"""Rotations as quaternions of three signed bytes and a fourth entry that is the same for all."""

from __future__ import annotations

import numpy as np

from storage.packed.schema import TURN_W


def axes_of(turn: np.ndarray, w: float = TURN_W) -> np.ndarray:
    """U, V and N (c, 3, 3) float64 as rows, orthonormal, of quaternions x, y, z (c, 3) and `w`."""
    q = np.concatenate([turn.astype(np.float64), np.full((len(turn), 1), float(w))], axis=1)
    x, y, z, w = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
    return np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)], axis=1),
            np.stack([2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w)], axis=1),
            np.stack([2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)], axis=1),
        ],
        axis=1,
    )


def quaternions_of(u: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """The quaternions (c, 3) int8 of frames with the axes U or V along `u` and N along `normal`, (c, 3) each,
    orthonormal, either way round.

    Of the eight such frames one has N above the horizon and U within 45 degrees of the x axis turned by the shortest
    way of N; its rotation is at most 90 degrees of swing and 45 of twist, so x, y and z are at most sqrt(1 +
    tan(22.5)^2) = 1.083 of w.
    """
    normal = np.where(normal[:, 2:] < 0, -normal, normal)
    # The shortest rotation of z to N is 1 + N_z, N_x and N_y: (-N_y, N_x, 0, 1 + N_z).
    x, y, w = -normal[:, 1], normal[:, 0], 1 + normal[:, 2]
    first = np.stack([1 - normal[:, 0] ** 2 / w, -normal[:, 0] * normal[:, 1] / w, -normal[:, 0]], axis=1)
    second = np.stack([-normal[:, 0] * normal[:, 1] / w, 1 - normal[:, 1] ** 2 / w, -normal[:, 1]], axis=1)
    angle = np.arctan2((u * second).sum(axis=1), (u * first).sum(axis=1))
    angle -= np.pi / 2 * np.rint(angle / (np.pi / 2))
    twist = np.tan(angle / 2)
    # The product of swing (x, y, 0, w) and twist (0, 0, tan, 1), over its w.
    q = np.stack([(x + y * twist) / w, (y - x * twist) / w, twist], axis=1)
    return np.rint(TURN_W * q).clip(-127, 127).astype(np.int8)
