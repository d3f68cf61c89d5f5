"""How far around a splat a plane, up to one straight line, explains its neighbourhood: the arc that `decision.py` decides by.

A plane is tried with every line that leaves all that stands above the plane behind it. Of the members within a tolerance of
the plane, on the kept side and in a ring around the splat, the longest run of directions without a wide gap is the arc.
"""

from __future__ import annotations

import math

import numpy as np

from pipeline.effects.ellipsoids.hypotheses import HYPOTHESES, cross, three_members
from pipeline.execution.compiled import kernel

RING_RADII = 1.25  # members nearer than this say nothing of whether a disc of one radius is filled
WIDEST_GAP = math.radians(65)  # half a ring has 10 members at the median density: most gaps between them stay below
LINES = 16  # directions a line may have
_COS = np.array([math.cos(2 * math.pi * line / LINES) for line in range(LINES)])
_SIN = np.array([math.sin(2 * math.pi * line / LINES) for line in range(LINES)])
SECTORS = 64  # of a turn, a bit each: sixteen a quarter, equal in |y| / (|x| + |y|)
MOST_EMPTY = 12  # sectors in a gap of WIDEST_GAP, where they are narrowest: 2 tan 32.5 / (1 + tan 32.5) of a quarter
_ROUNDING = 1e-9  # radians: sums of the same gaps in other parts


def reach_arc(offset: np.ndarray, count: np.ndarray, tolerance: float, enough: float) -> np.ndarray:
    """Whether a plane explains an arc of `enough` radians or more, (n,) bool, of each neighbourhood: `offset` (n, k, 3), in
    radii, the splat itself (zeros) among the first `count` (n,).

    Directions are sorted once a plane: of a part of them no run is longer than of all, so lines are tried only where all of
    them reach far enough; and they are sorted only where the sectors that hold any can.
    """
    found = np.zeros(len(offset), bool)
    _reach_arc(offset, count, tolerance, enough, _sectors_on(enough) + MOST_EMPTY, found)
    return found


def _sectors_on(arc: float) -> int:
    """How many sectors an arc touches at least: a quarter turn SECTORS / 4, what is more fewest amid a quarter."""
    quarters, rest = divmod(arc, math.pi / 2)
    beside = math.tan(math.pi / 4 - rest / 2)
    return int(SECTORS / 4 * (quarters + 1 - 2 * beside / (1 + beside)))


@kernel()
def _reach_arc(offset, count, tolerance, enough, run, found):
    most = offset.shape[1]
    member, height, x, y = np.empty((3, most)), np.empty(most), np.empty(most), np.empty(most)
    ring, direction = np.empty(most, np.int64), np.empty(most)
    least = int(math.ceil(enough / WIDEST_GAP)) + 1
    for i in range(len(offset)):
        k = count[i]
        for axis in range(3):
            member[axis, :k] = offset[i, :k, axis]
        for h in range(HYPOTHESES if k >= least else 0):
            a, b, c = three_members(h, k)
            there = _project(member[0], member[1], member[2], k, a, b, c, tolerance, height, x, y)
            if not _may_reach(there, run):
                continue
            m = _ring(k, height, x, y, tolerance, ring, direction)
            if m < least:
                continue
            arc = _longest_run(direction[:m])
            if arc < enough - _ROUNDING:
                continue
            if _either_side(k, height, x, y, tolerance, ring[:m], direction[:m], arc, enough, least):
                found[i] = True
                break


@kernel()
def _project(xs, ys, zs, count, a, b, c, tolerance, height, x, y):
    """Members in the frame of the plane through members `a`, `b` and `c`, and a bit for each sector that holds one of its ring;
    none where those three are nearly on a line, or the plane misses the splat.

    Number by number: with arrays of three, these kernels took 6.3 s to compile; so, 1.9 s.
    """
    there = np.uint64(0)
    a0, a1, a2 = xs[a], ys[a], zs[a]
    p0, p1, p2 = xs[b] - a0, ys[b] - a1, zs[b] - a2
    q0, q1, q2 = xs[c] - a0, ys[c] - a1, zs[c] - a2
    n0, n1, n2 = cross(p0, p1, p2, q0, q1, q2)
    area, length = math.sqrt(n0 * n0 + n1 * n1 + n2 * n2), math.sqrt(p0 * p0 + p1 * p1 + p2 * p2)
    if area <= 0.2 * length * math.sqrt(q0 * q0 + q1 * q1 + q2 * q2):
        return there
    n0, n1, n2 = n0 / area, n1 / area, n2 / area
    if abs(a0 * n0 + a1 * n1 + a2 * n2) > tolerance:
        return there
    p0, p1, p2 = p0 / length, p1 / length, p2 / length
    q0, q1, q2 = cross(n0, n1, n2, p0, p1, p2)
    for j in range(count):
        h = (xs[j] - a0) * n0 + (ys[j] - a1) * n1 + (zs[j] - a2) * n2
        u, v = xs[j] * p0 + ys[j] * p1 + zs[j] * p2, xs[j] * q0 + ys[j] * q1 + zs[j] * q2
        turn = 1 + v / (abs(u) + abs(v) + 1e-300)  # grows with the angle from straight down, one a quarter turn
        turn = 4 - turn if u < 0 else turn
        inside = (abs(h) <= tolerance) & (u * u + v * v >= RING_RADII**2)
        there |= np.uint64(inside) << np.uint64(np.int32(turn * (SECTORS // 4)) & np.int32(SECTORS - 1))
        height[j], x[j], y[j] = h, u, v
    return there


@kernel()
def _may_reach(there, run):
    """Whether sectors follow each other, in a run of so many around the turn, each with a member or with at most MOST_EMPTY after
    one: where an arc reaches far enough, they do."""
    step = 1
    left = MOST_EMPTY
    while left > 0:
        step = min(step, left)
        there |= _turned(there, step)
        left -= step
        step *= 2
    length = 1
    while length < run and length < SECTORS:
        step = min(length, run - length)
        there &= _turned(there, step)
        length += step
    return there != 0


@kernel()
def _turned(there, step):
    return there << np.uint64(step) | there >> np.uint64(SECTORS - step)


@kernel()
def _ring(count, height, x, y, tolerance, ring, direction):
    """Members in the plane's ring by their direction: how many, their numbers and directions."""
    m = 0
    for j in range(count):
        if abs(height[j]) <= tolerance and x[j] * x[j] + y[j] * y[j] >= RING_RADII**2:
            value, k = math.atan2(y[j], x[j]), m
            while k > 0 and direction[k - 1] > value:
                direction[k], ring[k] = direction[k - 1], ring[k - 1]
                k -= 1
            direction[k], ring[k] = value, j
            m += 1
    return m


@kernel()
def _either_side(count, height, x, y, tolerance, ring, direction, arc, enough, least):
    """Whether the members kept by a line reach `enough`, with either face of the plane up; all, with an arc of `arc`, where
    nothing stands above."""
    kept = np.empty(len(ring))
    for up in (1.0, -1.0):
        above = 0
        for j in range(count):
            above += up * height[j] > tolerance
        if not above:
            if arc >= enough:
                return True
            continue
        for line in range(LINES):
            c, s = _COS[line], _SIN[line]
            cut = -math.inf
            for j in range(count):
                if up * height[j] > tolerance:
                    cut = max(cut, c * x[j] + s * y[j])
                    if cut >= 0:
                        break
            if cut >= 0:
                continue
            m = 0
            for k in range(len(ring)):
                if c * x[ring[k]] + s * y[ring[k]] >= cut:
                    kept[m] = direction[k]
                    m += 1
            if m >= least and _longest_run(kept[:m]) >= enough:
                return True
    return False


@kernel()
def _longest_run(direction):
    """The longest arc whose sorted directions (m,) lie no further than WIDEST_GAP apart, around the turn."""
    m = len(direction)
    start = -1
    for j in range(m):
        after = direction[(j + 1) % m] + (2 * math.pi if j == m - 1 else 0.0)
        if after - direction[j] > WIDEST_GAP:
            start = (j + 1) % m
            break
    if m == 0 or start < 0:
        return 2 * math.pi if m else 0.0
    best, run = 0.0, 0.0
    for j in range(start, start + m - 1):
        here, after = direction[j % m], direction[(j + 1) % m]
        gap = after - here + (2 * math.pi if (j + 1) % m == 0 else 0.0)
        run = run + gap if gap <= WIDEST_GAP else 0.0
        best = max(best, run)
    return best
