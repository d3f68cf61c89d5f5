"""Random choices keyed by whole numbers: the same for every executor, task and order."""

from __future__ import annotations

import numpy as np


def uniform_hash(index: np.ndarray, seed: int) -> np.ndarray:
    """A number in [0, 1) for each whole number, by splitmix64 of it and the seed (Steele et al. 2014)."""
    with np.errstate(over="ignore"):
        z = index.astype(np.uint64) + np.uint64(seed) * np.uint64(0xD1342543DE82EF95)
        z = (z + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
        z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        z ^= z >> np.uint64(31)
    return (z >> np.uint64(11)) / 2.0**53
