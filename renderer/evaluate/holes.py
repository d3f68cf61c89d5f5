"""Pixels that no splat covers where one would expect a surface: what a customer sees as stripes and pinholes."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import binary_closing

HOLE, UNSCANNED = (230, 30, 30), (40, 90, 255)
CLOSED_PX = 9  # gaps up to so wide are holes; wider ones may be windows


def outline_holes(coverage: np.ndarray, filled: np.ndarray | None = None) -> float:
    """The share of pixels without a splat inside the outline of what is covered, (height, width) bool: closed by
    squares of CLOSED_PX. Notches of a ragged outline count too. 0 where nothing is covered. Of them only those that are
    not `filled` either, where it is given.

    >>> outline_holes(np.pad(np.array([[True, False, True]] * 3), 9))
    0.3333333333333333
    """
    outline = outline_of(coverage)
    holes = outline & ~(coverage if filled is None else filled)
    return float(holes.sum() / outline.sum()) if outline.any() else 0.0


def outline_of(coverage: np.ndarray) -> np.ndarray:
    """What is covered (height, width) bool, closed by squares of CLOSED_PX."""
    square = np.ones((CLOSED_PX, CLOSED_PX), bool)
    return binary_closing(np.pad(coverage, CLOSED_PX), square)[CLOSED_PX:-CLOSED_PX, CLOSED_PX:-CLOSED_PX] | coverage


def painted_holes(rgb: np.ndarray, coverage: np.ndarray, filled: np.ndarray) -> np.ndarray:
    """A picture (height, width, 3) uint8 on white, its holes red, and blue where they are not `filled` either."""
    picture, outline = np.where(coverage[..., None], rgb, np.uint8(255)), outline_of(coverage)
    picture[outline & ~coverage] = HOLE
    picture[outline & ~coverage & ~filled] = UNSCANNED
    return picture
