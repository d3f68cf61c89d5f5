"""How far around a splat a plane, up to one straight line, explains its neighbourhood: the arc that `decision.py`
decides by.

A plane is tried with every line that leaves all that stands above the plane behind it. Of the members within a
tolerance of the plane, on the kept side and in a ring around the splat, the longest run of directions without a wide
gap is the arc.
"""

from __future__ import annotations

import math

import numpy as np

from pipeline.effects.ellipsoids.hypotheses import HYPOTHESES, cross, three_members
from pipeline.execution.compiled import kernel

RING_RADII = 1.25  # members nearer than this say nothing of whether a disc of one radius is filled
WIDEST_GAP = math.radians(65)  # half a ring has 10 members at the median density: most gaps between them stay below
_GAP_TAN = math.tan(WIDEST_GAP)
_ROUNDING = 1e-9  # two in one direction may stand in either order
LINES = 16  # directions a line may have
_COS = np.array([math.cos(2 * math.pi * line / LINES) for line in range(LINES)])
_SIN = np.array([math.sin(2 * math.pi * line / LINES) for line in range(LINES)])
SECTORS = 64  # of a turn, a bit each: sixteen a quarter, equal in |y| / (|x| + |y|)
MOST_EMPTY = 12  # sectors in a gap of WIDEST_GAP, where they are narrowest: 2 tan 32.5 / (1 + tan 32.5) of a quarter
F = np.float32
ROUGH = F(1e-4)  # radii, or quarter turns: what float32 takes from 8 radii of offset is below 1e-5
LANES = 16  # of float32 that are added up at once, where the compiler has vectors of 256 bits


def reach_arc(
    offset: np.ndarray, count: np.ndarray, tolerance: float, enough: float, radius: float = 1.0
) -> np.ndarray:
    """Whether a plane explains an arc of `enough` radians or more, (n,) bool, of each neighbourhood: `offset` (n, k,
    3), the splat itself (zeros) among the first `count` (n,). `radius` is the splat's in units of the offsets,
    `tolerance` is in radii.

    Directions are sorted once a plane: of a part of them no run is longer than of all, so lines are tried only where
    all of them reach far enough; and they are sorted only where the sectors that hold any can.
    """
    found = np.zeros(len(offset), bool)
    _reach_arc(
        offset, count, tolerance * radius, (RING_RADII * radius) ** 2, enough, _sectors_on(enough) + MOST_EMPTY, found
    )
    return found


def _sectors_on(arc: float) -> int:
    """How many sectors an arc touches at least: a quarter turn SECTORS / 4, what is more fewest amid a quarter."""
    quarters, rest = divmod(arc, math.pi / 2)
    beside = math.tan(math.pi / 4 - rest / 2)
    return int(SECTORS / 4 * (quarters + 1 - 2 * beside / (1 + beside)))


@kernel(error_model="numpy")
def _reach_arc(offset, count, tolerance, ring, enough, run, found):
    width = offset.shape[1]
    height, x, y = np.empty(width), np.empty(width), np.empty(width)
    xs, ys, zs = np.empty(width, np.float32), np.empty(width, np.float32), np.empty(width, np.float32)
    turn, ring_x, ring_y = np.empty(width), np.empty(width), np.empty(width)
    most, nearest = F(tolerance) + ROUGH, F(ring) - ROUGH
    least = int(math.ceil(enough / WIDEST_GAP)) + 1
    for i in range(len(offset)):
        member, k, n = offset[i], count[i], 0
        for j in range(k):
            if member[j, 0] ** 2 + member[j, 1] ** 2 + member[j, 2] ** 2 >= nearest:
                xs[n], ys[n], zs[n] = member[j, 0], member[j, 1], member[j, 2]
                n += 1
        if n < least:
            continue
        n_lanes = min(width, -(-n // LANES) * LANES)
        for j in range(n, n_lanes):
            xs[j] = ys[j] = zs[j] = np.nan  # held by no plane
        for h in range(HYPOTHESES):
            a, b, c = three_members(h, k)
            known, p0, p1, p2, q0, q1, q2, n0, n1, n2, off = _plane(member, a, b, c, tolerance)
            if not known:
                continue
            plane = (F(p0), F(p1), F(p2), F(q0), F(q1), F(q2), F(n0), F(n1), F(n2), F(off))
            if not _may_reach(_sectors_held(xs, ys, zs, n_lanes, *plane, most, nearest), run):
                continue
            _project(member, k, a, p0, p1, p2, q0, q1, q2, n0, n1, n2, height, x, y)
            m = _ring(k, height, x, y, tolerance, ring, turn, ring_x, ring_y)
            arc = _longest_run(ring_x, ring_y, m) if m >= least else 0.0
            if arc >= enough and _either_side(k, height, x, y, tolerance, ring_x[:m], ring_y[:m], arc, enough, least):
                found[i] = True
                break


@kernel(error_model="numpy")
def _plane(member, a, b, c, tolerance):
    """The plane through members `a`, `b` and `c`: whether it is one that counts, two directions along it, its normal,
    and how far from the splat it lies. None does where the three are nearly on a line, or the plane misses the splat.

    Number by number: with arrays of three, these kernels took 6.3 s to compile; so, 1.9 s.
    """
    a0, a1, a2 = member[a, 0], member[a, 1], member[a, 2]
    p0, p1, p2 = member[b, 0] - a0, member[b, 1] - a1, member[b, 2] - a2
    q0, q1, q2 = member[c, 0] - a0, member[c, 1] - a1, member[c, 2] - a2
    n0, n1, n2 = cross(p0, p1, p2, q0, q1, q2)
    area, length = math.sqrt(n0 * n0 + n1 * n1 + n2 * n2), math.sqrt(p0 * p0 + p1 * p1 + p2 * p2)
    if area <= 0.2 * length * math.sqrt(q0 * q0 + q1 * q1 + q2 * q2):
        return False, p0, p1, p2, q0, q1, q2, n0, n1, n2, a0
    n0, n1, n2 = n0 / area, n1 / area, n2 / area
    off = a0 * n0 + a1 * n1 + a2 * n2
    p0, p1, p2 = p0 / length, p1 / length, p2 / length
    q0, q1, q2 = cross(n0, n1, n2, p0, p1, p2)
    return abs(off) <= tolerance, p0, p1, p2, q0, q1, q2, n0, n1, n2, off


@kernel(error_model="numpy")
def _sectors_held(xs, ys, zs, count, p0, p1, p2, q0, q1, q2, n0, n1, n2, off, most, least):
    """A bit for each sector that holds a member of the plane's ring, or lies within ROUGH of one: no fewer than members
    in float64 lie in."""
    apart, low, high = F(SECTORS // 4) * ROUGH, np.uint64(0), np.uint64(0)
    for j in range(count):
        h = xs[j] * n0 + ys[j] * n1 + zs[j] * n2 - off
        u, v = xs[j] * p0 + ys[j] * p1 + zs[j] * p2, xs[j] * q0 + ys[j] * q1 + zs[j] * q2
        turn = F(1) + v / (abs(u) + abs(v) + F(1e-30))  # grows with the angle from straight down, one a quarter turn
        turn = (F(4) - turn if u < F(0) else turn) * F(SECTORS // 4)
        inside = (abs(h) <= most) & (u * u + v * v >= least)
        turn = turn if inside else F(0)
        low |= np.uint64(inside) << np.uint64(np.int32(turn - apart) & np.int32(SECTORS - 1))
        high |= np.uint64(inside) << np.uint64(np.int32(turn + apart) & np.int32(SECTORS - 1))
    return low | high


@kernel(error_model="numpy")
def _project(member, count, a, p0, p1, p2, q0, q1, q2, n0, n1, n2, height, x, y):
    """Members in the frame of a plane through member `a`."""
    for j in range(count):
        height[j] = (
            (member[j, 0] - member[a, 0]) * n0 + (member[j, 1] - member[a, 1]) * n1 + (member[j, 2] - member[a, 2]) * n2
        )
        x[j] = member[j, 0] * p0 + member[j, 1] * p1 + member[j, 2] * p2
        y[j] = member[j, 0] * q0 + member[j, 1] * q1 + member[j, 2] * q2


@kernel(error_model="numpy")
def _may_reach(there, run):
    """Whether sectors follow each other, in a run of so many around the turn, each with a member or with at most
    MOST_EMPTY after one: where an arc reaches far enough, they do."""
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


@kernel(error_model="numpy")
def _turned(there, step):
    return there << np.uint64(step) | there >> np.uint64(SECTORS - step)


@kernel(error_model="numpy")
def _ring(count, height, x, y, tolerance, ring, turn, ring_x, ring_y):
    """Members in the plane's ring by their direction: how many, and where they lie."""
    m = 0
    for j in range(count):
        if abs(height[j]) <= tolerance and x[j] * x[j] + y[j] * y[j] >= ring:
            value, k = y[j] / (abs(x[j]) + abs(y[j])), m  # grows with the direction, as atan2 does
            if x[j] < 0:
                value = 2 - value if y[j] >= 0 else -2 - value
            while k > 0 and turn[k - 1] > value:
                turn[k], ring_x[k], ring_y[k] = turn[k - 1], ring_x[k - 1], ring_y[k - 1]
                k -= 1
            turn[k], ring_x[k], ring_y[k] = value, x[j], y[j]
            m += 1
    return m


@kernel(error_model="numpy")
def _either_side(count, height, x, y, tolerance, ring_x, ring_y, arc, enough, least):
    """Whether the members kept by a line reach `enough`, with either face of the plane up; all, with an arc of `arc`,
    where nothing stands above."""
    m = len(ring_x)
    kept_x, kept_y, cut = np.empty(m), np.empty(m), np.empty(LINES)
    for up in (1.0, -1.0):
        cut[:] = -math.inf
        above = 0
        for j in range(count):
            if up * height[j] > tolerance:
                above += 1
                for line in range(LINES):
                    cut[line] = max(cut[line], _COS[line] * x[j] + _SIN[line] * y[j])
        if not above:
            if arc >= enough:
                return True
            continue
        for line in range(LINES):
            if cut[line] >= 0:
                continue
            n = 0
            for k in range(m):
                if _COS[line] * ring_x[k] + _SIN[line] * ring_y[k] >= cut[line]:
                    kept_x[n], kept_y[n] = ring_x[k], ring_y[k]
                    n += 1
            if n >= least and (arc if n == m else _longest_run(kept_x, kept_y, n)) >= enough:
                return True
    return False


@kernel(error_model="numpy")
def _longest_run(x, y, m):
    """The longest arc in which no two of the first `m` members, in order of their directions, lie further than
    WIDEST_GAP apart, around the turn."""
    start = -1
    for j in range(m):
        if _is_gap(x, y, j, m):
            start = j + 1
            break
    if start < 0:
        return 2 * math.pi if m else 0.0
    best, first = 0.0, start % m
    for k in range(start, start + m):
        j = k % m
        if _is_gap(x, y, j, m):
            along = math.atan2(x[first] * y[j] - y[first] * x[j], x[first] * x[j] + y[first] * y[j])
            best, first = max(best, along if along >= -_ROUNDING else along + 2 * math.pi), (j + 1) % m
    return best


@kernel(error_model="numpy")
def _is_gap(x, y, j, m):
    """Whether the member after `j` lies further than WIDEST_GAP on: a lone member is a turn away from itself."""
    k = (j + 1) % m
    across, along = x[j] * y[k] - y[j] * x[k], x[j] * x[k] + y[j] * y[k]
    return m == 1 or along <= 0 or across > _GAP_TAN * along or across < -_ROUNDING * along
