"""Normals along a run: 16 bits at its start, then 5 bits a cell that name a step on the octahedron.

DuoDecim (2006), section 2.5.2, steps in spherical coordinates, which crowd at the poles. Here normals are whole numbers on the
octahedral map (geometry/normals.py) and steps are added to them, over its edges too: beyond a = 127 the map goes on at
(254 - a, -b). So decoding is in whole numbers, and the same on every machine. Steps are chosen against what the decoder has, several ways
side by side (Anderson and Mohan, Sequential coding algorithms, 1984, the M-algorithm), so that one does not lead astray.
"""

from __future__ import annotations

import math

import numpy as np

from pipeline.execution.compiled import kernel, part
from pipeline.geometry.normals import decode_normals

N_STEPS = 32
STEPS = 127
SAMPLE = 1 << 16  # cells that the codebook is learned from
ROUNDS = 3  # of means; more changed no codebook of three scans
WIDEST = (
    0.98,
    0.995,
)  # shares of the wanted steps that are no longer than the first codebook's: bunny takes the second, other scans the first
NEAREST = 10  # steps that are tried of a cell whose normal lies no further than WINDOW from that before, along a and b
WINDOW = 47
WAYS = 4  # ways to a cell that are kept: 3.1 degrees off on volume_iguana_ct where the nearest step each time is 3.6, 8 ways 3.0


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


@part()
def _kept(front, origin, n, a, b, cost, before, step):
    """Put a way that ends in place (a, b) among the `n` cheapest of a cell, by cost; how many there are then. Of two to one place the cheaper stays."""
    for w in range(n):
        if front[w, 0] == a and front[w, 1] == b:
            if front[w, 2] <= cost:
                return n
            for above in range(w, n - 1):
                front[above], origin[above] = front[above + 1], origin[above + 1]
            n -= 1
            break
    n = min(n + 1, len(front))
    w = n - 1
    while w > 0 and front[w - 1, 2] > cost:
        front[w], origin[w] = front[w - 1], origin[w - 1]
        w -= 1
    front[w, 0], front[w, 1], front[w, 2] = a, b, cost
    origin[w, 0], origin[w, 1] = before, step
    return n


@kernel()
def _nearest_steps(codebook):
    """The NEAREST steps, nearest first, to each move of at most WINDOW along a and b, (2 WINDOW + 1, 2 WINDOW + 1, NEAREST) uint8."""
    side = 2 * WINDOW + 1
    found, far = np.empty((side, side, NEAREST), np.uint8), np.empty(len(codebook), np.int64)
    for i in range(side):
        for j in range(side):
            for s in range(len(codebook)):
                far[s] = (codebook[s, 0] - i + WINDOW) ** 2 + (codebook[s, 1] - j + WINDOW) ** 2
            for k in range(NEAREST):
                s = np.argmin(far)
                found[i, j, k], far[s] = s, 1 << 30
    return found


def encode_steps(target, goal, first, start, codebook, step, place, ways=WAYS):
    """Choose the steps to all cells of each run but its first, whose place is given: of the `ways` cheapest ways to each cell those that go on
    to the least sum of sin(angle / 2) to `target` (m, 3), unit, whose places are `goal` (m, 2) int8. With one way each step is the nearest.

    `first` (n_runs, 2) int8; writes `step` (m,) uint8, 0 at starts, and `place` (m, 2) int8, what is decoded."""
    _encode_steps(target, goal, first, start, codebook, _nearest_steps(codebook), UNIT, step, place, ways)


@kernel()
def _encode_steps(target, goal, first, start, codebook, nearest, unit, step, place, ways):
    longest = 1
    for r in range(len(start) - 1):
        longest = max(longest, start[r + 1] - start[r])
    fronts, origins = np.empty((longest, ways, 3)), np.empty((longest, ways, 2), np.int32)
    for r in range(len(start) - 1):
        begin, length = start[r], start[r + 1] - start[r]
        fronts[0, 0, 0], fronts[0, 0, 1], fronts[0, 0, 2] = first[r, 0], first[r, 1], 0.0
        n_before = 1
        for i in range(1, length):
            x, y, z = target[begin + i]
            n = 0
            for before in range(n_before):
                a, b, so_far = int(fronts[i - 1, before, 0]), int(fronts[i - 1, before, 1]), fronts[i - 1, before, 2]
                i_a, i_b = goal[begin + i, 0] - a + WINDOW, goal[begin + i, 1] - b + WINDOW
                is_near = 0 <= i_a <= 2 * WINDOW and 0 <= i_b <= 2 * WINDOW
                for tried in range(NEAREST if is_near else len(codebook)):
                    s = int(nearest[i_a, i_b, tried]) if is_near else tried
                    ta, tb = wrapped(a + codebook[s, 0], b + codebook[s, 1])
                    ux, uy, uz = unit[ta + STEPS, tb + STEPS]
                    off = max(0.0, 1.0 - (ux * x + uy * y + uz * z))
                    if n == ways:
                        room = fronts[i, n - 1, 2] - so_far
                        if room <= 0 or off >= room * room:
                            continue
                    n = _kept(fronts[i], origins[i], n, ta, tb, so_far + math.sqrt(off), before, s)
            n_before = n
        way = 0
        for i in range(length - 1, -1, -1):
            place[begin + i, 0], place[begin + i, 1] = int(fronts[i, way, 0]), int(fronts[i, way, 1])
            step[begin + i] = origins[i, way, 1] if i else 0
            way = origins[i, way, 0] if i else 0


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
        return _rings(1.0, 8.0)
    length = np.linalg.norm(wanted[inner], axis=1)
    middle = max(1.0, float(np.median(length)))
    scale = 2 * middle  # of 0.5, 1 and 2 the best on volume_iguana_ct: 3.76 degrees against 3.99 and 3.84
    best, least = None, np.inf
    for widest in WIDEST:
        book = _rings(middle / 2, max(8.0, float(np.quantile(length, widest))))
        for _ in range(ROUNDS):
            encode_steps(target, goal, first, start, book, step, place, 1)
            off = _degrees(place, target)[inner].mean()
            if off < least:
                best, least = book, off
            _wanted(place, goal, start, wanted)
            book = _means(
                companded(wanted[inner], scale), step[inner], companded(book.astype(np.float64), scale), scale
            )
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


def _rings(narrowest: float, widest: float) -> np.ndarray:
    """Rings of 1, 6, 8, 8 and 9 steps, each as many times wider than that before."""
    rings = [np.zeros((1, 2))]
    for i, n in enumerate((6, 8, 8, 9)):
        angle = 2 * np.pi * (np.arange(n) + 0.5 * (i % 2)) / n
        radius = narrowest * (widest / narrowest) ** (i / 3)
        rings.append(radius * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    return np.clip(np.rint(np.concatenate(rings)), -STEPS, STEPS).astype(np.int8)


def _degrees(place: np.ndarray, target: np.ndarray) -> np.ndarray:
    return np.degrees(np.arccos(np.clip((decode_normals(place) * target).sum(axis=1), -1, 1)))
