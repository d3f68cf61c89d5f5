"""How many patches there are of each contrast, by octaves of their squared norm, and what share of each is learned
from.

Shares are equal but for octaves with few patches. Taking more of those with much contrast, in proportion to the square
root or the fourth root of their mean energy, with weights to undo that in the sums or without, gave 0.00 to 0.03 dB
less on all of `fountain_p11` (256 atoms from 10,000 and from 40,000 patches, two seeds each).
"""

from __future__ import annotations

import numpy as np

N_OCTAVES = 26
LOWEST = -12  # octave 0 is below 2^-12: a difference of one step of 255 in 16 of 3,072 values
FEWEST = 256  # patches of an octave, so that what is rare is learned from too


def octave_of(energy: np.ndarray) -> np.ndarray:
    """The octave (n,) of squared norms (n,)."""
    return np.clip(np.frexp(energy)[1] - LOWEST, 0, N_OCTAVES - 1)


def census(energy: np.ndarray) -> np.ndarray:
    """The number of patches in each octave, (N_OCTAVES,)."""
    return np.bincount(octave_of(energy), minlength=N_OCTAVES)


def shares(counts: np.ndarray, tolerance: float, n_wanted: int) -> np.ndarray:
    """The share (N_OCTAVES,) of each octave that makes `n_wanted` patches in all, or a few more where octaves are
    small.

    Octaves below `tolerance` have none; that in which it lies counts as a whole.
    """
    counts = np.where(np.arange(N_OCTAVES) >= octave_of(np.array([tolerance]))[0], counts, 0)
    even = n_wanted / max(1, counts.sum())
    return np.where(counts > 0, np.minimum(1.0, np.maximum(even, FEWEST / np.maximum(counts, 1))), 0.0)
