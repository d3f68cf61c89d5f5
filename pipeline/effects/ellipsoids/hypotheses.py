"""Members that planes and lines are tried through: by a fixed hash, so that equal neighbourhoods are decided equally."""

from __future__ import annotations

import numpy as np

from pipeline.execution.compiled import kernel
from pipeline.numerics.hashing import FIRST, STEP

HYPOTHESES = 32  # planes through three members; a quarter of the threes at a crease lie on one side of it


@kernel()
def three_members(hypothesis, count):
    """Three of `count` members, for one of HYPOTHESES."""
    state = np.uint64(hypothesis + 1) * STEP
    state = (state ^ (state >> np.uint64(30))) * FIRST
    n = np.uint64(count)
    return (
        np.int64((state >> np.uint64(4)) % n),
        np.int64((state >> np.uint64(24)) % n),
        np.int64((state >> np.uint64(44)) % n),
    )


@kernel()
def cross(p0, p1, p2, q0, q1, q2):
    """The vector product p x q, by components."""
    return p1 * q2 - p2 * q1, p2 * q0 - p0 * q2, p0 * q1 - p1 * q0
