"""Splats of nearly one radius together: what decides and fits looks at neighbourhoods of so many radii at once."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

CLASSES_AN_OCTAVE = 2  # so a class's radius is within a fifth of any of its splats'


def radius_classes(radius: np.ndarray, base: float) -> Iterator[tuple[float, np.ndarray]]:
    """The radius of each class, and which splats (m,) of `radius` (n,) are in it, by powers of 2^(1/2) of `base`; where
    all radii are `base` that is the one class's."""
    power = np.rint(CLASSES_AN_OCTAVE * np.log2(radius / base)).astype(np.int64)
    for found in np.unique(power):
        yield base * 2.0 ** (found / CLASSES_AN_OCTAVE), np.flatnonzero(power == found)
