"""Colours of Gaussians that make their pictures most like given ones.

Programs for 3D Gaussian splatting lay Gaussians over each other, front to back: the colour of a pixel is sum(w_i c_i), w_i = alpha_i * prod(1 - alpha_j) over
those before i. So once places, sizes and opacity are known a picture is linear in the colours c: those that minimise

    sum over pictures |A c - b|^2 + KEPT |c - c0|^2

are found by a few steps of conjugate gradients from c0 on, what is seen in no picture keeps its own. A is never stored: a product with it, or its transpose,
is a drawing.

References: Kerbl et al. 2023, section 6 and its program (0.3 px^2 of low-pass, three sigmas, alpha below 1/255 left out); Hestenes and Stiefel 1952.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from scipy.spatial.transform import Rotation

from pipeline.exports.gaussians import Gaussians
from storage.packed.schema import Camera

LOW_PASS_PX2, LEAST_ALPHA, LEAST_LIGHT, REACH_IN_SIGMAS, NEAREST = 0.3, 1 / 255, 1e-3, 3.0, 0.01
STEPS = 6
KEPT = 0.01  # in pixels' worth: what a Gaussian's own colour counts for


@dataclass(frozen=True)
class Footprints:
    """Gaussians that a view sees, front to back; rows correspond."""

    index: np.ndarray  # (m,) int64: which one
    middle: np.ndarray  # (m, 2) float32 px
    conic: np.ndarray  # (m, 3) float32: half the inverse covariance: xx, xy, yy, in 1/px^2
    box: np.ndarray  # (m, 4) int32: first column, last and one, first row, last and one
    opacity: float


@dataclass(frozen=True)
class Target:
    """What a view is to look like."""

    view: Camera
    color: np.ndarray  # (h, w, 3) float32 sRGB in [0, 1]
    counts: np.ndarray  # (h, w) bool: pixels that say something


def footprints(gaussians: Gaussians, view: Camera) -> Footprints:
    """Where Gaussians lie in a picture, those outside left out, nearest first."""
    rotation = np.array(view.rotation)
    seen = (gaussians.position + np.subtract(gaussians.origin, view.centre)) @ rotation.T
    order = np.argsort(seen[:, 2], kind="stable")
    order = order[seen[order, 2] > NEAREST]
    x, y, z = seen[order].T
    at = np.column_stack([view.fx_px * x / z + view.cx_px, view.fy_px * y / z + view.cy_px])
    spare = np.array([view.width_px, view.height_px])
    near = ((at > -spare) & (at < 2 * spare)).all(axis=1)
    order, at, x, y, z = order[near], at[near], x[near], y[near], z[near]
    axes = rotation @ Rotation.from_quat(gaussians.rotation[order]).as_matrix() * gaussians.sigma[order, None]
    flat = np.empty((len(order), 2, 3))
    flat[:, 0] = (axes[:, 0] - axes[:, 2] * (x / z)[:, None]) * (view.fx_px / z)[:, None]
    flat[:, 1] = (axes[:, 1] - axes[:, 2] * (y / z)[:, None]) * (view.fy_px / z)[:, None]
    a, c = ((flat[:, k] ** 2).sum(axis=1) + LOW_PASS_PX2 for k in (0, 1))
    b = (flat[:, 0] * flat[:, 1]).sum(axis=1)
    reach = REACH_IN_SIGMAS * np.sqrt(np.column_stack([a, c]))
    size = np.array([view.width_px, view.height_px])
    low = np.clip(np.floor(at - reach), 0, size).astype(np.int32)
    high = np.clip(np.floor(at + reach) + 1, 0, size).astype(np.int32)
    inside = (low < high).all(axis=1)
    conic = 0.5 * np.column_stack([c, -b, a]) / (a * c - b * b)[:, None]
    box = np.column_stack([low[:, 0], high[:, 0], low[:, 1], high[:, 1]])
    return Footprints(
        order[inside],
        at[inside].astype(np.float32),
        conic[inside].astype(np.float32),
        box[inside],
        gaussians.opacity,
    )


def drawn(prints: Footprints, color: np.ndarray, view: Camera) -> tuple[np.ndarray, np.ndarray]:
    """(h, w, 3) float32 over black, of colours (n, 3), and how much of each pixel is covered (h, w)."""
    light = np.zeros((view.height_px, view.width_px, 3), np.float32)
    left = np.ones((view.height_px, view.width_px), np.float32)
    _lay(light, left, prints.middle, prints.conic, prints.box, color[prints.index].astype(np.float32), prints.opacity)
    return light, 1 - left


def fitted(gaussians: Gaussians, targets: Sequence[Target], steps: int = STEPS) -> Gaussians:
    """The same Gaussians with colours fitted to `targets`, in [0, 1].

    Guarantees: the same numbers for the same input; what no target sees keeps its colour.
    """
    start = gaussians.color.astype(np.float64)
    seen = [footprints(gaussians, target.view) for target in targets]

    def forward(color: np.ndarray) -> list[np.ndarray]:
        pictures = [drawn(prints, color, target.view)[0] for prints, target in zip(seen, targets)]
        return [picture * target.counts[..., None] for picture, target in zip(pictures, targets)]

    def backward(pictures: Sequence[np.ndarray]) -> np.ndarray:
        total = np.zeros_like(start)
        for prints, picture in zip(seen, pictures):
            found, left = np.zeros((len(prints.index), 3)), np.ones(picture.shape[:2], np.float32)
            _gather(found, left, prints.middle, prints.conic, prints.box, picture, prints.opacity)
            total[prints.index] += found
        return total

    off = [np.where(t.counts[..., None], t.color - p, 0) for t, p in zip(targets, forward(start))]
    change = np.zeros_like(start)
    residual = backward(off)
    direction, power = residual, (residual**2).sum()
    for _ in range(steps):
        if not power:
            break
        pictures = forward(direction)
        energy = sum(float((picture.astype(np.float64) ** 2).sum()) for picture in pictures)
        energy += KEPT * float((direction**2).sum())
        length = power / energy
        change += length * direction
        off = [o - length * picture for o, picture in zip(off, pictures)]
        residual = backward(off) - KEPT * change
        before, power = power, (residual**2).sum()
        direction = residual + power / before * direction
    return replace(gaussians, color=(start + change).clip(0, 1))


@njit(cache=True)
def _lay(light, left, middle, conic, box, color, opacity):
    for i in range(len(middle)):
        x, y = middle[i, 0] - np.float32(0.5), middle[i, 1] - np.float32(0.5)
        xx, xy, yy = conic[i, 0], conic[i, 1], conic[i, 2]
        for row in range(box[i, 2], box[i, 3]):
            dy = row - y
            for column in range(box[i, 0], box[i, 1]):
                if left[row, column] < LEAST_LIGHT:
                    continue
                dx = column - x
                power = xx * dx * dx + np.float32(2) * xy * dx * dy + yy * dy * dy
                if power > np.float32(5.6):
                    continue
                alpha = np.float32(opacity) * np.exp(-power)
                if alpha >= LEAST_ALPHA:
                    weight = left[row, column] * alpha
                    for k in range(3):
                        light[row, column, k] += weight * color[i, k]
                    left[row, column] -= weight


@njit(cache=True)
def _gather(found, left, middle, conic, box, picture, opacity):
    for i in range(len(middle)):
        x, y = middle[i, 0] - np.float32(0.5), middle[i, 1] - np.float32(0.5)
        xx, xy, yy = conic[i, 0], conic[i, 1], conic[i, 2]
        for row in range(box[i, 2], box[i, 3]):
            dy = row - y
            for column in range(box[i, 0], box[i, 1]):
                if left[row, column] < LEAST_LIGHT:
                    continue
                dx = column - x
                power = xx * dx * dx + np.float32(2) * xy * dx * dy + yy * dy * dy
                if power > np.float32(5.6):
                    continue
                alpha = np.float32(opacity) * np.exp(-power)
                if alpha >= LEAST_ALPHA:
                    weight = left[row, column] * alpha
                    for k in range(3):
                        found[i, k] += weight * picture[row, column, k]
                    left[row, column] -= weight
