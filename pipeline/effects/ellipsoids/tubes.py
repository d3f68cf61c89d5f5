"""Where two ropes cross: a plane explains them as well as it explains a wall. So does a cross of two tubes, and no wall
is one."""

from __future__ import annotations

import numpy as np

from pipeline.effects.ellipsoids.hypotheses import HYPOTHESES, cross, three_members
from pipeline.effects.ellipsoids.nearest import n_within
from pipeline.effects.ellipsoids.neighbourhoods import Neighbourhood
from pipeline.execution.compiled import kernel

# Two tubes that explain a neighbourhood twice as wide are ropes that cross. Half widths of 0.6 and 0.75 radii, shares
# of 0.85 and 0.93, reaches of 3.75 and 5 radii and one to three tubes were tried on rooms of seeds 11, 13, 17 and 19:
# with these, ropes that are right go from 0.82 to 0.96 up to 0.88 to 0.97 and flat things lose nothing; three tubes
# lose 1 % of those, 3.75 radii 2 % of round ones.
CROSSING_RADII = 5.0
TUBE_RADII = 0.6
TUBES_SHARE = 0.85
FIRST_SHARE = 0.4  # of the first tube: what no tube through the splat explains so far, a second does not explain either


def at_crossings(near: Neighbourhood) -> np.ndarray:
    """Which neighbourhoods two tubes explain, (n,) bool; the first tube holds the splat itself. `near` in radii,
    gathered in a reach of CROSSING_RADII or more."""
    return _share_of_tubes(near.offset, n_within(near.offset, near.count, CROSSING_RADII)) >= TUBES_SHARE


@kernel(error_model="numpy")
def _share_of_tubes(offset, count):
    """The share (n,) of the first `count` members that lie in the best tube through member 0 and the best one of the
    others."""
    n, most, _ = offset.shape
    share = np.zeros(n)
    left = np.empty(most, np.int64)
    for i in range(n):
        for j in range(count[i]):
            left[j] = j
        others = _outside_best_tube(offset[i], left, count[i], True)
        if 1 - others / count[i] >= FIRST_SHARE:
            share[i] = 1 - _outside_best_tube(offset[i], left, others, False) / count[i]
    return share


@kernel(error_model="numpy")
def _outside_best_tube(offset, left, n, through_first):
    """How many of the first `n` of `left` lie outside the tube along two of them that holds most; they become its
    first."""
    best, at, to = 0, -1, -1
    for h in range(HYPOTHESES if n > 1 else 0):
        a, b, _ = three_members(h, n)
        inside = _inside_tube(offset, left, n, left[a], left[b], through_first)
        if inside > best:
            best, at, to = inside, left[a], left[b]
    outside = 0
    for j in range(n):
        if at < 0 or _off_line(offset, at, to, left[j]) > TUBE_RADII**2:
            left[outside] = left[j]
            outside += 1
    return outside


@kernel(error_model="numpy")
def _inside_tube(offset, left, n, a, b, through_first):
    """How many members lie in the tube along members `a` and `b`; 0 where those are too near to tell, or where it
    misses member 0."""
    length = 0.0
    for k in range(3):
        length += (offset[b, k] - offset[a, k]) ** 2
    if length < (CROSSING_RADII / 2) ** 2 or (through_first and _off_line(offset, a, b, 0) > TUBE_RADII**2):
        return 0
    inside = 0
    for j in range(n):
        inside += _off_line(offset, a, b, left[j]) <= TUBE_RADII**2
    return inside


@kernel(error_model="numpy")
def _off_line(offset, a, b, j):
    """The squared distance of member `j` from the line through members `a` and `b`."""
    d0, d1, d2 = offset[b, 0] - offset[a, 0], offset[b, 1] - offset[a, 1], offset[b, 2] - offset[a, 2]
    p0, p1, p2 = offset[j, 0] - offset[a, 0], offset[j, 1] - offset[a, 1], offset[j, 2] - offset[a, 2]
    c0, c1, c2 = cross(d0, d1, d2, p0, p1, p2)
    return (c0 * c0 + c1 * c1 + c2 * c2) / (d0 * d0 + d1 * d1 + d2 * d2)
