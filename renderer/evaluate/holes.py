"""Pixels that no splat covers where one would expect a surface: what a customer sees as stripes and pinholes."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import binary_closing

CLOSED_PX = 9  # gaps up to so wide are holes; wider ones may be windows


def outline_holes(coverage: np.ndarray, filled: np.ndarray | None = None) -> float:
    """The share of pixels without a splat inside the outline of what is covered, (height, width) bool: closed by squares of
    CLOSED_PX. Notches of a ragged outline count too. 0 where nothing is covered. Of them only those that are not `filled` either, where it
    is given.

    >>> outline_holes(np.pad(np.array([[True, False, True]] * 3), 9))
    0.3333333333333333
    """
    square = np.ones((CLOSED_PX, CLOSED_PX), bool)
    outline = binary_closing(np.pad(coverage, CLOSED_PX), square)[CLOSED_PX:-CLOSED_PX, CLOSED_PX:-CLOSED_PX] | coverage
    holes = outline & ~(coverage if filled is None else filled)
    return float(holes.sum() / outline.sum()) if outline.any() else 0.0
