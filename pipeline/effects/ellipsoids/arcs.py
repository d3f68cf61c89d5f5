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
_ROUNDING = 1e-9  # radians: sums of the same gaps in other parts


@kernel()
def reach_arc(offset, count, tolerance, enough):
    """Whether a plane explains an arc of `enough` radians or more, (n,) bool, of each neighbourhood: `offset` (n, k, 3), in
    radii, the splat itself (zeros) among the first `count` (n,).

    Directions are sorted once a plane: of a part of them no run is longer than of all, so lines are tried only where all of
    them reach far enough.
    """
    n, most, _ = offset.shape
    found = np.zeros(n, np.bool_)
    height, x, y = np.empty(most), np.empty(most), np.empty(most)
    ring, direction = np.empty(most, np.int64), np.empty(most)
    least = int(math.ceil(enough / WIDEST_GAP)) + 1
    for i in range(n):
        for h in range(HYPOTHESES if count[i] >= least else 0):
            a, b, c = three_members(h, count[i])
            if not _project(offset[i], count[i], a, b, c, tolerance, least, height, x, y):
                continue
            m = _ring(count[i], height, x, y, tolerance, ring, direction)
            if m < least:
                continue
            arc = _longest_run(direction[:m])
            if arc < enough - _ROUNDING:
                continue
            if _either_side(count[i], height, x, y, tolerance, ring[:m], direction[:m], arc, enough, least):
                found[i] = True
                break
    return found


@kernel()
def _project(offset, count, a, b, c, tolerance, least, height, x, y):
    """Members in the frame of the plane through members `a`, `b` and `c`; False where those are nearly on a line, or the plane
    misses the splat, or holds fewer than `least`.

    Number by number: with arrays of three, these kernels took 6.3 s to compile; so, 1.9 s.
    """
    a0, a1, a2 = offset[a, 0], offset[a, 1], offset[a, 2]
    p0, p1, p2 = offset[b, 0] - a0, offset[b, 1] - a1, offset[b, 2] - a2
    q0, q1, q2 = offset[c, 0] - a0, offset[c, 1] - a1, offset[c, 2] - a2
    n0, n1, n2 = cross(p0, p1, p2, q0, q1, q2)
    area, length = math.sqrt(n0 * n0 + n1 * n1 + n2 * n2), math.sqrt(p0 * p0 + p1 * p1 + p2 * p2)
    if area <= 0.2 * length * math.sqrt(q0 * q0 + q1 * q1 + q2 * q2):
        return False
    n0, n1, n2 = n0 / area, n1 / area, n2 / area
    if abs(a0 * n0 + a1 * n1 + a2 * n2) > tolerance:
        return False
    p0, p1, p2 = p0 / length, p1 / length, p2 / length
    q0, q1, q2 = cross(n0, n1, n2, p0, p1, p2)
    inside = 0
    for j in range(count):
        height[j] = (offset[j, 0] - a0) * n0 + (offset[j, 1] - a1) * n1 + (offset[j, 2] - a2) * n2
        inside += abs(height[j]) <= tolerance
    if inside < least:
        return False
    for j in range(count):
        o0, o1, o2 = offset[j, 0], offset[j, 1], offset[j, 2]
        x[j] = o0 * p0 + o1 * p1 + o2 * p2
        y[j] = o0 * q0 + o1 * q1 + o2 * q2
    return True


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
