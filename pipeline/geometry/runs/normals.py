"""Normals along a run: 16 bits at its start, then 5 bits a cell that name a step on the octahedron.

DuoDecim (2006), section 2.5.2, steps in spherical coordinates, which crowd at the poles. Here normals are whole numbers on the
octahedral map (geometry/normals.py) and steps are added to them, over its edges too: beyond a = 127 the map goes on at
(254 - a, -b). So decoding is in whole numbers, and the same on every machine. Each step is chosen against what the decoder has.
"""

from __future__ import annotations

import math

import numpy as np

from pipeline.execution.compiled import kernel, part
from pipeline.geometry.normals import decode_normals

N_STEPS = 32
STEPS = 127
SAMPLE = 1 << 16  # cells that the codebook is learned from
ROUNDS = 12


@part()
def wrapped(a, b):
    """The place on the map of one that lies beyond its edges by less than its width."""
    if a > 127 or a < -127:
        a, b = (254 - a if a > 0 else -254 - a), -b
    if b > 127 or b < -127:
        b, a = (254 - b if b > 0 else -254 - b), -a
    return a, b


def _unit_normals() -> np.ndarray:
    """The unit normal (255, 255, 3) float32 of each place on the map, (0, 0) in the middle."""
    a, b = np.meshgrid(np.arange(-STEPS, STEPS + 1), np.arange(-STEPS, STEPS + 1), indexing="ij")
    return (
        decode_normals(np.stack([a.ravel(), b.ravel()], axis=1).astype(np.int8)).reshape(*a.shape, 3).astype(np.float32)
    )


UNIT = _unit_normals()


@kernel()
def encode_steps(target, first, start, codebook, unit, step, place):
    """Choose the step to each cell of each run but its first, whose place is given: that nearest in angle to `target` (m, 3), unit.

    `first` (n_runs, 2) int8, `unit` is UNIT; writes `step` (m,) uint8, 0 at starts, and `place` (m, 2) int8, what is decoded."""
    for r in range(len(start) - 1):
        a, b = int(first[r, 0]), int(first[r, 1])
        place[start[r], 0], place[start[r], 1], step[start[r]] = a, b, 0
        for at in range(start[r] + 1, start[r + 1]):
            best, most, best_a, best_b = 0, -2.0, a, b
            for s in range(len(codebook)):
                ta, tb = wrapped(a + codebook[s, 0], b + codebook[s, 1])
                x, y, z = unit[ta + STEPS, tb + STEPS]
                cosine = x * target[at, 0] + y * target[at, 1] + z * target[at, 2]
                if cosine > most:
                    best, most, best_a, best_b = s, cosine, ta, tb
            a, b = best_a, best_b
            step[at], place[at, 0], place[at, 1] = best, a, b


@kernel()
def decode_steps(first, start, codebook, step, place):
    """The way back: `place` (m, 2) int8 of all cells."""
    for r in range(len(start) - 1):
        a, b = int(first[r, 0]), int(first[r, 1])
        place[start[r], 0], place[start[r], 1] = a, b
        for at in range(start[r] + 1, start[r + 1]):
            a, b = wrapped(a + codebook[step[at], 0], b + codebook[step[at], 1])
            place[at, 0], place[at, 1] = a, b


@kernel()
def _wanted(place, goal, start, wanted):
    """The shortest step from each decoded place to the next cell's goal, over edges too; (m, 2), 0 at starts."""
    for r in range(len(start) - 1):
        wanted[start[r]] = 0
        for at in range(start[r] + 1, start[r + 1]):
            a, b = int(place[at - 1, 0]), int(place[at - 1, 1])
            ga, gb = int(goal[at, 0]), int(goal[at, 1])
            da, db = ga - a, gb - b
            for side in range(4):
                if side == 0:
                    ta, tb = 254 - ga, -gb
                elif side == 1:
                    ta, tb = -254 - ga, -gb
                elif side == 2:
                    ta, tb = -ga, 254 - gb
                else:
                    ta, tb = -ga, -254 - gb
                if (ta - a) ** 2 + (tb - b) ** 2 < da * da + db * db:
                    da, db = ta - a, tb - b
            wanted[at, 0], wanted[at, 1] = da, db


def learn_steps(target: np.ndarray, goal: np.ndarray, start: np.ndarray) -> np.ndarray:
    """The codebook (N_STEPS, 2) int8 for runs of normals: `target` (m, 3) unit and their places `goal` (m, 2) int8.

    Steps are learned where lengths are companded, asinh(|d| / s) with s twice the median: a mean of squares would spend half of them on edges.
    They are means of what cells want of the step that they took, as long as that brings the mean angle down.

    Guarantees: step 0 is (0, 0); deterministic.
    """
    target, goal, start = _evenly(target, goal, start)
    m, first = start[-1], goal[start[:-1]]
    wanted, step, place = np.zeros((m, 2)), np.zeros(m, np.uint8), np.zeros((m, 2), np.int8)
    _wanted(goal, goal, start, wanted)
    inner = np.ones(m, bool)
    inner[start[:-1]] = False
    if not inner.any():
        return _rings(1.0, 1.0)
    length = np.linalg.norm(wanted[inner], axis=1)
    middle = max(1.0, float(np.median(length)))
    scale = 2 * middle  # of 0.5, 1 and 2 the best on volume_iguana_ct: 3.76 degrees against 3.99 and 3.84
    book = best = _rings(middle, max(8.0, float(np.quantile(length, 0.995))))
    least = np.inf
    for _ in range(ROUNDS):
        encode_steps(target, first, start, book, UNIT, step, place)
        off = _degrees(place, target)[inner].mean()
        if off < least:
            best, least = book, off
        _wanted(place, goal, start, wanted)
        book = _means(companded(wanted[inner], scale), step[inner], companded(book.astype(np.float64), scale), scale)
    return best


def _evenly(target: np.ndarray, goal: np.ndarray, start: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Every so many-th run, of SAMPLE cells together."""
    chosen = np.arange(0, len(start) - 1, max(1, int(start[-1]) // SAMPLE))
    length = np.diff(start)[chosen]
    begin = np.concatenate([[0], np.cumsum(length)])
    rows = np.repeat(start[chosen] - begin[:-1], length) + np.arange(begin[-1])
    return target[rows], goal[rows], begin


def companded(d: np.ndarray, scale: float) -> np.ndarray:
    """Vectors (n, d) with lengths l drawn in to asinh(l / scale): fine steps near 0, coarse ones far out."""
    length = np.linalg.norm(d, axis=-1, keepdims=True)
    return d * np.arcsinh(length / scale) / np.maximum(length, 1e-12)


def _expanded(u: np.ndarray, scale: float) -> np.ndarray:
    length = np.linalg.norm(u, axis=-1, keepdims=True)
    return u * (scale * np.sinh(length)) / np.maximum(length, 1e-12)


def _means(wanted: np.ndarray, step: np.ndarray, book: np.ndarray, scale: float) -> np.ndarray:
    count = np.bincount(step, minlength=N_STEPS)
    means = (
        np.stack([np.bincount(step, wanted[:, a], N_STEPS) for a in range(2)], axis=1) / np.maximum(count, 1)[:, None]
    )
    means = np.where((count > 0)[:, None], means, book)
    means[0] = 0
    return np.clip(np.rint(_expanded(means, scale)), -STEPS, STEPS).astype(np.int8)


def _rings(scale: float, widest: float) -> np.ndarray:
    """Rings of 1, 6, 10 and 15 steps."""
    rings = [np.zeros((1, 2))]
    for n, radius in ((6, scale), (10, math.sqrt(scale * widest)), (15, widest)):
        angle = 2 * np.pi * (np.arange(n) + 0.5 * (n % 4)) / n
        rings.append(radius * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    return np.clip(np.rint(np.concatenate(rings)), -STEPS, STEPS).astype(np.int8)


def _degrees(place: np.ndarray, target: np.ndarray) -> np.ndarray:
    return np.degrees(np.arccos(np.clip((decode_normals(place) * target).sum(axis=1), -1, 1)))
