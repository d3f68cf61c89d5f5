"""Random choices keyed by whole numbers: the same for every executor, task and order (splitmix64, Steele et al.
2014)."""

from __future__ import annotations

import numpy as np

from pipeline.execution.compiled import part

STEP = np.uint64(0x9E3779B97F4A7C15)  # from one state of a stream to the next
FIRST, SECOND = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
BY_SEED = np.uint64(0xD1342543DE82EF95)  # keeps streams of neighbouring seeds apart


def _mixed(state):
    z = (state ^ (state >> np.uint64(30))) * FIRST
    z = (z ^ (z >> np.uint64(27))) * SECOND
    return z ^ (z >> np.uint64(31))


mixed = part()(_mixed)  # uint64 -> uint64, for kernels


def uniform_hash(index: np.ndarray, seed: int) -> np.ndarray:
    """A number in [0, 1) for each whole number of `index` (n,), by it and the seed; (n,) float64."""
    with np.errstate(over="ignore"):
        state = (index.astype(np.uint64) + np.uint64(seed) * BY_SEED + np.uint64(1)) * STEP
        return (_mixed(state) >> np.uint64(11)) / 2.0**53
