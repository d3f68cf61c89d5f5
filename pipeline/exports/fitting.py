"""Colours of Gaussians that make their pictures most like given ones.

Programs for 3D Gaussian splatting lay Gaussians over each other, front to back: the colour of a pixel is sum(w_i c_i),
w_i = alpha_i * prod(1 - alpha_j) over those before i. So once places, sizes and opacity are known a picture is linear
in the colours c: those that minimise

    sum over pictures |A c - b|^2 + KEPT |c - c0|^2

are found by a few steps of conjugate gradients from c0 on, each colour scaled by the diagonal of A^T A + KEPT. What is
seen in no picture keeps its own. A is never stored: a product with it, or its transpose, is a drawing.

References: Kerbl et al. 2023, section 6 and its program (0.3 px^2 of low-pass, three sigmas, alpha below 1/255 left
out); Hestenes and Stiefel 1952.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from pipeline.execution.compiled import kernel, part
from pipeline.exports.gaussians import Gaussians
from storage.packed.schema import Camera

LOW_PASS_PX2, LEAST_ALPHA, LEAST_LIGHT, REACH_IN_SIGMAS, NEAREST = 0.3, 1 / 255, 1e-3, 3.0, 0.01
KEPT = 0.01  # in pixels' worth: what a Gaussian's own colour counts for


@dataclass(frozen=True)
class Footprints:
    """Gaussians that a view sees, front to back; rows correspond."""

    index: np.ndarray  # (m,) int32: which one
    middle: np.ndarray  # (m, 2) float32 px
    conic: np.ndarray  # (m, 3) float32: half the inverse covariance: xx, xy, yy, in 1/px^2
    box: np.ndarray  # (m, 4) int16: first column, last and one, first row, last and one
    opacity: np.float32


@dataclass(frozen=True)
class Target:
    """What a view is to look like."""

    view: Camera  # of at most 32767 px a side
    rgb: np.ndarray  # (h, w, 3) uint8 sRGB
    counts: np.ndarray  # (h, w) bool: pixels that say something


@dataclass(frozen=True)
class Fit:
    """Gaussians with fitted colours, and their mean squared error in the targets' pixels that count, of 255^2."""

    gaussians: Gaussians
    error_before: float
    error: float


def footprints(gaussians: Gaussians, view: Camera) -> Footprints:
    """Where Gaussians lie in a picture, those outside left out, nearest first."""
    rotation = np.array(view.rotation)
    seen = (gaussians.position + np.subtract(gaussians.origin, view.centre)) @ rotation.T
    order = np.argsort(seen[:, 2], kind="stable")
    order = order[seen[order, 2] > NEAREST]
    x, y, z = seen[order].T
    at = np.column_stack([view.fx_px * x / z + view.cx_px, view.fy_px * y / z + view.cy_px])
    size = np.array([view.width_px, view.height_px])
    near = ((at > -size) & (at < 2 * size)).all(axis=1)  # a Gaussian as wide as the picture is no splat of a surface
    order, at, x, y, z = order[near], at[near], x[near], y[near], z[near]
    axes = rotation @ Rotation.from_quat(gaussians.rotation[order]).as_matrix() * gaussians.sigma[order, None]
    across = (axes[:, 0] - axes[:, 2] * (x / z)[:, None]) * (view.fx_px / z)[:, None]  # px a sigma of each axis
    down = (axes[:, 1] - axes[:, 2] * (y / z)[:, None]) * (view.fy_px / z)[:, None]
    a, c = (across**2).sum(axis=1) + LOW_PASS_PX2, (down**2).sum(axis=1) + LOW_PASS_PX2
    b = (across * down).sum(axis=1)
    reach = REACH_IN_SIGMAS * np.sqrt(np.column_stack([a, c]))
    low = np.clip(np.floor(at - reach), 0, size).astype(np.int16)
    high = np.clip(np.floor(at + reach) + 1, 0, size).astype(np.int16)
    inside = (low < high).all(axis=1)
    conic = 0.5 * np.column_stack([c, -b, a]) / (a * c - b * b)[:, None]
    box = np.column_stack([low[:, 0], high[:, 0], low[:, 1], high[:, 1]])
    return Footprints(
        order[inside].astype(np.int32),
        at[inside].astype(np.float32),
        conic[inside].astype(np.float32),
        box[inside],
        np.float32(gaussians.opacity),
    )


def drawn(prints: Footprints, color: np.ndarray, view: Camera) -> np.ndarray:
    """(h, w, 3) float32 over black, of colours (n, 3)."""
    light = np.zeros((view.height_px, view.width_px, 3), np.float32)
    left = np.ones((view.height_px, view.width_px), np.float32)
    _lay(light, left, prints.middle, prints.conic, prints.box, color[prints.index].astype(np.float32), prints.opacity)
    return light


def fitted(gaussians: Gaussians, targets: Sequence[Target], steps: int) -> Fit:
    """The same Gaussians with colours fitted to `targets`, in [0, 1].

    Guarantees: the same numbers for the same input, however many threads draw; what no target sees keeps its colour.
    """
    start = gaussians.color.astype(np.float64)
    wanted = [target.rgb.astype(np.float32) / np.float32(255) for target in targets]
    with ThreadPoolExecutor(max(1, min(len(targets), os.cpu_count() or 1))) as pool:
        seen = list(pool.map(lambda target: footprints(gaussians, target.view), targets))

        def forward(color: np.ndarray) -> list[np.ndarray]:
            return list(pool.map(lambda prints, t: drawn(prints, color, t.view) * t.counts[..., None], seen, targets))

        def backward(pictures: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
            total = np.zeros((len(start), 4))
            for prints, found in zip(seen, pool.map(_gathered, seen, pictures)):
                total[prints.index] += found  # in the order of targets, whichever is done first
            return total[:, :3], total[:, 3:]

        off = [np.where(t.counts[..., None], w - p, 0) for t, w, p in zip(targets, wanted, forward(start))]
        error_before = _error(off, targets)
        residual, diagonal = backward(off)
        change, scale = np.zeros_like(start), 1 / (diagonal + KEPT)
        direction = scale * residual
        power = float((residual * direction).sum())
        for _ in range(steps):
            if not power:
                break
            pictures = forward(direction)
            energy = sum(float((picture.astype(np.float64) ** 2).sum()) for picture in pictures)
            length = power / (energy + KEPT * float((direction**2).sum()))
            change += length * direction
            off = [o - np.float32(length) * picture for o, picture in zip(off, pictures)]
            residual = backward(off)[0] - KEPT * change
            before, power = power, float((residual * scale * residual).sum())
            direction = scale * residual + power / before * direction
        color = (start + change).clip(0, 1)
        off = [np.where(t.counts[..., None], w - p, 0) for t, w, p in zip(targets, wanted, forward(color))]
    return Fit(replace(gaussians, color=color), error_before, _error(off, targets))


def _error(off: Sequence[np.ndarray], targets: Sequence[Target]) -> float:
    n = 3 * sum(int(target.counts.sum()) for target in targets)
    return 255**2 * sum(float((picture.astype(np.float64) ** 2).sum()) for picture in off) / max(n, 1)


def _gathered(prints: Footprints, picture: np.ndarray) -> np.ndarray:
    """(m, 4) float64: of each Gaussian the sum of w times the picture, and of w^2."""
    found = np.zeros((len(prints.index), 4))
    left = np.ones(picture.shape[:2], np.float32)
    _gather(found, left, prints.middle, prints.conic, prints.box, picture.astype(np.float32), prints.opacity)
    return found


@part()
def _alpha(conic, i, dx, dy, opacity):
    """Of a Gaussian at a place dx, dy px from its middle; 0 where programs leave it out."""
    power = conic[i, 0] * dx * dx + np.float32(2) * conic[i, 1] * dx * dy + conic[i, 2] * dy * dy
    if power > np.float32(5.6):  # exp(-5.6) < 1/255
        return np.float32(0)
    alpha = opacity * np.exp(-power)
    return alpha if alpha >= np.float32(LEAST_ALPHA) else np.float32(0)


@kernel()
def _lay(light, left, middle, conic, box, color, opacity):
    for i in range(len(middle)):
        x, y = middle[i, 0] - np.float32(0.5), middle[i, 1] - np.float32(0.5)
        for row in range(box[i, 2], box[i, 3]):
            for column in range(box[i, 0], box[i, 1]):
                if left[row, column] >= np.float32(LEAST_LIGHT):
                    weight = left[row, column] * _alpha(conic, i, np.float32(column) - x, np.float32(row) - y, opacity)
                    for k in range(3):
                        light[row, column, k] += weight * color[i, k]
                    left[row, column] -= weight


@kernel()
def _gather(found, left, middle, conic, box, picture, opacity):
    for i in range(len(middle)):
        x, y = middle[i, 0] - np.float32(0.5), middle[i, 1] - np.float32(0.5)
        for row in range(box[i, 2], box[i, 3]):
            for column in range(box[i, 0], box[i, 1]):
                if left[row, column] >= np.float32(LEAST_LIGHT):
                    weight = left[row, column] * _alpha(conic, i, np.float32(column) - x, np.float32(row) - y, opacity)
                    for k in range(3):
                        found[i, k] += weight * picture[row, column, k]
                    found[i, 3] += weight * weight
                    left[row, column] -= weight
