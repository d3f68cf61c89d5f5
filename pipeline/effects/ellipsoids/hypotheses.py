"""Members that planes and lines are tried through: by a fixed hash, so that equal neighbourhoods are decided
equally."""

from __future__ import annotations

import numpy as np

from pipeline.execution.compiled import kernel
from pipeline.numerics.hashing import FIRST, STEP

HYPOTHESES = 32  # planes through three members; a quarter of the threes at a crease lie on one side of it
MOST = 64  # members of a neighbourhood


def _threes() -> np.ndarray:  # (MOST + 1, HYPOTHESES, 3) uint8
    state = np.arange(1, HYPOTHESES + 1, dtype=np.uint64) * STEP
    state = (state ^ (state >> np.uint64(30))) * FIRST
    drawn = np.stack([state >> np.uint64(shift) for shift in (4, 24, 44)], axis=1)
    return np.stack([drawn % np.uint64(max(count, 1)) for count in range(MOST + 1)]).astype(np.uint8)


_THREES = _threes()  # a table: three divisions of 64 bits take as long as a plane's members


@kernel()
def three_members(hypothesis, count):
    """Three of `count` members, at most MOST, for one of HYPOTHESES."""
    three = _THREES[count, hypothesis]
    return np.int64(three[0]), np.int64(three[1]), np.int64(three[2])


@kernel()
def cross(p0, p1, p2, q0, q1, q2):
    """The vector product p x q, by components."""
    return p1 * q2 - p2 * q1, p2 * q0 - p0 * q2, p0 * q1 - p1 * q0
